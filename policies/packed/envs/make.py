"""Make and check the environments of a pack: those of many trials at once.

Words: a *pack* trains several trials in one process; each of them is a *member*, named by its trial id. A *row* is one
sub-environment: member m of a pack owns the rows m * N to (m + 1) * N, where N is the number of each member's
sub-environments. M is the number of members.

Where an episode ends, the next one begins in the same step: every step is a transition, and none only resets. To the
last bit, a member's observations and rewards depend only on its seed and its actions, not on the members beside it.
"""

from __future__ import annotations

import contextlib
import copy
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from policies.envs.checked import reward_as_number
from policies.envs.classic import is_classic
from policies.envs.classic_rows import ClassicRows
from policies.envs.faults import close_env
from policies.envs.make import make_env
from policies.envs.masks import num_masked, sample
from policies.errors import EnvError
from policies.packed.envs.vector import EnvKind, PackedEnvs

_SLOW_STEP_US = 300.0
"""Microseconds from which a step is long enough to be made in another process, which costs a message.

With 8 sub-environments and one more process steps of 300 take 60 to 70 % of the time, with observations of 8 numbers
and of 84 x 84 x 4 bytes: a message costs 30 to 100 for each of them.
"""
_TIMED_STEPS = 200
_TIMED_S = 0.15
_CUT = 20  # so that the reset without a seed is checked too, also for envs with long episodes


@dataclass(frozen=True)
class StepTime:
    """How long an environment's steps take."""

    us: float | None
    """Microseconds per env step, including resets after episodes' ends; None: the env raised an error before."""
    is_vectorised: bool = False
    """Whether one object steps all of a pack's environments at once."""
    reward: float | None = None
    """How large rewards are, without signs: the median over steps of random play; None: it was not looked at."""
    largest: float | None = None
    """The number farthest from 0 that networks would have seen in it, without its sign; None: it was not looked at."""


@dataclass(frozen=True)
class EnvChoice:
    """How a pack's environments are stepped, and why."""

    kind: EnvKind
    step_us: float | None
    """Microseconds per env step; see `StepTime.us`."""
    why: str
    """The reason, as a phrase for the plan."""


def make_packed_envs(
    env_id: str,
    env_args: Mapping[str, Any] | None,
    num_envs: int,
    *,
    failure_penalty: float | None = None,
    atari_training: Mapping[str, bool] | None = None,
    kind: EnvKind,
    num_processes: int = 0,
    suspects: set[str] | None = None,
) -> PackedEnvs:
    """Make the environments of a pack that has no members yet.

    Args:
        env_id: Gymnasium id, or `module:Name`.
        env_args: The same as for `policies.envs.make.make_env`.
        num_envs: Sub-environments of each member.
        failure_penalty: Reward of steps that end by failure, for training alone; None: the env's own reward.
        atari_training: The arguments of an `AtariTraining`, for training alone; it is never together with a penalty.
            None: the environments as they are.
        kind: `vectorised`: only classic control, all members in one object. `scalar`: any environment, one
            sub-environment after the other. `processes`: the same, in child processes; if it is one, half of them.
        num_processes: The number of child processes of the kind `processes`, at least 1.
        suspects: Members that were in a child process that died, which are added here: each gets one of its own. None:
            none yet.

    Raises:
        EnvError: The environment cannot be made, is not one of that kind, or there is a penalty and it has no failure.
    """
    from policies.packed.envs.cartpole import CartPoleEnvs
    from policies.packed.envs.scalar import ScalarEnvs

    if kind == "vectorised":
        rows = ClassicRows.make(env_id, env_args)
        if rows is None:
            return CartPoleEnvs(env_id, env_args, num_envs, failure_penalty=failure_penalty)
        return ScalarEnvs(env_id, env_args, num_envs, failure_penalty=failure_penalty, rows=rows)
    num_processes = max(1, num_processes) if kind == "processes" else 0
    return ScalarEnvs(
        env_id, env_args, num_envs,
        failure_penalty=failure_penalty, atari_training=atari_training, num_processes=num_processes, suspects=suspects,
    )  # fmt: skip


def measure_step(env_id: str, env_args: Mapping[str, Any] | None) -> StepTime:
    """Measure how long a step of an environment takes in a pack.

    Raises:
        EnvError: The environment cannot be made.
    """
    from policies.packed.envs.cartpole_rows import CartPoleRows

    env = make_env(env_id, env_args)
    may_have_rows, behind_mask = is_classic(env), num_masked(env.observation_space)
    close_env(env)
    rows = (CartPoleRows.make(env_id, env_args) or ClassicRows.make(env_id, env_args)) if may_have_rows else None
    if rows is not None:
        rows.close()
        return StepTime(_vectorised_step_us(env_id, env_args), is_vectorised=True)
    return _scalar_step_time(env_id, env_args, behind_mask)


def choose_kind(step: StepTime, *, spare_cpus: int, why_none: str = "no CPU is idle") -> EnvChoice:
    """Choose how to step a pack's environments: all at once if possible, in processes if slow and CPUs are idle.

    Args:
        step: The result of `measure_step`.
        spare_cpus: CPUs that nothing else would use.
        why_none: The reason why there are none, for the case that there are none.
    """
    if step.is_vectorised:
        return EnvChoice("vectorised", step.us, "one object steps them all at once")
    if step.us is None:
        return EnvChoice("scalar", None, "no step could be measured")
    took = f"a step takes {step.us / 1000:.1f} ms" if step.us >= 1000 else f"a step takes {step.us:.0f} us"
    if step.us <= _SLOW_STEP_US:
        return EnvChoice("scalar", step.us, took)
    if spare_cpus < 1:
        return EnvChoice("scalar", step.us, f"{took}, but {why_none}")
    idle = "one CPU" if spare_cpus == 1 else f"{spare_cpus} CPUs"
    return EnvChoice("processes", step.us, f"{took}, and {idle} would be idle")


def check_seedable(env_id: str, env_args: Mapping[str, Any] | None) -> None:
    """Refuse an environment whose steps do not follow from the seed of its first reset and its actions.

    In a pack, a trial could not be repeated then: its observations would depend on the trials beside it. An env that
    raises an error here is not refused; the error is left to the trials.

    Raises:
        EnvError: The environment cannot be made, or its observations, rewards or ends differ from one time to the next.
    """
    alone = list(_trace(env_id, env_args, 0, seconds=_TIMED_S, cut=_CUT))
    difference = _difference(alone, _beside_another(env_id, env_args, len(alone)))
    if difference is None:
        return
    again = _difference(alone, list(islice(_trace(env_id, env_args, 0, cut=_CUT), len(alone))))
    if again is not None:
        raise EnvError(
            f"{env_id} cannot be seeded, so its trials cannot be packed: after reset(seed=0) and with the same actions "
            f"{again}.",
            "Let it draw all random numbers from self.np_random, which reset(seed=...) seeds; or set engine: rllib.",
        )
    raise EnvError(
        f"{env_id} depends on other environments in the same process, so its trials cannot be packed: after "
        f"reset(seed=0) and with the same actions, but with another copy beside it, {difference}; with "
        "env.own_process: true each would be alone.",
        "Let each copy keep its own state and draw from self.np_random, not from generators that all share; or set "
        "engine: rllib.",
    )


def _vectorised_step_us(env_id: str, env_args: Mapping[str, Any] | None) -> float:
    num_envs, num_steps = 64, 50
    envs = make_packed_envs(env_id, env_args, num_envs, kind="vectorised")
    envs.add("", 0)
    space = copy.deepcopy(envs.action_space)
    space.seed(0)
    actions = np.array([[space.sample() for _ in range(num_envs)] for _ in range(num_steps)])
    envs.step(actions[0])
    begin = time.perf_counter()
    envs.begin(num_steps)
    for row in actions:
        envs.step(row)
    seconds = time.perf_counter() - begin
    envs.close()
    return 1e6 * seconds / (num_steps * num_envs)


def _scalar_step_time(env_id: str, env_args: Mapping[str, Any] | None, behind_mask: int) -> StepTime:
    """Return the time of a step with random actions; the first, which may load files, counts only if it is alone."""
    told = [(time.perf_counter(), seen) for seen in _trace(env_id, env_args, 0, seconds=_TIMED_S)]
    if len(told) < 2:
        return StepTime(None)
    moments = [moment for moment, _ in told]
    us = 1e6 * (moments[1] - moments[0])
    if len(moments) > 2:
        us = 1e6 * (moments[-1] - moments[1]) / (len(moments) - 2)
    largest = max(np.abs(np.ravel(seen.observation)[behind_mask:].astype(np.float64)).max() for _, seen in told)
    # The first is no step's.
    reward = np.median([abs(seen.reward) for _, seen in told[1:]])
    return StepTime(us, reward=float(reward), largest=float(largest))


class _Seen(NamedTuple):
    """The values that one step or reset of an environment returned."""

    num_steps: int
    observation: Any
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    first: Any = None
    """The next episode's first observation, if this one is over."""


def _trace(
    env_id: str, env_args: Mapping[str, Any] | None, seed: int, *, seconds: float = math.inf, cut: int | None = None
) -> Iterator[_Seen]:
    """Step an environment with random actions, equal ones for equal seeds, until it raises an error.

    Args:
        env_id: The same as for `policies.envs.make.make_env`.
        env_args: The same as for `policies.envs.make.make_env`.
        seed: The seed of the first reset and of the actions.
        seconds: No step is begun after this time.
        cut: Steps after which an episode is cut off and the next begins; None: none is cut off.
    """
    env = make_env(env_id, env_args)
    space = copy.deepcopy(env.action_space)  # the env may draw from its own
    space.seed(seed)
    # Drawn before the clock starts; which of them are allowed is known only then.
    drawn = [] if num_masked(env.observation_space) else [sample(env, space, None) for _ in range(_TIMED_STEPS)]
    deadline = time.perf_counter() + seconds
    # An error of the env is reported by the trial that it happens in.
    with contextlib.suppress(Exception), contextlib.ExitStack() as stack:
        stack.callback(close_env, env)
        now = np.array(env.reset(seed=seed)[0])
        yield _Seen(0, now)
        for num_steps in range(1, _TIMED_STEPS + 1):
            action = drawn[num_steps - 1] if drawn else sample(env, space, now)
            observation, reward, terminated, truncated, _ = env.step(action)
            now = np.array(observation)
            seen = _Seen(num_steps, now, reward_as_number(reward), bool(terminated), bool(truncated))
            if terminated or truncated or num_steps == cut:
                now = np.array(env.reset()[0])
                seen = seen._replace(first=now)
            yield seen
            if time.perf_counter() > deadline:
                break


def _beside_another(env_id: str, env_args: Mapping[str, Any] | None, num: int) -> list[_Seen]:
    """Trace an environment while another one, with another seed, is stepped in between."""
    ours, other = (_trace(env_id, env_args, seed, cut=_CUT) for seed in (0, 1))
    seen = []
    for _, one in zip(range(num), ours, strict=False):
        seen.append(one)
        next(other, None)
    return seen


def _difference(one: Sequence[_Seen], another: Sequence[_Seen]) -> str | None:
    """Describe the first difference between two traces; None if they are equal."""
    for left, right in zip(one, another, strict=False):
        when = f"after {left.num_steps} step{'' if left.num_steps == 1 else 's'}" if left.num_steps else "at first"
        for name in _Seen._fields[1:]:
            ours, theirs = (np.asarray(getattr(seen, name), dtype=np.float64) for seen in (left, right))
            what = "next episode's first observation" if name == "first" else name
            if ours.shape != theirs.shape:
                return f"the {what} {when} is of shape {ours.shape} one time and {theirs.shape} another"
            different = np.flatnonzero((ours != theirs) & ~(np.isnan(ours) & np.isnan(theirs)))
            if different.size:
                values = [float(array.flat[different[0]]) for array in (ours, theirs)]
                place = f" (number {different[0]} of it)" if ours.ndim else ""
                return f"the {what} {when}{place} is {values[0]!r} one time and {values[1]!r} another"
    return None
