"""The torch layers of the RLModules: encoders, their initial weights, and running statistics of observations."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from policies.envs.images import image_member, scale_of_bytes
from policies.envs.masks import FORBIDDEN, num_masked, seen_by_networks
from policies.errors import SpecError
from policies.portable.convolution import output_shape
from policies.portable.file import Normalization

OBSERVATION_CLIP = 10.0
"""Normalised observations are clipped to -/+ this."""
VARIANCE_EPSILON = 1e-8
"""Added to a variance before observations are divided by its square root."""
_BLOCK = 512
"""The numbers of an observation that statistics take at once; a multiple of what torch adds up in one instruction."""

_ACTIVATIONS: dict[str, type[nn.Module] | None] = {
    "linear": None, "relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU, "elu": nn.ELU, "gelu": nn.GELU,
}  # fmt: skip
# torch gives a gain for these activations; the others are close to ReLU and use its gain.
_GAINS = {"linear": 1.0, "tanh": 5.0 / 3.0}


class Encoder(nn.Module):
    """Convolutions, if any, then dense layers, with the activation after each.

    Args:
        observation_space: What networks see: of shape (n,), or (height, width, channels) with convolutions. With
            convolutions a vector has an image among the members that it is made of; the rest goes into the dense
            layers, behind what the convolutions make of the image.
        hidden_sizes: Units of each dense layer.
        activation: A name of `policies.activations.ACTIVATIONS`.
        conv_filters: (channels, kernel, stride) of each convolution, without padding; None: none.
        normalizes: Whether observations are normalised before.

    Attributes:
        conv: The convolutions, or None.
        mlp: The dense layers.
        num_features: How many numbers an observation becomes.

    Raises:
        SpecError: The convolutions do not fit the observations.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        hidden_sizes: Sequence[int],
        activation: str,
        conv_filters: Sequence[tuple[int, int, int]] | None = None,
        *,
        normalizes: bool = False,
    ) -> None:
        super().__init__()
        shape = observation_space.shape or ()
        make = _ACTIVATIONS[activation]
        self.conv = None
        self._image = image_member(observation_space, normalizes=normalizes) if conv_filters else None
        if conv_filters:
            shape = shape if self._image is None else self._image.shape
            height, width, channels = output_shape(shape, conv_filters)
            convolutions: list[nn.Module] = []
            in_channels = shape[-1]
            for out_channels, kernel, stride in conv_filters:
                convolutions.append(nn.Conv2d(in_channels, out_channels, kernel, stride))
                convolutions += [make()] if make is not None else []
                in_channels = out_channels
            self.conv = nn.Sequential(*convolutions)
            size = height * width * channels + (0 if self._image is None else self._image.num_beside)
        elif len(shape) == 1:
            size = shape[0]
        else:
            raise SpecError(
                f"The observations are of shape {shape}, and conv_filters is not set: only observations of shape (n,) "
                "go into dense layers.",
                "Set conv_filters, such as [[16, 8, 4], [32, 4, 2]], if they are images of (height, width, channels).",
            )
        dense: list[nn.Module] = []
        for num_units in hidden_sizes:
            dense.append(nn.Linear(size, num_units))
            dense += [make()] if make is not None else []
            size = num_units
        self.mlp = nn.Sequential(*dense)
        self.num_features = size

    def forward(self, observations: Tensor) -> Tensor:
        """Return the features, shape (B, num_features), of observations of shape (B, ...)."""
        if self.conv is not None:
            observations = self._convolved(observations)
        # The modules are not called, because torch's overhead of a call costs as much as a small layer.
        features = observations
        for layer in self.mlp:
            features = layer.forward(features)
        return features

    def _convolved(self, observations: Tensor) -> Tensor:
        """Return what the convolutions make of images, flat, and behind it what is beside them, (B, numbers)."""
        assert self.conv is not None
        image = self._image
        images = observations
        if image is not None:
            members = image.members_of(observations)
            images = members[0] if len(members) == 1 else torch.cat(members, dim=-1)
        # Environments return (height, width, channels); torch wants the channels first.
        features: Tensor = self.conv(images.permute(0, 3, 1, 2)).flatten(1)
        if image is None:
            return features
        return torch.cat([features, *image.beside_of(observations)], dim=1)


def hidden_gain(activation: str) -> float:
    """Return the gain of orthogonal weights that offsets an activation's shrinking (He et al. 2015; torch's values)."""
    return _GAINS.get(activation, math.sqrt(2.0))


def initialize(module: nn.Module, initializer: str, gain: float) -> None:
    """Set the initial weights of all linear and convolutional layers in a module.

    Args:
        module: The module; its other layers stay as they are.
        initializer: torch (nothing is done), he_uniform (uniform within -/+ sqrt(6 / inputs), He et al. 2015), or
            orthogonal (Saxe et al. 2014); biases become 0.
        gain: The factor of orthogonal weights.
    """
    if initializer == "torch":
        return
    for layer in module.modules():
        if isinstance(layer, (nn.Linear, nn.Conv2d)):
            if initializer == "he_uniform":
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
            else:
                nn.init.orthogonal_(layer.weight, gain=gain)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


class ObservationStatistics:
    """Mixin for an RLModule: scales uint8 observations to [0, 1] and, if asked to, normalises observations.

    Where observations begin with a mask, networks see what is behind it, and `allowed` applies it to what they give.

    `setup` must call `add_statistics`, the forward passes `prepare`. With `model_config["normalize_observations"]` the
    running mean, variance and count are buffers of the module. So they go where its weights go: to env runners and into
    checkpoints and portable policies. All networks of one module, also a target network, use the same statistics.
    """

    observation_space: gym.Space[Any]
    model_config: Any
    obs_mean: Tensor
    obs_var: Tensor
    obs_count: Tensor
    _observation_scale: float = 1.0
    _normalizes: bool = False
    _num_masked: int = 0

    def add_statistics(self) -> None:
        """Register the buffers, if observations are to be normalised."""
        self._observation_scale = observation_scale(self.observation_space)
        self._num_masked = num_masked(self.observation_space)
        self._normalizes = bool(self.model_config.get("normalize_observations"))
        if self._normalizes:
            shape = seen_by_networks(self.observation_space).shape or ()
            self.register_buffer("obs_mean", torch.zeros(shape))  # type: ignore[attr-defined]
            self.register_buffer("obs_var", torch.ones(shape))  # type: ignore[attr-defined]
            # A whole number, because RLlib's checkpoints would turn it into a float, which is exact to 24 bits only.
            self.register_buffer("obs_count", torch.zeros((), dtype=torch.int64))  # type: ignore[attr-defined]

    def prepare(self, observations: Tensor) -> Tensor:
        """Return observations, shape (B, ...), as the networks get them: scaled and, if asked to, normalised."""
        observations = self._unmasked(observations)
        if self._observation_scale != 1.0 or observations.dtype == torch.uint8:
            observations = observations.float() * self._observation_scale
        if self._normalizes:
            factor = torch.rsqrt(self.obs_var + VARIANCE_EPSILON)
            observations = ((observations - self.obs_mean) * factor).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        return observations

    def _unmasked(self, observations: Tensor) -> Tensor:
        """Return what is behind the masks of observations, (B, ...): vectors, or images in their shape."""
        if not self._num_masked:
            return observations
        shape = seen_by_networks(self.observation_space).shape or ()
        return observations[..., self._num_masked :].reshape(*observations.shape[:-1], *shape)

    def allowed(self, outputs: Tensor, observations: Tensor) -> Tensor:
        """Return logits or Q-values, `FORBIDDEN` where the masks of observations, (B, ...), forbid the action."""
        if not self._num_masked:
            return outputs
        return outputs.masked_fill(observations[..., : self._num_masked] == 0, FORBIDDEN)

    @torch.no_grad()
    def update_observation_statistics(self, observations: Tensor | NDArray[Any]) -> None:
        """Merge a batch into the statistics (Chan et al. 1979, the parallel variance), if there are any.

        Learners call this after the updates of a phase, so that a batch is trained with the statistics it was sampled
        with.

        Args:
            observations: As the env returned them, shape (B, ...).
        """
        num_new = len(observations)
        if not self._normalizes or num_new == 0:
            return
        batch = self._unmasked(torch.as_tensor(observations, device=self.obs_mean.device))
        batch = batch.reshape(num_new, self.obs_mean.numel())
        mean = torch.empty(batch.shape[1], dtype=torch.float64, device=batch.device)
        deviations = torch.empty_like(mean)
        for part in column_blocks(batch.shape[1]):
            block = batch[:, part].to(torch.float64, copy=True).mul_(self._observation_scale)
            mean[part] = block.mean(dim=0)
            deviations[part] = block.sub_(mean[part]).square_().sum(dim=0)
        mean, deviations = mean.reshape(self.obs_mean.shape), deviations.reshape(self.obs_mean.shape)
        count = int(self.obs_count)
        total = count + num_new
        delta = mean - self.obs_mean
        squares = self.obs_var.double() * count + deviations + delta**2 * (count * num_new / total)
        # In place, because others keep references to these tensors.
        self.obs_mean.copy_(self.obs_mean.double() + delta * (num_new / total))
        self.obs_var.copy_(squares / total)
        self.obs_count.fill_(total)


def column_blocks(num_numbers: int) -> Iterator[slice]:
    """Yield the parts of observations whose statistics are found one after the other, few numbers of all rows at once.

    A batch of bytes in float64 is eight batches. What is left over goes into the last part: a part of a single number
    would be added up in another order, and rounded otherwise than among others.
    """
    num_blocks = max(1, num_numbers // _BLOCK)
    for index in range(num_blocks):
        yield slice(index * _BLOCK, (index + 1) * _BLOCK if index + 1 < num_blocks else num_numbers)


def observation_scale(space: gym.Space[Any]) -> float:
    """Return the factor that observations are multiplied by first, so that images of bytes are of 0 to 1."""
    return scale_of_bytes(seen_by_networks(space))


def normalization_of(mean: NDArray[Any], variance: NDArray[Any]) -> Normalization:
    """Return the statistics of `ObservationStatistics` in the form of a portable policy."""
    std = np.sqrt(np.asarray(variance, dtype=np.float32) + np.float32(VARIANCE_EPSILON))
    return Normalization(np.array(mean, dtype=np.float32), std, OBSERVATION_CLIP)
