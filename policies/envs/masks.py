"""Masks of actions: which of its choices an environment allows in its present state.

A *mask* has a 1 for each value of each choice that is allowed, one choice after another, and a 0 for the others. It
travels as the first numbers of what is observed (`MaskedBox`), so that it is wherever an observation is: in batches,
replay memories, checkpoints' spaces, evaluations and videos. Networks see what is behind it.

An environment says its mask in one of three places, all known by one name: as a member of its Dict observations, by a
method, as Stable-Baselines3's contributions have it (`action_masks()`), or in the infos of reset and step. A method or
an info may also list the actions that are allowed, of which a mask is made.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from policies.envs.byte_images import as_bytes
from policies.envs.flat import FlatBox, needs_flattening
from policies.envs.given_numbers import numbers_of
from policies.envs.mask_settings import ACTION_MASK, METHOD, Setting, lists_actions, names_in
from policies.envs.mask_values import MaskProblemError, check_masks, checked_mask, is_one_mask, listed_mask
from policies.envs.own_actions import sizes_of
from policies.envs.signatures import needs_nothing
from policies.errors import EnvError, shortened

FORBIDDEN = float(np.finfo(np.float32).min)
"""The logit, or the Q-value, of what is not allowed: as good as minus infinity, but no NaN comes of it."""

Source = Literal["observation", "method", "info"]


class MaskedBox(gym.spaces.Box):
    """Vectors that begin with a mask.

    Args:
        seen: The space of what is behind the mask, which networks see; of images, the numbers in a row.
        sizes: How many values each choice of an action has.
        original: The environment's own space; None: that is not known, as of stacked frames.
        key: The member of the environment's Dict that is the mask; None: it does not come with the observation.
        lists_from: The number of the first action, if the environment lists those that are allowed; None: it gives
            zeros and ones.

    Attributes:
        seen, sizes, original, key, lists_from: The same.
        num_masked: How many numbers a mask has.
    """

    def __init__(
        self,
        seen: gym.spaces.Box,
        sizes: tuple[int, ...],
        *,
        original: gym.Space[Any] | None = None,
        key: str | None = None,
        lists_from: int | None = None,
    ) -> None:
        self.seen, self.sizes, self.original, self.key, self.lists_from = seen, sizes, original, key, lists_from
        self.num_masked = sum(sizes)
        mask = np.ones(self.num_masked, np.float32)
        with np.errstate(over="ignore"):
            low, high = (np.asarray(bound, np.float32).ravel() for bound in (seen.low, seen.high))
        super().__init__(np.concatenate([0 * mask, low]), np.concatenate([mask, high]), dtype=np.float32)

    @classmethod
    def of(
        cls, original: gym.Space[Any], sizes: tuple[int, ...], key: str | None, lists_from: int | None = None
    ) -> MaskedBox:
        """Return the space for an environment's own.

        Raises:
            ValueError: Neither vectors nor images can be made of what is observed.
        """
        seen = original
        if key is not None:
            assert isinstance(original, gym.spaces.Dict)
            seen = gym.spaces.Dict({name: space for name, space in original.spaces.items() if name != key})
        made = FlatBox(seen) if needs_flattening(seen) else seen
        assert isinstance(made, gym.spaces.Box)
        return cls(made, sizes, original=original, key=key, lists_from=lists_from)

    def joined(self, observation: Any, mask: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the vector for one observation of the environment's own and its mask.

        Raises:
            ValueError: The observation is not of the space.
        """
        seen = self.seen
        if isinstance(seen, FlatBox):
            numbers = seen.flat(observation)
        else:
            is_bytes = seen.dtype == np.uint8
            numbers = as_bytes(np.asarray(observation)) if is_bytes else np.asarray(observation, np.float32)
        if numbers.shape != seen.shape:
            raise ValueError(f"an observation of shape {numbers.shape}, not {seen.shape}")
        return np.concatenate([mask, numbers.ravel()])

    def joined_or_own(self, observations: Any, mask: Any) -> Any:
        """Return vectors with masks: what is one, or a batch of them, as it is; else made of observations and masks.

        Args:
            observations: Vectors with masks; or, with `mask`, what networks see; or one observation of the
                environment's own, or a list of such.
            mask: One for each observation; None: they are in the observations.

        Raises:
            ValueError: It is neither, or there is no mask.
        """
        if mask is None and self.key is not None:
            if isinstance(observations, Mapping):
                mask = self._mask_in(observations)
            elif isinstance(observations, list) and observations and isinstance(observations[0], Mapping):
                mask = [self._mask_in(one) for one in observations]
        if mask is None:
            if not self._begins(observations):
                raise ValueError("there is no mask")
            rows = numbers_of(observations, self)
            check_masks(rows[..., : self.num_masked], self.sizes)
            numbers_of(rows[..., self.num_masked :], self.seen)  # refuses what are no bytes, of an image of these
            return rows
        vectors = self._unmasked(observations)
        if vectors.ndim == 1:
            return np.concatenate([self._checked(mask), vectors])
        if is_one_mask(mask):
            raise ValueError(f"there is one mask, not one for each of {len(vectors)} observations")
        if len(mask) != len(vectors):
            raise ValueError(f"there are {len(mask)} masks for {len(vectors)} observations")
        masks = np.array([self._checked(one) for one in mask]).reshape(-1, self.num_masked)
        return np.concatenate([masks, vectors], axis=-1)

    def _unmasked(self, observations: Any) -> NDArray[Any]:
        """Return what networks see as vectors, shape (numbers,) or (num, numbers), without masks that there may be."""
        seen = self.seen
        array = np.asarray(seen.flat_or_own(observations) if isinstance(seen, FlatBox) else observations)
        num_dims, num_seen = len(seen.shape), math.prod(seen.shape)
        if array.shape[-num_dims:] == seen.shape:
            array = array.reshape(*array.shape[:-num_dims], num_seen)
        elif array.shape[-1:] != self.shape:
            raise ValueError(f"there is an observation of shape {array.shape[-num_dims:]}")
        return numbers_of(array[..., -num_seen:], seen)

    def _begins(self, observations: Any) -> bool:
        """Whether something is a vector that begins with a mask, or a batch of such."""
        try:
            return bool(np.shape(observations)[-1:] == self.shape)
        except ValueError:  # a tuple of members, of which no array can be made
            return False

    def _mask_in(self, observation: Mapping[str, Any]) -> Any:
        if self.key is None or self.key not in observation:
            raise ValueError(f"an observation with no member {self.key!r}")
        return observation[self.key]

    def _checked(self, mask: Any) -> NDArray[np.float32]:
        try:
            return self.mask_of(mask)
        except MaskProblemError as error:
            raise ValueError(f"{shortened(mask)} is the mask, {error}") from None

    def mask_of(self, given: Any) -> NDArray[np.float32]:
        """Return the mask for what an environment gives: zeros and ones, or a list of the actions that are allowed.

        Raises:
            MaskProblemError: It is something else, or a choice has no value that is allowed.
        """
        if self.lists_from is None:
            return checked_mask(given, self.sizes)
        return listed_mask(given, self.sizes[0], self.lists_from)

    @override
    def __repr__(self) -> str:
        return f"{self.seen!r} behind a mask of {self.num_masked} actions"


class NoMaskError(ValueError):
    """The mask that an environment's arguments name is none of its members, methods and infos.

    Args:
        message: Says so.
        infos: The infos that there are.
    """

    def __init__(self, message: str, infos: Any) -> None:
        super().__init__(message)
        self.infos = infos


class MasksActions(gym.Wrapper[Any, Any, Any, Any]):
    """Observes vectors that begin with the environment's mask.

    Args:
        env: Takes `Discrete` or `Choices`.
        space: The space of the vectors.
        source: Where the mask is.
        name: The name of the member, the method or the info.
    """

    def __init__(self, env: gym.Env[Any, Any], space: MaskedBox, source: Source, name: str) -> None:
        super().__init__(env)
        self.observation_space = self.space = space
        self.source, self.name = source, name
        self._num_steps = 0
        self._everything = np.ones(space.num_masked, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment.

        Raises:
            NoMaskError: There is no info of the mask's name.
            ValueError: Its observation or its mask is none.
        """
        observation, info = self.env.reset(seed=seed, options=options)
        self._num_steps = 0
        return self._joined(observation, info, is_over=False), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment.

        Raises:
            ValueError: Its observation or its mask is none. Where an episode has terminated there may be no mask, or
                one that forbids everything: nobody acts there.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._num_steps += 1
        return self._joined(observation, info, is_over=bool(terminated)), reward, terminated, truncated, info

    def _joined(self, observation: Any, info: Any, *, is_over: bool) -> NDArray[np.float32]:
        mask = self._mask(observation, info, is_over=is_over)
        try:
            return self.space.joined(observation, mask)
        except ValueError as error:
            raise ValueError(f"the environment returned {error}") from None

    def _mask(self, observation: Any, info: Any, *, is_over: bool) -> NDArray[np.float32]:
        when = (
            f"after env step {self._num_steps} of an episode" if self._num_steps else "at the beginning of an episode"
        )
        value: Any = None
        if self.source == "method":
            try:
                value = self.env.get_wrapper_attr(self.name)()
            except Exception:
                # A game that is over may have no actions to ask for.
                if is_over:
                    return self._everything
                raise
        else:
            holder = observation if self.source == "observation" else info
            try:
                value = holder[self.name]
            except (KeyError, TypeError, IndexError):
                if is_over:
                    return self._everything
                known = sorted(map(str, holder)) if isinstance(holder, Mapping) else shortened(holder)
                problem = f"there is no {self.place} {when}"
                if self.source == "observation":
                    raise ValueError(f"{problem}; there is {known}") from None
                if self.space.lists_from is None:
                    problem += ", nor such a member of the observations"
                problem += ", nor a method"
                raise NoMaskError(f"{problem}; there is {known or 'nothing'}", holder) from None
        try:
            return self.space.mask_of(value)
        except MaskProblemError as error:
            if is_over:
                return self._everything
            shown = shortened(np.asarray(value).tolist() if isinstance(value, np.ndarray) else value)
            raise ValueError(f"the environment gave {shown} as {self.place} {when}, {error}") from None

    @property
    def place(self) -> str:
        """Where the mask comes from, in words."""
        return f"{self.name}()" if self.source == "method" else f"{self.source}[{self.name!r}]"


def num_masked(space: gym.Space[Any]) -> int:
    """Return how many of the first numbers of an observation are a mask."""
    return space.num_masked if isinstance(space, MaskedBox) else 0


def seen_by_networks(space: gym.Space[Any]) -> gym.Space[Any]:
    """Return the space of what networks see of an observation."""
    return space.seen if isinstance(space, MaskedBox) else space


def sample(env: gym.Env[Any, Any], space: gym.Space[Any], observation: Any) -> Any:
    """Draw an action that is allowed, from a copy of an environment's action space, as plain a value as can be."""
    observed = env.observation_space
    if isinstance(observed, MaskedBox):
        action = draw_allowed(space, np.asarray(observation)[: observed.num_masked], observed.sizes)
    else:
        action = space.sample()
    # As RLlib sends it: NumPy scalars for Discrete actions fail `isinstance(action, int)` in some envs.
    return action.item() if isinstance(action, np.generic) else action


def draw_allowed(space: gym.Space[Any], mask: NDArray[Any], sizes: tuple[int, ...]) -> Any:
    """Draw an action of a space, uniformly from what a mask allows."""
    blocks = np.split(mask.astype(np.int8), np.cumsum(sizes)[:-1])
    return space.sample(mask=blocks[0] if isinstance(space, gym.spaces.Discrete) else tuple(blocks))


def masked(env: gym.Env[Any, Any], setting: Setting) -> Any:
    """Return an environment that observes its mask before all else: itself if it has none, or none is wanted.

    Args:
        env: Takes the actions that policies give.
        setting: The name of the mask, or of a list of the actions that are allowed (see
            `policies.envs.mask_settings`); True: `action_mask`, or a method `action_masks`; None: the same, but not if
            it were an info; False: what there may be is no mask.

    Raises:
        EnvError: The mask that is named cannot be one.
    """
    found = _find(env, setting)
    if found is None:
        return env
    source, name = found
    sizes, env_id = sizes_of(env.action_space), _name(env)
    place = {"observation": "the member", "method": "the method", "info": "the info"}[source]
    if not sizes:
        if setting is None:
            return env
        raise EnvError(
            f"{env_id} has {ACTION_MASK} {setting!r}, but its actions are no choices ({env.action_space}): only choices"
            " can be forbidden.",
            f"Leave env.{ACTION_MASK} out, or set it to false.",
        )
    hint = f"Mend the env, or set env.{ACTION_MASK}: false, and {place} {name!r} is no mask."
    observed = env.observation_space
    if source == "observation":
        assert isinstance(observed, gym.spaces.Dict)
        if problem := member_problem(observed, name, sizes):
            raise EnvError(f"{env_id} observes a mask of actions, {name!r}, {problem}.", hint)
    lists_from = _first_listed(env, setting) if lists_actions(setting) else None
    try:
        space = MaskedBox.of(observed, sizes, name if source == "observation" else None, lists_from)
    except ValueError:
        # Said by who checks the environment.
        return env
    return MasksActions(env, space, source, name)


def _first_listed(env: gym.Env[Any, Any], setting: Setting) -> int:
    """Return the number of the first action of an environment that lists those that are allowed.

    Raises:
        EnvError: Its actions have no numbers.
    """
    if isinstance(env.action_space, gym.spaces.Discrete):
        return int(env.action_space.start)
    raise EnvError(
        f"{_name(env)} has {ACTION_MASK} {setting!r}, but its actions are no single choice ({env.action_space}): they "
        "have no numbers that could be listed.",
        f"Let it give zeros and ones, one for each value of each choice, and write env.{ACTION_MASK}: "
        f"{names_in(setting)[0]}.",
    )


def may_be_masked(creator: Any, setting: Setting) -> bool:
    """Whether what a class, or a function, makes may be masked, as a vectorised version of it would not be."""
    return bool(setting) or (setting is None and hasattr(creator, METHOD))


def _find(env: gym.Env[Any, Any], setting: Setting) -> tuple[Source, str] | None:
    """Return where the mask is, and its name."""
    if setting is False:
        return None
    observed = env.observation_space
    members = observed.spaces if isinstance(observed, gym.spaces.Dict) else {}
    name, method = names_in(setting)
    # A member of a fixed size is no list of a few actions.
    if name in members and not lists_actions(setting):
        return "observation", name
    if env.has_wrapper_attr(method) and needs_nothing(env.get_wrapper_attr(method)):
        return "method", method
    return None if setting is None else ("info", name)


def member_problem(observed: gym.spaces.Dict, name: str, sizes: tuple[int, ...]) -> str:
    """Return why a member of observations is no mask of so many values of choices, by its space; or nothing."""
    if len(observed.spaces) == 1:
        return "and nothing else"
    member = observed[name]
    # A Tuple has an array for each choice, in their order.
    parts = member.spaces if isinstance(member, gym.spaces.Tuple) else [member]
    found = [None if part.shape is None else math.prod(part.shape) for part in parts]
    if found in ([sum(sizes)], list(sizes)):
        return ""
    choices = f", of the choices {list(sizes)}" if len(sizes) > 1 else ""
    return f"of {shortened(member)}, but there are {sum(sizes)} actions to allow{choices}"


def _name(env: gym.Env[Any, Any]) -> str:
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
