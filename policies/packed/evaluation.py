"""Play greedy episodes of many policies at once.

Each policy gets the same episodes, to the last bit, as `Evaluator.run` gives it. In classic control the episodes of
all policies are stepped in one object, and networks of equal layers are computed together.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.policy import ActionSpace, NetworkPolicy, Policy, action_function
from policies.envs.checked import is_sound
from policies.errors import TuneJobsError
from policies.packed.envs.cartpole_rows import CartPoleRows
from policies.portable.forward import ForwardPass, ForwardPasses

_MAX_ROWS = 4096
"""The most episodes played at once; more would take memory and save no time."""

Result = Episodes | Exception


def evaluate_many(evaluator: Evaluator, policies: Sequence[Policy]) -> list[Result]:
    """Play one greedy episode for each seed and each policy.

    Args:
        evaluator: Gives the environment and the seeds.
        policies: The policies that act.

    Returns:
        For each policy, what `evaluator.run` returns or the error that it raises: `NonFiniteWeightsError` or
        `EnvError`.
    """
    results: dict[int, Result] = {}
    by_layout: dict[tuple[Any, ...], list[int]] = {}
    for index, policy in enumerate(policies):
        layout = _layout(evaluator, policy)
        try:
            if layout:
                evaluator.check(policy)
                by_layout.setdefault(layout, []).append(index)
            else:
                results[index] = evaluator.run(policy)
        except TuneJobsError as error:
            results[index] = error
    joint = [index for indexes in by_layout.values() for index in indexes]
    at_once = max(1, _MAX_ROWS // len(evaluator.seeds))
    for first in range(0, len(joint), at_once):
        some = joint[first : first + at_once]
        try:
            results |= zip(some, _play_together(evaluator, [policies[index] for index in some]), strict=True)
        except _UnsoundError:
            results |= {index: _alone(evaluator, policies[index]) for index in some}
    return [results[index] for index in range(len(policies))]


def _alone(evaluator: Evaluator, policy: Policy) -> Result:
    try:
        return evaluator.run(policy)
    except TuneJobsError as error:
        return error


def _layout(evaluator: Evaluator, policy: Policy) -> tuple[Any, ...]:
    """Return what policies that are computed together have in common; empty for a policy that is computed alone."""
    # Exactly this class, because a subclass may act in another way.
    if evaluator.starts is None or type(policy) is not NetworkPolicy:
        return ()
    return ForwardPasses.layout(policy.portable.network)


class _Group:
    """Policies with one layout that still have running episodes."""

    def __init__(self, policies: dict[int, NetworkPolicy]) -> None:
        self.indexes = list(policies)
        self._forward = ForwardPasses([ForwardPass(policy.portable.network) for policy in policies.values()])
        # All of them act in the same env, so outputs become actions in the same way.
        one = next(iter(policies.values()))
        self._to_actions = action_function(one.portable, cast("ActionSpace", one.action_space))

    def act(self, observations: NDArray[np.float32], counts: NDArray[np.intp]) -> NDArray[Any]:
        """Return actions for observations, of which policy i has `counts[i]`."""
        return self._to_actions(self._forward(observations, counts.tolist()))

    def keep(self, counts: NDArray[np.intp]) -> None:
        """Drop the policies whose count is 0."""
        if not counts.all():
            places = np.flatnonzero(counts).tolist()
            self.indexes = [self.indexes[place] for place in places]
            self._forward = self._forward.choose(places)


class _UnsoundError(Exception):
    """An observation or a reward is not finite: which policy is to blame is found by playing each alone."""


def _play_together(evaluator: Evaluator, policies: Sequence[Policy]) -> list[Episodes]:
    """Play the episodes of policies that are sorted by their layouts, all of them in one object.

    Rows are the running episodes, those of the first policy first.

    Raises:
        _UnsoundError: See there.
    """
    starts, num_seeds = evaluator.starts, len(evaluator.seeds)
    cartpoles = None if evaluator.rows else CartPoleRows.make(evaluator.env_id, evaluator.env_args)
    rows = evaluator.rows or cartpoles
    assert starts is not None
    assert rows is not None
    by_layout: dict[Any, dict[int, NetworkPolicy]] = {}
    for index, policy in enumerate(policies):
        assert isinstance(policy, NetworkPolicy)
        by_layout.setdefault(_layout(evaluator, policy), {})[index] = policy
    groups = [_Group(members) for members in by_layout.values()]
    returns, lengths = np.zeros(len(policies) * num_seeds), np.zeros(len(policies) * num_seeds, dtype=np.int64)
    episodes = np.arange(len(returns))  # the number of each row's episode: policy * num_seeds + seed
    counts = np.full(len(policies), num_seeds, dtype=np.intp)
    observations = np.tile(starts.observations, (len(policies), 1))
    rows.put(np.tile(starts.states, (len(policies), 1)), np.zeros(len(episodes), dtype=np.intp))
    # The evaluator's own rows stay open.
    with contextlib.nullcontext() if cartpoles is None else contextlib.closing(cartpoles):
        for _ in range(evaluator.max_episode_steps):
            actions, first = [], 0
            for group in groups:
                count = counts[group.indexes]
                last = first + int(count.sum())
                actions.append(group.act(observations[first:last], count))
                first = last
            observations, rewards, terminated, truncated = rows.step(np.concatenate(actions))[:4]
            if not (is_sound(rewards) and is_sound(observations)):
                raise _UnsoundError
            returns[episodes] += rewards
            lengths[episodes] += 1
            if (ended := terminated | truncated).any():
                left = np.flatnonzero(~ended)
                rows.put(rows.states[left], rows.lengths[left])
                observations, episodes = observations[left], episodes[left]
                counts = np.bincount(episodes // num_seeds, minlength=len(policies))
                for group in groups:
                    group.keep(counts[group.indexes])
                groups = [group for group in groups if group.indexes]
                if not groups:
                    break
    return [
        Episodes(evaluator.seeds, tuple(totals), tuple(steps))
        for totals, steps in zip(
            returns.reshape(-1, num_seeds).tolist(), lengths.reshape(-1, num_seeds).tolist(), strict=True
        )
    ]
