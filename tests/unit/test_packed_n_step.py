"""Stacked sums over n steps are those of one sum a row."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from replay_rows import D, as_rows, make_hyperparams

from policies.packed.dqn.n_step import StackedNStep
from policies.packed.envs.vector import Step
from policies.packed.inputs import Inputs
from policies.replay import NStep

Seen = tuple[NDArray[np.float32], NDArray[np.int64], Step]
NAMES = ("a", "b", "c")
GAMMA = {"a": 0.9, "b": 1.0, "c": 0.5}
N = 3


def random_steps(num_steps: int, num_rows: int, seed: int) -> Iterator[Seen]:
    """(observations, actions, step) one after another; observations tell their row and their number in it."""
    rng = np.random.default_rng(seed)
    numbers = np.zeros(num_rows)

    def observe() -> NDArray[np.float32]:
        return np.stack([np.arange(num_rows), numbers], axis=1).astype(np.float32)

    now = observe()
    for _ in range(num_steps):
        numbers += 1
        final = observe()
        terminated = rng.random(num_rows) < 0.15
        truncated = rng.random(num_rows) < 0.15
        numbers += 100 * (terminated | truncated)
        after = observe()
        rewards = rng.normal(size=num_rows).astype(np.float32)
        yield now, rng.integers(0, 2, num_rows), Step(after, final, rewards, rewards * 0, terminated, truncated)
        now = after


def expected_rows(steps: Sequence[Seen], row: int, n_step: int, gamma: float) -> NDArray[np.float32]:
    """What `NStep` makes of one sub-environment's steps, which resets in a step of its own, all at once."""
    columns: dict[str, list[Any]] = {
        name: [] for name in ("obs", "actions", "rewards", "terminated", "truncated", "stepped")
    }
    for now, actions, step in steps:
        flags = [step.terminated[row], step.truncated[row]]
        values = [now[row], actions[row], step.rewards[row], *flags, True]
        for name, value in zip(columns, values, strict=True):
            columns[name].append(value)
        if any(flags):
            for name, value in zip(columns, [step.final_observations[row], 0, 0.0, False, False, False], strict=True):
                columns[name].append(value)
    columns["obs"].append(steps[-1][2].final_observations[row])
    arrays = {name: np.array(values)[:, None] for name, values in columns.items()}
    return as_rows(NStep(1, n_step, gamma).transitions(arrays))


@pytest.mark.parametrize("n_step", [1, 2, 3])
def test_n_step_rows_are_those_of_one_sum_a_row(n_step: int) -> None:
    stacked = StackedNStep(N, Inputs.vector(D), n_step)
    for name in NAMES:
        stacked.add_member(name, make_hyperparams(n_step=n_step, gamma=GAMMA[name]))
    steps = list(random_steps(60, len(NAMES) * N, seed=n_step))
    assert sum(step.terminated.sum() for *_, step in steps) > 20
    assert sum((step.truncated & ~step.terminated).sum() for *_, step in steps) > 20
    found: dict[str, list[Any]] = {name: [] for name in NAMES}
    for now, actions, step in steps:
        for name, new in zip(NAMES, stacked.rows(NAMES, now, actions, step), strict=True):
            found[name].append(new)
    for index, name in enumerate(NAMES):
        together = np.concatenate(found[name])
        for row in range(index * N, (index + 1) * N):
            expected = expected_rows(steps, row, n_step, GAMMA[name])
            np.testing.assert_array_equal(together[together[:, 0] == row], expected)
            # Across an episode's end the numbers jump.
            assert np.all(expected[:, D + 2] - expected[:, 1] <= n_step)
        assert np.all(np.isin(together[:, 0], range(index * N, (index + 1) * N)))


def test_what_waits_for_rewards_leaves_with_its_member() -> None:
    stacked = StackedNStep(1, Inputs.vector(D), 3)
    for name in ("a", "b"):
        stacked.add_member(name, make_hyperparams(n_step=3))
    flags = np.zeros(2, dtype=np.bool_)
    ends = np.ones(2, dtype=np.bool_)
    obs, rewards = np.zeros((2, D), dtype=np.float32), np.ones(2, dtype=np.float32)
    assert [
        len(new) for new in stacked.rows(["a", "b"], obs, flags * 1, Step(obs, obs, rewards, rewards, flags, flags))
    ] == [0, 0]
    stacked.remove_member("a")
    stacked.add_member("a", make_hyperparams(n_step=3))
    # In another order now.
    found = stacked.rows(["b", "a"], obs, flags * 1, Step(obs, obs, rewards, rewards, ends, flags))
    assert [len(new) for new in found] == [2, 1]
