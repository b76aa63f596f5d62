"""Wrappers that change observations, and one that changes the rewards of training.

Frames and pixels belong to the environment: the observations are the same in training, evaluation and videos.
So they travel in the env arguments, under the reserved keys `frame_stack` and `pixels`, and so do `atari`
(`policies.envs.atari`), the name of the mask of actions, `action_mask`, and `own_process`
(`policies.envs.own_process`). The failure penalty belongs to training
alone, and is never among the env arguments.

Words: a *frame* is one observation; an *image* is of shape (rows, columns, channels).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from policies.envs.atari import ATARI, AtariFrames
from policies.envs.failures import FailureRule
from policies.envs.flat import FlatBox, flattened
from policies.envs.mask_settings import ACTION_MASK, Setting, check_setting
from policies.envs.masks import MaskedBox, masked, num_masked
from policies.envs.own_actions import with_own_actions
from policies.envs.own_process import OWN_PROCESS
from policies.envs.rendering import picture_of
from policies.envs.stacked import StackedBox
from policies.envs.training_view import TrainingView
from policies.errors import EnvError

FRAME_STACK, PIXELS = "frame_stack", "pixels"
RESERVED = (FRAME_STACK, PIXELS, ATARI, ACTION_MASK, OWN_PROCESS)
"""The reserved keys."""
MAX_PIXELS = 64
"""The most rows and columns that `shrink_to_grey` makes."""

# Shares of red, green and blue in the perceived brightness (ITU-R BT.601).
_LUMA = np.array([0.299, 0.587, 0.114])
_Wrapper = TypeVar("_Wrapper", bound=gym.Wrapper[Any, Any, Any, Any])


@dataclass(frozen=True)
class ObservationWrappers:
    """The wrappers that an environment gets around its time limit: pixels or Atari's, its mask of actions, frames."""

    frame_stack: int = 1
    pixels: bool = False
    action_mask: Setting = None
    atari: AtariFrames | None = None
    own_process: bool = False
    """Whether the environment is in a process of its own, without these wrappers."""

    @property
    def observes_images(self) -> bool:
        """Whether an environment observes images by one of these wrappers."""
        return self.pixels or self.atari is not None

    @classmethod
    def take_from(cls, env_args: dict[str, Any]) -> ObservationWrappers:
        """Take the reserved keys out of an environment's arguments; the arguments of its constructor are left.

        Raises:
            EnvError: A value has the wrong type.
        """
        frames, pixels = env_args.pop(FRAME_STACK, 1), env_args.pop(PIXELS, False)
        mask = check_setting(env_args.pop(ACTION_MASK, None))
        if isinstance(frames, bool) or not isinstance(frames, int) or frames < 1:
            raise EnvError(f"{FRAME_STACK} is {frames!r}; it must be a whole number >= 1.", "1 stacks nothing.")
        if not isinstance(pixels, bool):
            raise EnvError(f"{PIXELS} is {pixels!r}; it must be true or false.", "Set it to true, or leave it out.")
        own_process = env_args.pop(OWN_PROCESS, False)
        if not isinstance(own_process, bool):
            raise EnvError(f"{OWN_PROCESS} is {own_process!r}; it must be true or false.", "Leave it out for false.")
        atari = AtariFrames.take_from(env_args)
        if mask and (pixels or atari is not None):
            which = f"{PIXELS} true" if pixels else f"{ATARI} is set"
            raise EnvError(
                f"{ACTION_MASK} is {mask!r} and {which}: masks go with what an environment itself observes, "
                "not with pictures of it.",
                f"Leave {PIXELS if pixels else ATARI} out, or set {ACTION_MASK}: false.",
            )
        if own_process and atari is not None:
            raise EnvError(
                f"{OWN_PROCESS} is true and {ATARI} is set: its games read their emulator's memory.",
                f"Leave {OWN_PROCESS} out: a process can hold many of these games.",
            )
        return cls(frames, pixels, mask, atari, own_process)

    def wrap(self, env: gym.Env[Any, Any], env_args: Mapping[str, Any]) -> gym.Env[Any, Any]:
        """Return an environment with these wrappers; for pixels, it must have been made with a render mode.

        It takes actions as policies give them, and what it observes is made vectors, or images.

        Args:
            env: The environment.
            env_args: The arguments of its constructor, with those of its registry entry.

        Raises:
            EnvError: It has not the mask that is named.
        """
        env = flattened(self.wrap_mask(self.wrap_images(env, env_args)))
        return StackFrames(env, self.frame_stack) if self.frame_stack > 1 else env

    def wrap_mask(self, env: gym.Env[Any, Any]) -> Any:
        """Return an environment that takes actions as policies give them, and observes which of them are allowed.

        Raises:
            EnvError: It has not the mask that is named.
        """
        return masked(with_own_actions(env), False if self.observes_images else self.action_mask)

    def wrap_images(self, env: gym.Env[Any, Any], env_args: Mapping[str, Any]) -> Any:
        """Return an environment that observes images, if they are wanted, else the environment itself."""
        if self.atari is not None:
            return self.atari.wrap(env, env_args)
        return ObservePixels(env) if self.pixels else env

    def wrap_vector(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> gym.vector.VectorEnv[Any, Any, Any]:
        """Return a vector environment with stacked frames; its sub-environments have the pixels already."""
        return StackFramesVector(env, self.frame_stack) if self.frame_stack > 1 else env


def wrapper_of(env: gym.Env[Any, Any], kind: type[_Wrapper]) -> _Wrapper | None:
    """Return the outermost wrapper of a kind around an environment; None: there is none."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, kind):
            return env
        env = env.env
    return None


def with_wrappers(
    env_args: Mapping[str, Any],
    *,
    frame_stack: int,
    pixels: bool,
    action_mask: Setting = None,
    atari: Mapping[str, int] | None = None,
    own_process: bool = False,
) -> dict[str, Any]:
    """Return env arguments with the reserved keys of those wrappers that change something."""
    wrapped = dict(env_args)
    if frame_stack > 1:
        wrapped[FRAME_STACK] = frame_stack
    if pixels:
        wrapped[PIXELS] = True
    if action_mask is not None:
        wrapped[ACTION_MASK] = action_mask
    if atari is not None:
        wrapped[ATARI] = dict(atari)
    if own_process:
        wrapped[OWN_PROCESS] = True
    return wrapped


def wrapped_by(env_args: Mapping[str, Any]) -> str:
    """Return what changes an environment's observations, as a sweep file has it: `frame_stack: 4 and atari`."""
    frames = env_args.get(FRAME_STACK, 1)
    found = [f"{FRAME_STACK}: {frames}"] if frames != 1 else []
    found += [f"{PIXELS}: true"] if env_args.get(PIXELS) else []
    found += [ATARI] if env_args.get(ATARI) is not None else []
    return " and ".join(found)


def constructor_args(env_args: Mapping[str, Any]) -> dict[str, Any]:
    """Return env arguments without the reserved keys."""
    return {name: value for name, value in env_args.items() if name not in RESERVED}


def shrink_to_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a small grey picture of a large coloured one, made of the mean brightness of square blocks.

    Blocks are the smallest that give at most `MAX_PIXELS` rows and columns; what is left over at the edges is cut off
    in equal parts. CartPole's (400, 600, 3) become (40, 60, 1).

    Args:
        picture: uint8 of shape (rows, columns, 3), as environments render.

    Returns:
        uint8 of shape (small rows, small columns, 1).
    """
    size = max(1, math.ceil(max(picture.shape[:2]) / MAX_PIXELS))
    rows, columns = (max(1, length // size) for length in picture.shape[:2])
    top, left = (picture.shape[0] - rows * size) // 2, (picture.shape[1] - columns * size) // 2
    if top < 0 or left < 0:  # the picture is so narrow that not even one block fits
        return _grey(picture.mean(axis=(0, 1), keepdims=True))
    cut = picture[top : top + rows * size, left : left + columns * size]
    # Rows first, with whole lines in one addition: several times faster than one mean over both axes.
    sums = cut.reshape(rows, size, columns * size * 3).sum(axis=1, dtype=np.uint32)
    sums = sums.reshape(rows, columns, size, 3).sum(axis=2)
    return _grey(sums / (size * size))


def _grey(means: NDArray[Any]) -> NDArray[np.uint8]:
    grey: NDArray[np.uint8] = np.rint(means @ _LUMA).astype(np.uint8)[..., None]
    return grey


class ObservePixels(gym.ObservationWrapper[Any, Any, Any]):
    """Observe small grey images of what the environment renders, uint8 of shape (rows, columns, 1).

    Rendering stays as it is: a video shows the whole picture.

    Args:
        env: Made with render_mode "rgb_array".

    Raises:
        EnvError: It renders no pictures.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        # An environment renders only after a reset, and nothing else tells the size of its pictures.
        env.reset(seed=0)
        image = self.observation(None)
        self.observation_space = gym.spaces.Box(0, 255, image.shape, np.uint8)

    def observation(self, observation: Any) -> NDArray[np.uint8]:
        """Return the picture of this moment in place of the environment's own observation."""
        del observation
        picture: Any = self.env.render()
        if not isinstance(picture, np.ndarray) or picture.ndim != 3 or picture.shape[2] not in (3, 4):
            raise EnvError(
                f"{_name(self.env)} has pixels: true, but renders {type(picture).__name__} of shape "
                f"{np.shape(picture)}, not a picture of shape (rows, columns, 3).",
                "Mend its render() for the mode 'rgb_array', or leave pixels out.",
            )
        seen = picture_of(picture)
        return shrink_to_grey(picture[:, :, :3] if seen is None else seen)


def _stacked_space(env_id: str, space: gym.Space[Any], num_frames: int) -> gym.spaces.Box:
    if not isinstance(space, gym.spaces.Box) or len(space.shape) not in (1, 3):
        raise EnvError(
            f"{env_id} has {FRAME_STACK} {num_frames}, but its observations are {space}: only vectors and images can "
            "be stacked.",
            f"Leave {FRAME_STACK} out, or choose another env.",
        )
    seen = space.seen if isinstance(space, MaskedBox) else space
    if seen is not space and len(seen.shape) > 1:
        raise EnvError(
            f"{env_id} has {FRAME_STACK} {num_frames}, a mask of actions, and images of shape {seen.shape} as "
            "observations: images with a mask cannot be stacked.",
            f"Let a wrapper of your own stack them below the mask, or set {ACTION_MASK}: false.",
        )
    stacked = _stacked_box(seen, num_frames, space.dtype)
    return MaskedBox(stacked, space.sizes, lists_from=space.lists_from) if isinstance(space, MaskedBox) else stacked


def _stacked_box(seen: gym.spaces.Box, num_frames: int, dtype: Any) -> gym.spaces.Box:
    if isinstance(seen, FlatBox) and len(seen.shape) == 1:
        return StackedBox(seen, num_frames)
    # Bounds beyond what 32 bits hold, which vectors behind a mask are of, are infinite there.
    with np.errstate(over="ignore"):
        low, high = (np.concatenate([bound] * num_frames, axis=-1).astype(dtype) for bound in (seen.low, seen.high))
    return gym.spaces.Box(low, high, dtype=dtype.type)


class StackFrames(gym.Wrapper[Any, Any, Any, Any]):
    """Observe the last frames at once, oldest first; after a reset they are all the first observation.

    Vectors of n numbers are joined into one of shape (num_frames * n,), images along their channels. Of masks there is
    only the newest, before them all.

    Raises:
        EnvError: The observations are neither vectors nor images.
    """

    def __init__(self, env: gym.Env[Any, Any], num_frames: int) -> None:
        super().__init__(env)
        self.num_frames = num_frames
        self.observation_space = _stacked_space(_name(env), env.observation_space, num_frames)
        self._num_masked = num_masked(env.observation_space)
        self._stack: NDArray[Any] = np.zeros(0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and fill the stack with its observation."""
        frame, info = self.env.reset(seed=seed, options=options)
        self._stack = _filled(np.asarray(frame), self.num_frames, self._num_masked)
        return self._stack, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment; its observation replaces the oldest one."""
        frame, reward, terminated, truncated, info = self.env.step(action)
        self._stack = _push(self._stack, np.asarray(frame), self._num_masked)
        return self._stack, reward, terminated, truncated, info


class StackFramesVector(gym.vector.VectorWrapper):
    """`StackFrames` for every sub-environment: observations have the shape (num_envs, ..., num_frames * n).

    It is for vector environments that reset in the step after an episode's end, as `make_vector_env` makes them.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], num_frames: int) -> None:
        super().__init__(env)
        self.num_frames = num_frames
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        self.single_observation_space = _stacked_space(name, env.single_observation_space, num_frames)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._num_masked = num_masked(env.single_observation_space)
        self._stack: NDArray[Any] = np.zeros(0)
        self._ended = np.zeros(env.num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all sub-environments and fill their stacks."""
        frames, info = self.env.reset(seed=cast("int | None", seed), options=options)
        self._stack = _filled(frames, self.num_frames, self._num_masked)
        self._ended = np.zeros(self.num_envs, dtype=np.bool_)
        return self._stack, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all sub-environments; where the step only reset an ended episode, the stack begins anew."""
        frames, rewards, terminated, truncated, info = self.env.step(actions)
        stack = _push(self._stack, frames, self._num_masked)
        if self._ended.any():
            stack[self._ended] = _filled(frames[self._ended], self.num_frames, self._num_masked)
        self._stack, self._ended = stack, np.logical_or(terminated, truncated)
        return stack, rewards, terminated, truncated, info


def _filled(frames: NDArray[Any], num_frames: int, num_masked: int) -> NDArray[Any]:
    """Return stacks of equal frames, each with one mask before them."""
    return np.concatenate([frames[..., :num_masked]] + [frames[..., num_masked:]] * num_frames, axis=-1)


def _push(stack: NDArray[Any], frames: NDArray[Any], num_masked: int) -> NDArray[Any]:
    """Return the stack with new frames, as a new array, because callers may keep the old one."""
    mask, new = frames[..., :num_masked], frames[..., num_masked:]
    return np.concatenate([mask, stack[..., num_masked + new.shape[-1] :], new], axis=-1)


class FailurePenalty(TrainingView):
    """Replaces the reward of a step that ends an episode by failure; for training alone."""

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], rule: FailureRule, penalty: float) -> None:
        super().__init__(env)
        self.rule, self.penalty = rule, float(penalty)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all sub-environments."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        self.own_rewards = rewards
        # A vectorised version may give whole numbers, in which the penalty would lose its decimals.
        dtype = np.result_type(rewards.dtype, np.float32)
        penalized = np.where(self.rule.failed(rewards, terminated), self.penalty, rewards).astype(dtype)
        return observations, penalized, terminated, truncated, info


def _name(env: gym.Env[Any, Any]) -> str:
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
