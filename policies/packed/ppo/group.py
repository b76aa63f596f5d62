"""Members of a pack whose PPO networks are computed together: acting, values, and the updates of an iteration.

Shapes: M members, T vector steps, N sub-environments per member, R = T * N rows, D numbers per observation, A outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policies.envs.masks import FORBIDDEN
from policies.hyperparams import PPOHyperparams
from policies.networks.denormals import denormals_as_zero
from policies.packed.acting import PrepareBytes, make_acting
from policies.packed.inputs import Inputs
from policies.packed.member import Member
from policies.packed.optimizers import StackedAdam, clip_by_global_norm
from policies.packed.ppo import loss as ppo
from policies.packed.rows import StackedRows
from policies.packed.shared import SharedByPPO
from policies.schedules import linear

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-8  # torch's defaults, which RLlib uses

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Batch:
    """The data that an iteration's updates learn from, member by member."""

    observations: NDArray[Any]
    """Prepared observations, (M, R, D), or bytes of images as they were observed."""
    actions: Floats
    """Actions, one-hot or as the policy drew them, (M, R, actions)."""
    outputs: Floats
    """The policy's outputs, (M, R, A), `FORBIDDEN` where an action was not allowed."""
    advantages: Floats
    """Advantages, standardised for members with `normalize_advantages`, (M, R)."""
    value_targets: Floats
    """Value targets, (M, R)."""
    values: Floats | None = None
    """The values V of the observations, (M, R); None: no member has a `vf_clip_range`."""
    masks: Floats | None = None
    """Which actions were allowed, (M, R, A); None: all."""
    prepare_bytes: Callable[[Tensor], Tensor] | None = None
    """Prepares rows of images of bytes, (M, B, D); None: observations are prepared."""


class PPOGroup:
    """M members with about the same layer sizes.

    Args:
        members: The members.
        shared: The hyperparameters that the members share.
        seen: What networks see of an observation, whose mask of actions has A numbers, or 0 if there is none.
        num_outputs: The number of outputs of the policy's head.
        heads: What those outputs mean.
        num_envs: The sub-environments of each member.
        device: Where the updates are computed, and actions of large networks.
    """

    def __init__(
        self,
        members: Sequence[Member[PPOHyperparams]],
        shared: SharedByPPO,
        seen: Inputs,
        num_outputs: int,
        *,
        heads: ppo.Heads,
        num_envs: int,
        device: str,
    ) -> None:
        self.members, self._shared = members, shared
        self._num_outputs, self._heads, self._device = num_outputs, heads, device
        self._num_masked, self._inputs = seen.num_masked, seen.unmasked
        self._prepare_bytes: Callable[[Tensor], Tensor] | None = None
        self._rows = StackedRows(members, seen.shape, num_outputs, device, image=seen.image)
        self._networks = self._rows.networks
        self._shares = self._rows.networks_per_member == 1
        column = self._rows.per_row
        self._optimizer = StackedAdam(
            self._networks.weights,
            lr=column(lambda member: member.hyperparams.lr),
            beta1=column(lambda _: _BETA1, torch.float64),
            beta2=column(lambda _: _BETA2, torch.float64),
            epsilon=column(lambda _: _EPSILON),
        )
        self._rows.read_moments(self._optimizer)
        self._acting = make_acting(self._networks, len(members), num_envs)
        self._hyperparams = [member.hyperparams for member in members]
        self._unfinished: tuple[ppo.Parts, Tensor | None, int]
        self._grad_clip = self._per_member(lambda item: math.inf if item.grad_clip is None else item.grad_clip)
        self._clips = any(item.grad_clip is not None for item in self._hyperparams)
        # By numbers, as a list of booleans would be made into them at each update.
        self._free_log_stds = torch.tensor(
            [index for index, item in enumerate(self._hyperparams) if heads.is_gaussian and item.free_log_std],
            device=device, dtype=torch.int64,
        )  # fmt: skip
        self._coefficients = ppo.Coefficients(
            clip_param=self._per_member(lambda item: item.clip_param),
            vf_clip_param=self._per_member(lambda item: math.inf if item.vf_clip_param is None else item.vf_clip_param),
            vf_clip_range=self._per_member(lambda item: math.inf if item.vf_clip_range is None else item.vf_clip_range),
            vf_loss_coeff=self._per_member(lambda item: item.vf_loss_coeff),
            entropy_coeff=self._per_member(lambda item: item.entropy_coeff),
            kl_coeff=self._per_member(lambda _: 0.0),
        )

    def _per_member(self, value: Callable[[PPOHyperparams], float]) -> Tensor:
        return torch.tensor([[value(item)] for item in self._hyperparams], device=self._device, dtype=torch.float32)

    @property
    def has_convolutions(self) -> bool:
        """Whether its networks begin with convolutions."""
        return bool(self._networks.convolutions)

    def act(self, observations: NDArray[Any], prepare_bytes: PrepareBytes | None = None) -> Floats:
        """Return the policy's outputs, (M, N, A), for prepared observations, (M, N, D), or for bytes to be prepared."""
        outputs = self._acting(observations, prepare_bytes)
        return outputs[..., : self._num_outputs] if self._shares else outputs

    def values(self, observations: Tensor) -> Tensor:
        """Return the values V, (M, B), of observations with a last column of ones, (M, B, D + 1)."""
        num_members = len(self.members)
        if self._shares:
            return self._networks.forward(observations)[..., -1]
        return self._networks.evaluate(observations, num_members, 2 * num_members)[..., 0]

    @torch.inference_mode()
    @denormals_as_zero()
    def learn(self, batch: Batch) -> None:
        """Make the updates of one iteration, or on a GPU start them; `finish` has to be called next."""
        shared = self._shared
        num_rows = batch.advantages.shape[1]
        num_updates = math.ceil(num_rows * shared.num_epochs / shared.minibatch_size)
        self._move_schedules()
        columns = self._columns(batch)
        self._prepare_bytes = batch.prepare_bytes
        # No column: the width of the others may decide how products of them are rounded.
        old_values = None if batch.values is None else torch.from_numpy(batch.values).reshape(-1).to(self._device)
        indices = torch.from_numpy(self._draw_rows(num_rows, num_updates * shared.minibatch_size)).to(self._device)
        self._optimizer.begin(num_updates)
        parts, norms = None, None
        for number in range(num_updates):
            chosen = indices[:, number * shared.minibatch_size : (number + 1) * shared.minibatch_size]
            rows = columns.index_select(0, chosen.reshape(-1)).view(len(self.members), shared.minibatch_size, -1)
            outputs, values = self._forward(rows)
            minibatch = self._minibatch(rows)
            minibatch.old_values = None if old_values is None else old_values[chosen]
            if number == num_updates - 1:
                parts = ppo.loss(outputs, values, minibatch, self._coefficients, heads=self._heads)
            norms = self._update(outputs, values, minibatch)
        assert parts is not None
        self._unfinished = parts, norms, num_updates

    def finish(self) -> list[dict[str, float]]:
        """Wait for the updates of `learn`, and act with the new weights from now on.

        Returns:
            For each member, the metrics of the last update.
        """
        self._acting.refresh()
        return self._stats(*self._unfinished)

    def _columns(self, batch: Batch) -> Tensor:
        """Put all that a minibatch needs side by side, (M * R, columns), so that one gather copies it."""
        num_members, num_rows, _ = batch.observations.shape
        num_actions, num_outputs = batch.actions.shape[2], self._num_outputs
        keeps_outputs, num_masked = self._shared.use_kl_loss, self._num_masked
        sizes = [self._inputs.num_columns, num_actions, 1, 1, 1, num_outputs if keeps_outputs else 0, num_masked]
        self._bounds = np.cumsum(sizes).tolist()
        actions, outputs = torch.from_numpy(batch.actions), torch.from_numpy(batch.outputs)
        logp = ppo.log_probabilities(outputs, actions, heads=self._heads)
        columns = np.empty((num_members, num_rows, self._bounds[-1]), dtype=np.float32)
        self._inputs.put(columns[..., : self._bounds[0]], batch.observations)
        columns[..., self._bounds[0] : self._bounds[1]] = batch.actions
        columns[..., self._bounds[1]] = logp.numpy()
        columns[..., self._bounds[2]] = batch.advantages
        columns[..., self._bounds[3]] = batch.value_targets
        if keeps_outputs:
            columns[..., self._bounds[4] : self._bounds[5]] = batch.outputs
        if batch.masks is not None:
            columns[..., self._bounds[5] :] = batch.masks
        return torch.from_numpy(columns).view(num_members * num_rows, -1).to(self._device)

    def _draw_rows(self, num_rows: int, num_drawn: int) -> NDArray[np.int64]:
        """Draw the rows of each update as indices into the flattened batch: pass after pass, each in a new order."""
        num_passes = math.ceil(num_drawn / num_rows)
        drawn = np.empty((len(self.members), num_drawn), dtype=np.int64)
        ordered = np.tile(np.arange(num_rows), (num_passes, 1))
        for index, member in enumerate(self.members):
            drawn[index] = member.rng.permuted(ordered, axis=1).reshape(-1)[:num_drawn]
            drawn[index] += index * num_rows
        return drawn

    def _forward(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the policy's outputs, (M, B, A), and the values, (M, B)."""
        observations = rows[..., : self._bounds[0]]
        if self._prepare_bytes is not None:
            observations = self._prepare_bytes(self._inputs.bytes_in_tensor(observations))
        if self._shares:
            outputs = self._networks.forward(observations)
            return self._allowed(outputs[..., : self._num_outputs], rows), outputs[..., -1]
        # As `repeat` does, in less time.
        twice = observations.expand(2, *observations.shape).reshape(-1, *observations.shape[1:]).contiguous()
        outputs = self._networks.forward(twice)
        num_members = len(self.members)
        return self._allowed(outputs[:num_members], rows), outputs[num_members:, :, 0]

    def _allowed(self, outputs: Tensor, rows: Tensor) -> Tensor:
        """Return logits, (M, B, A), `FORBIDDEN` where the rows' masks forbid the action: no gradient comes of these."""
        if not self._num_masked:
            return outputs
        return outputs.masked_fill(rows[..., self._bounds[5] :] == 0, FORBIDDEN)

    def _minibatch(self, rows: Tensor) -> ppo.Minibatch:
        bounds = self._bounds
        return ppo.Minibatch(
            actions=rows[..., bounds[0] : bounds[1]],
            logp=rows[..., bounds[1]],
            advantages=rows[..., bounds[2]],
            value_targets=rows[..., bounds[3]],
            old_outputs=rows[..., bounds[4] : bounds[5]] if self._shared.use_kl_loss else None,
        )

    def _update(self, outputs: Tensor, values: Tensor, minibatch: ppo.Minibatch) -> Tensor | None:
        """Make one gradient step and return the gradients' norms, (M, 1), if any are clipped."""
        policy_gradient, value_gradient = ppo.gradients(
            outputs, values, minibatch, self._coefficients, heads=self._heads
        )
        num_members, num_rows = values.shape
        networks = self._networks
        gradient = torch.zeros(networks.num_networks, num_rows, networks.sizes[-1], device=self._device)
        gradient[:num_members, :, : self._num_outputs] = policy_gradient
        gradient[-num_members:, :, -1 if self._shares else 0] = value_gradient
        networks.backward(gradient)
        if len(self._free_log_stds):
            # Their weights are 0 and stay so: the biases alone learn.
            networks.gradient_layers[-1][self._free_log_stds, :-1, self._num_outputs // 2 : self._num_outputs] = 0.0
        norms = None
        if self._clips:
            norms = clip_by_global_norm(networks.gradients, self._grad_clip, self._rows.networks_per_member)
        self._optimizer.step(networks.gradients)
        return norms

    def _move_schedules(self) -> None:
        """Set learning rates, entropy weights and clips for the env steps so far, including this iteration's."""
        lr, entropy, clip = [], [], []
        for member, item in zip(self.members, self._hyperparams, strict=True):
            now = member.num_env_steps
            lr.append([linear(item.lr, item.lr_final, item.lr_decay_steps, now)])
            entropy.append([linear(item.entropy_coeff, item.entropy_coeff_final, item.entropy_decay_steps, now)])
            clip.append([linear(item.clip_param, item.clip_param_final, item.clip_decay_steps, now)])
        column = torch.tensor(lr, device=self._device, dtype=torch.float32)
        self._optimizer.lr = column.repeat(self._rows.networks_per_member, 1)
        changed = {"entropy_coeff": entropy, "clip_param": clip}
        if self._shared.use_kl_loss:
            changed["kl_coeff"] = [[member.kl_coeff] for member in self.members]
        columns = {
            name: torch.tensor(values, device=self._device, dtype=torch.float32) for name, values in changed.items()
        }
        self._coefficients = replace(self._coefficients, **columns)

    def _stats(self, parts: ppo.Parts, norms: Tensor | None, num_updates: int) -> list[dict[str, float]]:
        columns = {name: value.tolist() for name, value in vars(parts).items()}
        columns["lr"] = self._optimizer.lr[: len(self.members), 0].tolist()
        if norms is not None:
            columns["gradient_norm"] = norms[:, 0].tolist()
        stats = []
        for index, (member, item) in enumerate(zip(self.members, self._hyperparams, strict=True)):
            member.num_updates += num_updates
            found = {name: float(values[index]) for name, values in columns.items()}
            if item.use_kl_loss:
                member.kl_coeff = _next_kl_coeff(member.kl_coeff, found["kl"], item.kl_target)
            else:
                del found["kl"]
            if item.grad_clip is None:
                found.pop("gradient_norm", None)  # computed because another member's is clipped
            stats.append({name: value for name, value in found.items() if math.isfinite(value)})
        return stats

    def write_back(self) -> None:
        """Copy the present weights and moments back to the members."""
        self._rows.write_back(self._optimizer)


def _next_kl_coeff(now: float, kl: float, target: float) -> float:
    """Return the next weight by RLlib's rule: times 1.5 above twice the target, times 0.5 below half of it."""
    if kl > 2.0 * target:
        return now * 1.5
    return now * 0.5 if kl < 0.5 * target else now
