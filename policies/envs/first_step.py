"""Check that the first reset and the first step of an environment return what Gymnasium's API asks for.

Training would find out too, in each trial and each retry; this check finds out before anything starts. Harmless
deviations pass, such as observations of float64 where the space says float32: they are converted in training.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import NormalizeObservation, NormalizeReward
from numpy.typing import NDArray

from policies.envs.byte_images import as_bytes
from policies.envs.checked import is_sound, reward_as_number
from policies.envs.faults import env_failed
from policies.envs.flat import FlatBox, needs_flattening
from policies.envs.mask_hints import mask_hint
from policies.envs.mask_settings import ACTION_MASK
from policies.envs.masks import NoMaskError, num_masked, sample, seen_by_networks
from policies.envs.own_actions import is_made
from policies.envs.stacked import WithMembers
from policies.errors import EnvError, shortened

_STEP_HINT = (
    "Mend its step(): Gymnasium's API wants (observation, reward, terminated, truncated, info), with an observation of "
    "the observation space, a finite number, two bools and a dict."
)
_RESET_HINT = (
    "Mend its reset(): Gymnasium's API wants (observation, info), with an observation of the observation space and a "
    "dict."
)


class Largest(NamedTuple):
    """The number farthest from 0 in the first observation, of those that networks see."""

    value: float
    place: str
    """Where the environment itself has it: `observation['x'][0]`, or `[3]`."""


class Carried(NamedTuple):
    """What an episode leaves to the next one, beside what the first observation shows of it."""

    step: str | None = None
    """How the first step differs when seed and action are given again; None: it does not, or was not made again."""
    scales_rewards: bool = False
    """Whether a `NormalizeReward` of Gymnasium's is around the environment, and goes on counting."""
    scales_observations: bool = False
    """The same of a `NormalizeObservation`."""


class FirstStep(NamedTuple):
    """What an environment showed when it was tried."""

    infos: Mapping[str, Any]
    """Those of its first reset."""
    unrepeated: str | None
    """How the first observation differs when the same seed is given again; None: it does not."""
    largest: Largest
    carried: Carried


class _Step(NamedTuple):
    observation: NDArray[np.float64]
    reward: float


def check_first_step(env: gym.Env[Any, Any], env_id: str, env_args: Mapping[str, Any]) -> FirstStep:
    """Reset an environment, step it once with some action, check what it returns, and do both again.

    Args:
        env: The environment.
        env_id: Its id, for messages.
        env_args: The arguments of its constructor, for messages.

    Raises:
        EnvFailedError: The env raised an error.
        EnvError: It returned something other than it should.
    """
    name = f"The environment {env_id!r}" + (f" with arguments {dict(env_args)!r}" if env_args else "")
    observation, infos = _check_call(
        env, "reset", lambda: env.reset(seed=0),
        find_problem=_reset_problem, complaint=f"{name} cannot be reset", hint=_RESET_HINT,
    )  # fmt: skip
    space = copy.deepcopy(env.action_space)  # the env may draw from its own
    space.seed(0)
    action = sample(env, space, observation)
    first = np.array(observation, np.float64)  # the env may write the next one into it
    # As the env itself gets it, so that its author can repeat the call.
    own = space.own(action) if is_made(space) else action
    returned = _check_call(
        env, "step", lambda: env.step(copy.deepcopy(action)),  # the env may write into it
        find_problem=_step_problem, complaint=f"{name} cannot be stepped, with the action {own!r} after a reset",
        hint=_STEP_HINT,
    )  # fmt: skip
    step = _as_step(returned)
    unrepeated, other_step = _other_again(env, first, action, step)
    carried = Carried(other_step, _counts(env, NormalizeReward), _counts(env, NormalizeObservation))
    return FirstStep(dict(infos), unrepeated, _largest(env.observation_space, first), carried)


def _largest(space: gym.Space[Any], observation: NDArray[np.float64]) -> Largest:
    values, behind_mask = observation.ravel(), num_masked(space)
    number = behind_mask + int(np.argmax(np.abs(values[behind_mask:])))
    return Largest(float(values[number]), _place_in(space, number))


def _counts(env: gym.Env[Any, Any], kind: type[gym.Wrapper[Any, Any, Any, Any]]) -> bool:
    """Whether a wrapper of this kind is around an environment, and changes what it does by what it sees."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, kind) and getattr(env, "update_running_mean", True):
            return True
        env = env.env
    return False


def _other_again(
    env: gym.Env[Any, Any], first: NDArray[np.float64], action: Any, step: _Step
) -> tuple[str | None, str | None]:
    """Reset an environment with the first seed once more, and step it with the first action.

    Returns:
        Where the first observation is another one; and if it is the same, how the step is another one.
    """
    space = env.observation_space
    mask = slice(num_masked(space))
    try:
        again = np.array(env.reset(seed=0)[0], np.float64)
        unrepeated = _difference(space, first, again)
        # Where the mask is another one, the action may not be allowed.
        if unrepeated is not None or not np.array_equal(first.flat[mask], again.flat[mask]):
            return unrepeated, None
        other = _as_step(env.step(action))
    except Exception:  # noqa: BLE001 (whatever it is, that it can be reset only once is told by the trials)
        return None, None
    if not _is_close(step.reward, other.reward):
        return None, f"its reward is {step.reward:g} and then {other.reward:g}"
    place = _difference(space, step.observation, other.observation)
    return None, None if place is None else f"of its observation {place}"


def _as_step(returned: Any) -> _Step:
    """Return what a step gave, as it stays whatever the env does with its own arrays."""
    return _Step(np.array(returned[0], np.float64), reward_as_number(returned[1]))


def _difference(space: gym.Space[Any], first: NDArray[np.float64], again: NDArray[np.float64]) -> str | None:
    """Say where an observation is another one than it was; masks don't count."""
    if again.shape != first.shape:
        return f"it is of shape {first.shape} and then {again.shape}"
    differs = np.flatnonzero(~_is_close(first, again))
    for number in map(int, differs[differs >= num_masked(space)][:1]):
        return f"{_place_in(space, number)} is {first.flat[number]:g} and then {again.flat[number]:g}"
    return None


def _is_close(first: Any, again: Any) -> Any:
    # What is computed in another order differs by less.
    return np.isclose(first, again, rtol=1e-3, atol=1e-5, equal_nan=True)


def _check_call(
    env: gym.Env[Any, Any],
    method: str,
    call: Callable[[], Any],
    *,
    find_problem: Callable[[Any, gym.Space[Any]], str | None],
    complaint: str,
    hint: str,
) -> Any:
    """Call a method of an environment, check what it returns, and return it.

    Raises:
        EnvFailedError: The env raised an error.
        EnvError: It returned something other than it should.
    """
    env_id = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    with _returned_by(env.unwrapped, method) as inner:
        try:
            returned = call()
            problem = find_problem(returned, env.observation_space)
        except BaseException as error:  # an env may raise anything
            # The error may be a wrapper's, caused by what the env returned.
            problem = find_problem(inner[-1], env.unwrapped.observation_space) if inner else None
            if problem is None and isinstance(error, NoMaskError) and method == "reset":
                raise EnvError(
                    f"env.{ACTION_MASK} asks for a mask of actions that {env_id} has not: {error}.",
                    mask_hint(env, error.infos),
                ) from error
            if problem is None:
                raise env_failed(
                    complaint, error, f"Check the env's arguments, or mend its {method}().", in_step=method == "step"
                ) from error
    if problem is not None:
        raise EnvError(f"{method}() of {env_id} returns {problem}.", hint)
    return returned


@contextlib.contextmanager
def _returned_by(inner: Any, method: str) -> Iterator[list[Any]]:
    """Collect in a list what a method of an environment returns to the wrappers around it."""
    returned: list[Any] = []
    original = getattr(inner, method)

    def spy(*args: Any, **kwargs: Any) -> Any:
        returned.append(original(*args, **kwargs))
        return returned[-1]

    before = vars(inner).get(method) if hasattr(inner, "__dict__") else None
    with contextlib.suppress(AttributeError):  # one with slots cannot be spied upon
        setattr(inner, method, spy)
    try:
        yield returned
    finally:
        with contextlib.suppress(AttributeError):
            if before is None:
                delattr(inner, method)
            else:
                setattr(inner, method, before)


def _reset_problem(returned: Any, space: gym.Space[Any]) -> str | None:
    """Return what is wrong with the values that reset() returned, or None."""
    if not isinstance(returned, tuple) or len(returned) != 2:
        return f"{_kind(returned)}, not the two values (observation, info)"
    observation, info = returned
    if not isinstance(info, Mapping):
        return f"{_kind(info)} as info, not a dict"
    return _observation_problem(observation, space)


def _step_problem(returned: Any, space: gym.Space[Any]) -> str | None:
    """Return what is wrong with the values that step() returned, or None."""
    if not isinstance(returned, tuple) or len(returned) != 5:
        return f"{_kind(returned)}, not the five values (observation, reward, terminated, truncated, info)"
    observation, reward, terminated, truncated, info = returned
    if problem := _reward_problem(reward):
        return problem
    for name, value in (("terminated", terminated), ("truncated", truncated)):
        if not _is_bool(value):
            return f"{shortened(value)} ({type(value).__name__}) as {name}, not a bool"
    if not isinstance(info, Mapping):
        return f"{_kind(info)} as info, not a dict"
    return _observation_problem(observation, space)


def _reward_problem(reward: Any) -> str | None:
    if isinstance(reward, str | bytes):
        return f"{shortened(reward)} as reward, not a number"
    try:
        array = np.asarray(reward)
        number = reward_as_number(reward)
        is_number = array.size == 1 and array.dtype.kind in "biuf"
    except Exception:  # noqa: BLE001 (whatever it is, it is no number)
        is_number = False
    if not is_number:
        return f"{_kind(reward)} as reward, not a number{_if_several(reward)}"
    if is_sound(np.asarray(number)):
        return None
    return f"the reward {number!r}{_if_finite(number)}"


def _if_several(reward: Any) -> str:
    """Return what makes a number of the rewards of several agents or objectives; "": it is none such."""
    if not isinstance(reward, np.ndarray | list | tuple):
        return ""
    with contextlib.suppress(ValueError):  # members of several lengths
        array = np.asarray(reward)
        if array.ndim == 1 and array.size > 1 and array.dtype.kind in "biuf":
            return ": gymnasium.wrappers.TransformReward(env, sum), in a module of your own, would make it one"
    return ""


def _is_bool(value: Any) -> bool:
    return isinstance(value, bool | np.bool_) or (
        isinstance(value, np.ndarray) and value.shape == () and value.dtype == np.bool_
    )


def _observation_problem(observation: Any, space: gym.Space[Any]) -> str | None:
    if needs_flattening(space):
        return _unflattened_problem(observation, space)
    try:
        array = np.asarray(observation)
    except Exception:  # noqa: BLE001 (ragged lists, say)
        return f"{_kind(observation)} as observation, not an array of shape {space.shape}"
    if array.shape != space.shape:
        return f"observations of shape {array.shape} but declares {space.shape}"
    if array.dtype.kind not in "biuf":
        return f"observations of dtype {array.dtype} but declares {space.dtype}"
    if space.dtype == np.uint8:
        return _bytes_problem(array)
    return None if is_sound(array) else _not_finite(array, space)


def _bytes_problem(array: NDArray[Any]) -> str | None:
    try:
        as_bytes(array)
    except ValueError as error:
        return str(error)
    return None


def _not_finite(array: NDArray[Any], space: gym.Space[Any]) -> str | None:
    """Say which number is not finite, and where the environment itself has it: behind the mask, if there is one."""
    for number in range(num_masked(space), array.size):
        if not is_sound(value := np.asarray(array.flat[number])):
            return f"observations that are not finite: {value} at {_place_in(space, number)}{_if_finite(value)}"
    return None


def _place_in(space: gym.Space[Any], number: int) -> str:
    """Name the place of a number in the environment's own observation: behind the mask, if there is one."""
    seen, number = seen_by_networks(space), number - num_masked(space)
    if isinstance(seen, WithMembers):
        return seen.name_of(number)
    return str([int(index) for index in np.unravel_index(number, seen.shape or ())])


def _unflattened_problem(observation: Any, space: gym.Space[Any]) -> str | None:
    """What is wrong with an environment's own observation, which a wrapper could not make a vector."""
    try:
        flat = FlatBox(space)
    except ValueError:
        # No vector can be made of what a wrapper leaves out: that is not the error that is looked for.
        return None
    try:
        flat.flat(observation)
    except ValueError as error:
        return str(error)
    return None


def _if_finite(value: Any) -> str:
    """Return the explanation for a number that is refused although it is finite."""
    return ", which is infinite in 32 bits" if np.isfinite(value) else ""


def _kind(value: Any) -> str:
    """Describe a value in a few words."""
    if value is None:
        return "None"
    if isinstance(value, tuple | list):
        return f"a {type(value).__name__} of {len(value)}"
    shown = shortened(value)
    return f"{shown} ({type(value).__name__})" if len(shown) <= 60 else f"a {type(value).__name__}"
