"""Policies that act, computed by NumPy alone: a network read from a portable file, or a random policy.

`Policy.act` takes one observation, shape (n,) or (height, width, channels), and gives one action ready for `env.step`,
or takes a batch, shape (num, ...), and gives a batch of actions. Acting is greedy, among the actions that a mask
allows if the environment has one. The actions are in the environment's own form (`policies.envs.own_actions`), shifted
by the start of a Discrete space, and for Box actions transformed as the policy file says:

* `unsquash`: the network's [-1, 1] is stretched over the bounds and clipped to them; all of them are finite.
* `by_component`: the same for components with two bounds; the others are clipped to the bound that they have.
* `clip`: clipped to the bounds. So are actions of older files that say `unsquash` though a bound is infinite: their
  policies were trained on actions as they are.
"""

from __future__ import annotations

import copy
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from policies import random_streams
from policies.envs.action_bounds import ToBounds
from policies.envs.checked import unsound_number
from policies.envs.flat import FlatBox
from policies.envs.given_numbers import numbers_of
from policies.envs.make import check_env, make_env
from policies.envs.mask_hints import argument_hint
from policies.envs.mask_settings import ACTION_MASK
from policies.envs.masks import FORBIDDEN, MaskedBox, draw_allowed, num_masked, seen_by_networks
from policies.envs.own_actions import Choices, TakesOwnActions, is_made, own_actions
from policies.envs.wrappers import wrapped_by
from policies.errors import NonFiniteWeightsError, ObservationError, TuneJobsError
from policies.portable.file import (
    ActionTransform,
    PolicyNetwork,
    PortablePolicy,
    space_from_description,
)
from policies.portable.forward import ForwardPass

ActionSpace = gym.spaces.Box | gym.spaces.Discrete[Any] | Choices
Action = int | NDArray[Any]
"""What `act_on_rows` gives for a row."""


NON_FINITE_HINT = "Lower the learning rate, or set grad_clip; scale rewards and observations down if they are large."


class Policy(ABC):
    """Acts greedily in an environment; the base class of all policies.

    Args:
        observation_space: The space of the observations it takes.
        action_space: The space of the actions it gives.
        env_id: The environment it is for.
        env_args: The arguments of that environment.
        description: What it is, in a few words; captions and messages show it.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        *,
        env_id: str,
        env_args: Mapping[str, Any] | None,
        description: str,
    ) -> None:
        self.observation_space = observation_space
        self.action_space = action_space
        self.env_id = env_id
        self.env_args = dict(env_args or {})
        self.description = description

    def act(self, observations: Any, mask: Any = None) -> Any:
        """Return the greedy action for one observation, or for each observation of a batch.

        Args:
            observations: Shape: that of one observation, or (num, *that shape). Where observations were made vectors
                (`policies.envs.flat`), also what the environment itself gives: a dict, a tuple, a choice.
            mask: Which actions are allowed: zeros and ones, one for each value of each choice, or a batch of such; or
                lists of the actions that are allowed, if that is what it was trained with. It is needed where the
                environment says it in its infos or by a method; one that is a member of the observations is read there.

        Returns:
            For one observation, what `env.step` takes: an int (Discrete), an array (Box, MultiDiscrete, MultiBinary),
            or a dict or tuple of these. For a batch, an array of shape (num,) or (num, *shape of an action), or a list
            of dicts or tuples.

        Raises:
            ObservationError: The observations have another shape, are not numbers or not finite, or of an image of
                bytes no bytes; there is no mask where one is needed, one that is none, or one that a policy trained
                without masks can't use.
        """
        space = self.observation_space
        shape = space.shape or ()
        try:
            if isinstance(space, MaskedBox):
                observations = space.joined_or_own(observations, mask)
            elif mask is not None:
                raise ValueError("there is a mask, but it was trained without one")  # noqa: TRY301 (as the others)
            elif isinstance(space, FlatBox):
                observations = space.flat_or_own(observations)
            batch = numbers_of(observations, space)
        except (TypeError, ValueError, OverflowError) as error:
            hint = self._what_to_pass()
            if isinstance(space, MaskedBox) and not wrapped_by(self.env_args):
                hint += argument_hint(space, self.env_args.get(ACTION_MASK))
            raise ObservationError(
                f"Observations of {self.env_id} must be {self._wanted()}: {error}.", f"{hint}."
            ) from error
        single = batch.ndim == len(shape)
        if batch.shape[-len(shape) :] != shape or batch.ndim > len(shape) + 1:
            raise ObservationError(
                f"The observations are of shape {batch.shape}; this policy ({self.env_id}) takes one of "
                f"shape {shape}, or a batch of them.",
                f"{self._what_to_pass()}.",
            )
        if problem := unsound_number(batch, space):
            raise ObservationError(
                f"Observations of {self.env_id} must be finite: one was {problem}.", f"{self._what_to_pass()}."
            )
        batch = np.asarray(batch, dtype=np.float32)
        actions = self._act_batch(batch[None] if single else batch)
        if not single:
            return own_actions(self.action_space, actions)
        if is_made(self.action_space):
            return self.action_space.own(actions[0])
        return int(actions[0]) if isinstance(self.action_space, gym.spaces.Discrete) else actions[0]

    def make_env(self, *, render_mode: str | None = None) -> gym.Env[Any, Any]:
        """Make the environment that it was trained in: `act` takes what that observes, and it takes what `act` gives.

        It has the arguments and the time limit of training, and the wrappers: frames that are stacked, pixels, those of
        Atari's games, and a mask of actions, which is then among what is observed.

        Args:
            render_mode: One of the environment's, as `human` or `rgb_array`; None: nothing is drawn.

        Raises:
            EnvError: It cannot be made here, or its module is not allowed (`tune_jobs.allow_modules`).
        """
        env = make_env(self.env_id, self.env_args, render_mode=render_mode)
        return TakesOwnActions(env, env.action_space.original) if is_made(env.action_space) else env

    def act_on_row(self, observation: NDArray[Any]) -> Action:
        """Return the greedy action for one vector or image, as environments of `policies.envs.make` take it."""
        if type(self).act is not Policy.act:
            # A class of somebody's own, which acts as it says, in the environment's own form.
            action = self.act(observation)
            return self.action_space.given_for(action) if is_made(self.action_space) else cast("Action", action)
        (action,) = self._act_batch(np.asarray(observation, dtype=np.float32)[None])
        return int(action) if isinstance(self.action_space, gym.spaces.Discrete) else cast("NDArray[Any]", action)

    def act_on_rows(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Return the greedy actions, shape (num,) or (num, action_dim), for vectors or images of shape (num, ...)."""
        if type(self).act is not Policy.act:
            # A class of somebody's own, which acts as it says, in the environment's own form.
            actions = self.act(observations)
            if is_made(space := self.action_space):
                actions = [space.given_for(action) for action in actions]
            return np.asarray(actions)
        return self._act_batch(np.asarray(observations, dtype=np.float32))

    def _what_to_pass(self) -> str:
        """Return what `act` takes, for hints."""
        passed, wrapped = "Pass what env.reset or env.step returned", wrapped_by(self.env_args)
        if not wrapped:
            return passed
        return f"{passed}, of an env with {wrapped}, with which it was trained: env = policy.make_env()"

    def _wanted(self) -> str:
        space = self.observation_space
        if isinstance(space, MaskedBox):
            beside = "" if space.key is not None else "with a mask, "
            own = "" if space.original is None else f"of {space.original} {beside}".rstrip(", ") + ", or "
            return f"{own}{space.num_masked} zeros and ones and then numbers of shape {space.seen.shape}"
        numbers = f"numbers of shape {space.shape}"
        return f"of {space.original}, or {numbers}" if isinstance(space, FlatBox) else numbers

    def check_finite(self) -> None:  # noqa: B027 (a baseline has no weights)
        """Raise an error unless all weights are finite.

        Raises:
            NonFiniteWeightsError: A weight is NaN or infinite; the message names its layer.
        """

    @abstractmethod
    def _act_batch(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return the actions for observations of shape (num, ...)."""


class WeightsPolicy(Policy):
    """Acts by the weights of a portable policy; the base class of all policies that have weights.

    Args:
        portable: The weights and their spaces.
        description: Shown in captions; by default the algorithm and the env.
    """

    def __init__(self, portable: PortablePolicy, description: str | None = None) -> None:
        action_space = space_from_description(portable.action_space)
        super().__init__(
            space_from_description(portable.observation_space),
            action_space,
            env_id=portable.env_id,
            env_args=portable.env_args,
            description=description or f"{portable.algorithm.upper()} on {portable.env_id}",
        )
        self.portable = portable
        self._to_actions = action_function(portable, action_space)

    @override
    def check_finite(self) -> None:
        check_finite_tensors(self.portable.network, self.description)


class NetworkPolicy(WeightsPolicy):
    """Acts greedily by a portable network.

    To the last bit, the action for an observation does not depend on what else is in its batch. So an episode is the
    same whether it is evaluated alone, evaluated beside others, or filmed.

    Args:
        portable: The network and its spaces.
        description: Shown in captions; by default the algorithm and the env.
    """

    def __init__(self, portable: PortablePolicy, description: str | None = None) -> None:
        super().__init__(portable, description)
        self._forward = ForwardPass(portable.network)
        self._num_masked = num_masked(self.observation_space)
        self._seen_shape = seen_by_networks(self.observation_space).shape or ()

    def outputs(self, observations: ArrayLike) -> NDArray[np.float32]:
        """Return the network's raw output: logits, means and log standard deviations, Q-values, or advantages.

        Args:
            observations: Shape (num, n), or (num, height, width, channels), with their masks if there are some.

        Returns:
            Shape (num, num_outputs); `FORBIDDEN` where a mask forbids the action.
        """
        rows = np.asarray(observations, dtype=np.float32)
        if not self._num_masked:
            return self._forward(rows)
        # One piece of memory: what a row gives may not depend on how it lies there.
        seen = np.ascontiguousarray(rows[:, self._num_masked :]).reshape(-1, *self._seen_shape)
        outputs = self._forward(seen)
        return np.where(rows[:, : self._num_masked] > 0, outputs, np.float32(FORBIDDEN))

    def _act_batch(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        return self._to_actions(self.outputs(observations))


class RandomPolicy(Policy):
    """Draws actions uniformly from the action space, or from what a mask allows, as `action_space.sample()` does.

    Args:
        observation_space: The env's; only its shape, its type and its mask matter.
        action_space: The space that actions are drawn from.
        env_id: The environment it is for.
        env_args: The arguments of that environment.
        seed: The first seed; `reset` sets another.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        *,
        env_id: str,
        env_args: Mapping[str, Any] | None = None,
        seed: int = 0,
    ) -> None:
        # A copy: a space has one generator, and the env's own must not be touched.
        own_space = copy_space(action_space)
        super().__init__(observation_space, own_space, env_id=env_id, env_args=env_args, description="random policy")
        self.reset(seed)

    @classmethod
    def for_env(cls, env_id: str, env_args: Mapping[str, Any] | None = None, *, seed: int = 0) -> RandomPolicy:
        """Return a random policy for an environment.

        Raises:
            EnvError: The environment cannot be made, or its spaces are not supported.
        """
        info = check_env(env_id, env_args)
        return cls(info.observation_space, info.action_space, env_id=info.env_id, env_args=info.env_args, seed=seed)

    def reset(self, seed: int) -> None:
        """Seed the random numbers anew: the same seed gives the same actions."""
        self.action_space.seed(random_streams.random_actions_seed(seed))

    def _act_batch(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        space, observed = self.action_space, self.observation_space
        if isinstance(observed, MaskedBox):
            actions = [draw_allowed(space, row[: observed.num_masked], observed.sizes) for row in observations]
        else:
            actions = [space.sample() for _ in range(len(observations))]
        return np.array(actions).reshape(len(observations), *(self.action_space.shape or ()))


def copy_space(space: gym.Space[Any]) -> ActionSpace:
    """Return a copy of a space, with a random generator of its own."""
    if is_made(space):
        # The original draws, too.
        return type(space)(copy.deepcopy(space.original))
    if isinstance(space, gym.spaces.Box):
        return gym.spaces.Box(space.low, space.high, space.shape, cast("Any", space.dtype))
    if isinstance(space, gym.spaces.Discrete):
        return gym.spaces.Discrete(int(space.n), start=int(space.start))
    raise TuneJobsError(f"Actions of kind {type(space).__name__} are not supported.", "Use Box or Discrete actions.")


def check_finite_tensors(network: PolicyNetwork, description: str) -> None:
    """Raise an error unless all numbers of a network are finite.

    Args:
        network: A network of any kind.
        description: The policy's description, for the message.

    Raises:
        NonFiniteWeightsError: A weight or a statistic is NaN or infinite; the message says where.
    """
    for place, arrays in network.parts().items():
        count = sum(int(array.size - np.isfinite(array).sum()) for array in arrays)
        if count:
            raise NonFiniteWeightsError(
                f"The policy {description!r} has {count} weights that are NaN or infinite in {place}.",
                NON_FINITE_HINT,
            )


def action_function(
    portable: PortablePolicy, action_space: ActionSpace
) -> Callable[[NDArray[np.float32]], NDArray[Any]]:
    """Return the function that turns a network's outputs, shape (num, num_outputs), into actions for the env."""
    if isinstance(action_space, gym.spaces.Discrete):
        start = int(action_space.start)
        return functools.partial(_largest, start=start)
    if isinstance(action_space, Choices):
        return functools.partial(largest_of_each, sizes=action_space.sizes)
    low, high = action_space.low, action_space.high
    size = math.prod(action_space.shape)
    transform = portable.action_transform
    to_bounds = ToBounds(action_space)
    if transform == "by_component" or (transform == "unsquash" and to_bounds.stretches_all):
        return functools.partial(_within, size=size, to_bounds=to_bounds)
    if transform == "none":
        return functools.partial(_as_they_are, size=size, dtype=low.dtype)
    return functools.partial(_clipped, low=low, high=high)


# No closures: a policy can be pickled, for other processes.


def _largest(outputs: NDArray[Any], start: int) -> NDArray[np.int64]:
    places: NDArray[np.int64] = np.argmax(outputs, axis=1)
    return places + start


def _within(outputs: NDArray[Any], size: int, to_bounds: ToBounds) -> NDArray[Any]:
    return to_bounds(outputs[:, :size])


def _as_they_are(outputs: NDArray[Any], size: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    return outputs[:, :size].astype(dtype)


def _clipped(outputs: NDArray[Any], low: NDArray[Any], high: NDArray[Any]) -> NDArray[Any]:
    clipped: NDArray[Any] = np.clip(outputs[:, : low.size], low, high).astype(low.dtype)
    return clipped


def largest_of_each(outputs: NDArray[Any], sizes: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the place of each choice's largest output, (..., choices), of outputs of shape (..., sum of sizes)."""
    blocks = np.split(outputs, np.cumsum(sizes)[:-1], axis=-1)
    return np.stack([block.argmax(axis=-1) for block in blocks], axis=-1)


def action_transform(action_space: gym.Space[Any]) -> ActionTransform:
    """Return the name by which a policy file says how the network's outputs become actions of this space."""
    if not isinstance(action_space, gym.spaces.Box):
        return "none"
    return "unsquash" if ToBounds(action_space).stretches_all else "by_component"
