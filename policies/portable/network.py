"""The network of a portable policy: its parts, how they are written and read, and whether they fit together.

Words: a *layer* is a linear map followed by an activation; the *network* is the chain from observation to output:
scale, normalization, convolutions, layers; all but the layers are optional. The network's *kind* says what the output
means:

* `categorical` (PPO, Discrete actions): one logit per action; greedy: the largest. Of several choices at once: the
  logits of one choice after another; greedy: the largest of each.
* `gaussian` (PPO, Box actions): mean and log standard deviation of each component; greedy: the mean.
* `q_values` (DQN): one value per action; greedy: the largest. The layers of a dueling network end in the advantages:
  the state value is left out, because it is the same for all actions and never changes which one is greedy.
* `random`, `constant` (the baselines): no layers; actions drawn uniformly, or always the same one.
* `module`: no layers; the weights of an RLModule class of the user's own, which computes the actions itself.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.activations import ACTIVATIONS
from policies.envs.images import Channels, SeenImage
from policies.envs.masks import MaskedBox, seen_by_networks
from policies.envs.own_actions import Choices, sizes_of
from policies.errors import SpecError
from policies.portable.convolution import output_shape

NetworkKind = Literal["categorical", "gaussian", "q_values", "random", "constant", "module"]
BASELINE_KINDS: tuple[NetworkKind, ...] = ("random", "constant")
Tensors = dict[str, NDArray[Any]]
ActionSpace = gym.spaces.Box | gym.spaces.Discrete[Any] | Choices

_MODULE_PREFIX = "module."


@dataclass(frozen=True, eq=False)
class Layer:
    """One linear map and the activation after it: `activation(weight @ x + bias)`."""

    weight: NDArray[np.float32]
    """Shape (num_outputs, num_inputs)."""
    bias: NDArray[np.float32]
    """Shape (num_outputs,)."""
    activation: str = "linear"
    """A name of `policies.activations.ACTIVATIONS`."""


@dataclass(frozen=True, eq=False)
class ConvLayer:
    """One convolution without padding, and the activation after it."""

    weight: NDArray[np.float32]
    """Shape (out_channels, in_channels, kernel, kernel)."""
    bias: NDArray[np.float32]
    """Shape (out_channels,)."""
    stride: int
    """Pixels between two positions of the kernel."""
    activation: str = "linear"
    """A name of `policies.activations.ACTIVATIONS`."""


@dataclass(frozen=True, eq=False)
class Normalization:
    """Computes `(x - mean) / std`, clipped to -/+ `clip`."""

    mean: NDArray[np.float32]
    """The mean, in the shape of an observation."""
    std: NDArray[np.float32]
    """The standard deviation, in the shape of an observation; > 0."""
    clip: float


@dataclass(frozen=True, eq=False)
class ModuleWeights:
    """What an RLModule of the user's own is rebuilt from."""

    class_path: str
    """`module:Class`."""
    model_config: dict[str, Any]
    tensors: Tensors = field(default_factory=dict)
    """The module's state by name."""


@dataclass(frozen=True, eq=False)
class PolicyNetwork:
    """The chain from observation to output, and what the output means (see the module)."""

    kind: NetworkKind
    layers: tuple[Layer, ...]
    """The layers; images are flattened before them, channel by channel."""
    action: int | tuple[float, ...] | None = None
    """The action, only of kind `constant`; for Box actions, one number for each component."""
    conv: tuple[ConvLayer, ...] = ()
    """The convolutions before the layers, for images of shape (height, width, channels)."""
    image: SeenImage | None = None
    """The image among the numbers of a vector that the convolutions see; the layers get what they make of it, and then
    the other numbers. None: observations are images as a whole, or there are no convolutions."""
    normalization: Normalization | None = None
    scale: float = 1.0
    """The factor that observations are multiplied by first."""
    module: ModuleWeights | None = None
    """The user's own module, only of kind `module`."""

    def parts(self) -> dict[str, tuple[NDArray[Any], ...]]:
        """Return all arrays of the network, by the names that messages use for them."""
        parts: dict[str, tuple[NDArray[Any], ...]] = {}
        if self.normalization is not None:
            parts["the observation statistics"] = (self.normalization.mean, self.normalization.std)
        parts |= {f"convolution {index}": (layer.weight, layer.bias) for index, layer in enumerate(self.conv)}
        parts |= {f"layer {index}": (layer.weight, layer.bias) for index, layer in enumerate(self.layers)}
        if self.module is not None:
            parts |= {name: (tensor,) for name, tensor in self.module.tensors.items()}
        return parts


# -- on disk


def network_to_json(network: PolicyNetwork) -> tuple[dict[str, Any], Tensors]:
    """Return a network as a JSON object and the tensors that it names; missing parts are left out."""
    # Made contiguous, because safetensors writes memory as it is, and would write a transposed view transposed.
    tensors: Tensors = {}
    description: dict[str, Any] = {
        "kind": network.kind,
        "activations": [layer.activation for layer in network.layers],
        "sizes": [layer.weight.shape[0] for layer in network.layers],
    }
    for index, layer in enumerate(network.layers):
        tensors[f"layers.{index}.weight"] = np.ascontiguousarray(layer.weight, dtype=np.float32)
        tensors[f"layers.{index}.bias"] = np.ascontiguousarray(layer.bias, dtype=np.float32)
    if network.action is not None:
        description["action"] = network.action
    if network.scale != 1.0:
        description["scale"] = network.scale
    if network.normalization is not None:
        description["normalization"] = {"clip": network.normalization.clip}
        tensors["normalization.mean"] = np.ascontiguousarray(network.normalization.mean, dtype=np.float32)
        tensors["normalization.std"] = np.ascontiguousarray(network.normalization.std, dtype=np.float32)
    if network.conv:
        description["conv"] = [{"stride": layer.stride, "activation": layer.activation} for layer in network.conv]
        for index, conv in enumerate(network.conv):
            tensors[f"conv.{index}.weight"] = np.ascontiguousarray(conv.weight, dtype=np.float32)
            tensors[f"conv.{index}.bias"] = np.ascontiguousarray(conv.bias, dtype=np.float32)
    if network.image is not None:
        description["image"] = _image_to_json(network.image)
    if network.module is not None:
        description["module"] = {"class": network.module.class_path, "model_config": network.module.model_config}
        for name, tensor in network.module.tensors.items():
            tensors[_MODULE_PREFIX + name] = np.ascontiguousarray(tensor)
    return description, tensors


def network_from_json(description: Mapping[str, Any], tensors: Tensors) -> PolicyNetwork:
    """Return the network that `network_to_json` described; the tensors it uses are removed from `tensors`.

    Raises:
        KeyError: A tensor or a field is missing.
        TypeError: A field has the wrong type.
        ValueError: A field has a wrong value.
    """
    layers = tuple(
        Layer(tensors.pop(f"layers.{index}.weight"), tensors.pop(f"layers.{index}.bias"), str(activation))
        for index, activation in enumerate(description["activations"])
    )
    conv = tuple(
        ConvLayer(
            tensors.pop(f"conv.{index}.weight"),
            tensors.pop(f"conv.{index}.bias"),
            stride=int(layer["stride"]),
            activation=str(layer["activation"]),
        )
        for index, layer in enumerate(description.get("conv", ()))
    )
    normalization = module = None
    if "normalization" in description:
        mean, std = tensors.pop("normalization.mean"), tensors.pop("normalization.std")
        normalization = Normalization(mean, std, clip=float(description["normalization"]["clip"]))
    if "module" in description:
        # Sorted, because safetensors returns them in another order each time.
        names = sorted(name for name in tensors if name.startswith(_MODULE_PREFIX))
        module = ModuleWeights(
            class_path=str(description["module"]["class"]),
            model_config=dict(description["module"]["model_config"]),
            tensors={name.removeprefix(_MODULE_PREFIX): tensors.pop(name) for name in names},
        )
    return PolicyNetwork(
        kind=description["kind"],
        layers=layers,
        action=_action_from_json(description.get("action")),
        conv=conv,
        image=_image_from_json(description.get("image")),
        normalization=normalization,
        scale=float(description.get("scale", 1.0)),
        module=module,
    )


def _image_to_json(image: SeenImage) -> dict[str, Any]:
    described = {**dataclasses.asdict(image), "shape": list(image.shape)}
    if not image.more:
        del described["more"]
    return described


def _image_from_json(value: Mapping[str, Any] | None) -> SeenImage | None:
    if value is None:
        return None
    height, width, channels = (int(size) for size in value["shape"])
    start, num_beside = int(value["start"]), int(value["num_beside"])
    more = tuple(
        Channels(int(each["start"]), int(each["num_channels"]), float(each["scale"])) for each in value.get("more", ())
    )
    return SeenImage((height, width, channels), start, num_beside, float(value["scale"]), more)


def _action_from_json(value: Any) -> int | tuple[float, ...] | None:
    if isinstance(value, list):
        return tuple(float(item) for item in value)
    return None if value is None else int(value)


# -- whether the parts fit


def network_problem(network: PolicyNetwork, observation_space: gym.Space[Any], action_space: ActionSpace) -> str:
    """Return why a network does not map these observations to these actions; empty if it does."""
    kind = network.kind
    if kind not in get_args(NetworkKind):
        return f"network kind {kind!r} is none of {', '.join(get_args(NetworkKind))}"
    if (network.module is None) is (kind == "module"):
        return f"a network of kind {kind!r} has {'no' if network.module is None else 'a'} module"
    if kind == "module" or kind in BASELINE_KINDS:
        if network.layers or network.conv:
            return f"a network of kind {kind!r} has {len(network.layers)} layers, but takes none"
        return "" if kind == "module" else _baseline_problem(network, action_space)
    sizes = sizes_of(action_space)
    if isinstance(observation_space, MaskedBox) and observation_space.sizes != sizes:
        return f"the mask is of choices of {observation_space.sizes} values, but the actions are of {sizes}"
    shape = seen_by_networks(observation_space).shape or ()
    return _normalization_problem(network.normalization, shape) or _chain_problem(network, shape, action_space)


def _chain_problem(network: PolicyNetwork, shape: tuple[int, ...], action_space: ActionSpace) -> str:
    """Return why convolutions and layers do not lead from observations of a shape to the actions."""
    if isinstance(action_space, gym.spaces.Box) is not (network.kind == "gaussian"):
        what = "box" if isinstance(action_space, gym.spaces.Box) else "discrete"
        return f"a network of kind {network.kind!r} gives no actions of type {what!r}"
    num_beside = 0
    if network.conv:
        if problem := _image_problem(network.image, shape):
            return problem
        if network.image is not None:
            shape, num_beside = network.image.shape, network.image.num_beside
        if problem := _conv_problem(network.conv, shape):
            return problem
        shape = output_shape(shape, conv_filters(network.conv))
    sizes = sizes_of(action_space)
    if network.kind == "q_values" and len(sizes) != 1:
        return f"a network of kind 'q_values' gives no actions of {len(sizes)} choices"
    num_actions = 2 * math.prod(action_space.shape) if isinstance(action_space, gym.spaces.Box) else sum(sizes)
    return _layers_problem(network.layers, math.prod(shape) + num_beside, num_actions)


def conv_filters(conv: tuple[ConvLayer, ...]) -> list[tuple[int, int, int]]:
    """Return the channels, the kernel size and the stride of each convolution."""
    return [(layer.weight.shape[0], layer.weight.shape[2], layer.stride) for layer in conv]


def _normalization_problem(normalization: Normalization | None, shape: tuple[int, ...]) -> str:
    if normalization is None:
        return ""
    for name in ("mean", "std"):
        found = getattr(normalization, name).shape
        if found != shape:
            return f"the normalization has a {name} of shape {found}, but observations are of shape {shape}"
    return "" if normalization.clip > 0 else f"the normalization clips at {normalization.clip}"


def _image_problem(image: SeenImage | None, shape: tuple[int, ...]) -> str:
    """Return why an image is not among the numbers of vectors of a shape."""
    if image is None:
        return ""
    bounds = [0, *(bound for place in image.places for bound in (place.start, place.stop)), image.num_seen]
    if shape == (image.num_seen,) and bounds == sorted(bounds):
        return ""
    starts = " and ".join(str(part.start) for part in image.parts)
    return f"an image of shape {image.shape} from number {starts} on is not in observations of shape {shape}"


def _conv_problem(conv: tuple[ConvLayer, ...], shape: tuple[int, ...]) -> str:
    channels = shape[-1] if shape else 0
    for index, layer in enumerate(conv):
        weight, bias = layer.weight, layer.bias
        if layer.activation not in ACTIVATIONS:
            return f"convolution {index} has activation {layer.activation!r}; known are {', '.join(ACTIVATIONS)}"
        if weight.ndim != 4 or weight.shape[1] != channels or weight.shape[2] != weight.shape[3] or layer.stride < 1:
            return (
                f"convolution {index} has weights of shape {weight.shape} and stride {layer.stride}, "
                f"but its input has {channels} channels"
            )
        if bias.shape != weight.shape[:1]:
            return f"convolution {index} has a bias of shape {bias.shape} but weights of shape {weight.shape}"
        channels = weight.shape[0]
    try:
        output_shape(shape, conv_filters(conv))
    except SpecError as error:
        return error.message.rstrip(".")
    return ""


def _layers_problem(layers: tuple[Layer, ...], num_inputs: int, num_outputs: int) -> str:
    size = num_inputs
    for index, layer in enumerate(layers):
        weight, bias = layer.weight, layer.bias
        if layer.activation not in ACTIVATIONS:
            return f"layer {index} has activation {layer.activation!r}; known are {', '.join(ACTIVATIONS)}"
        if weight.ndim != 2 or weight.shape[1] != size:
            return f"layer {index} has weights of shape {weight.shape}, but its input has {size} numbers"
        if bias.shape != weight.shape[:1]:
            return f"layer {index} has a bias of shape {bias.shape} but weights of shape {weight.shape}"
        size = weight.shape[0]
    if not layers:
        return "the network has no layers"
    return "" if size == num_outputs else f"the network has {size} outputs, but its actions need {num_outputs}"


def _baseline_problem(network: PolicyNetwork, action_space: ActionSpace) -> str:
    if network.kind == "random":
        return "" if network.action is None else f"a network of kind 'random' has the action {network.action!r}"
    return action_problem(network.action, action_space)


def action_problem(action: int | tuple[float, ...] | None, space: ActionSpace) -> str:
    """Return why an action is not in a space; empty if it is.

    Args:
        action: An int for Discrete actions; one number for each component or choice for others.
        space: The action space.
    """
    if isinstance(space, gym.spaces.Discrete):
        first, last = int(space.start), int(space.start) + int(space.n) - 1
        fits = isinstance(action, int) and first <= action <= last
        return "" if fits else f"{action!r} is none of the actions, which are the whole numbers {first} to {last}"
    size = math.prod(space.shape)
    numbers = f"a list of {size} number{'' if size == 1 else 's'}"
    if not isinstance(action, tuple) or len(action) != size:
        shown = list(action) if isinstance(action, tuple) else action
        return f"{shown!r} is none of the actions, each of which is {numbers}"
    values = np.array(action, dtype=np.float64).reshape(space.shape)
    if isinstance(space, Choices):
        fits = bool(((values == np.rint(values)) & (values >= 0) & (values < space.nvec)).all())
        whole = f"whole numbers from 0 to {[size - 1 for size in space.sizes]}"
        return "" if fits else f"{list(action)!r} is none of the actions, which are {whole}"
    # Compared in the space's own precision, or its bounds themselves would seem to lie outside.
    if not space.contains(values.astype(space.dtype)):
        return f"{list(action)!r} is none of the actions, which lie in {space.low.tolist()} to {space.high.tolist()}"
    return ""
