"""The cases of DQN's hyperparameters that say what is replayed; see `rllib_cases`."""

import itertools

import numpy as np
import pytest
from dqn_cases import column
from rllib_cases import Build, reaches, sampled_rows

from policies.replay import PrioritizedReplayBuffer, ReplayBuffer, Transitions


@reaches("dqn", field="replay")
def check_replay(build: Build, _: object) -> None:
    uniform = sampled_rows(build("dqn", replay="uniform"), 2)
    assert all(rows.weights is None for rows in uniform)
    prioritized = sampled_rows(build("dqn", replay="prioritized"), 2)
    assert np.ptp(column(prioritized, "weights")) > 0.01
    last = sampled_rows(build("dqn", replay="none", train_batch_size=3), 2)
    # The next batch is this one without its oldest transition, and one more.
    for earlier, later in itertools.pairwise(last):
        np.testing.assert_array_equal(earlier.obs[1:], later.obs[:-1])
        assert not np.array_equal(earlier.obs[-1], later.obs[-1])


@reaches("dqn", field="replay_capacity")
def check_replay_capacity(build: Build, _: object) -> None:
    algo = build("dqn", replay_capacity=60, env_steps_per_iteration=200)
    algo.train()
    assert len(algo.replay) == algo.replay.capacity == 60


@reaches("dqn", field="prioritized_alpha")
def check_prioritized_alpha(build: Build, _: object) -> None:
    """With alpha 0 all rows are as likely, whatever their TD errors."""
    for alpha, expected in ((0.0, 1.0), (1.0, 100.0)):
        replay = build("dqn", replay="prioritized", prioritized_alpha=alpha).replay
        assert priority_ratio(replay, 100.0) == pytest.approx(expected, rel=1e-3)


def priority_ratio(replay: PrioritizedReplayBuffer, td_error: float) -> float:
    rows = sampled_like(replay, 2)
    where = replay.add(rows)
    replay.set_priorities(where, np.array([1.0, td_error], dtype=np.float32))
    leaves = replay._priorities.leaves[where]
    return float(leaves[1] / leaves[0])


def sampled_like(replay: ReplayBuffer, count: int) -> Transitions:
    numbers = np.arange(count, dtype=np.float32)
    obs = np.repeat(numbers[:, None], 4, axis=1)
    return Transitions(obs, numbers.astype(np.int64), numbers, obs, numbers)


@reaches("dqn", field="prioritized_beta")
def check_prioritized_beta(build: Build, _: object) -> None:
    for beta, flat in ((0.0, True), (1.0, False)):
        algo = build("dqn", replay="prioritized", prioritized_beta=beta)
        weights = column(sampled_rows(algo, 3), "weights")
        assert (np.ptp(weights) < 1e-6) == flat


@reaches("dqn", field="prioritized_epsilon")
def check_prioritized_epsilon(build: Build, _: object) -> None:
    """A row without an error is as likely as the sizes say with epsilon added."""
    for values, epsilon in (({}, 1e-6), ({"prioritized_epsilon": 0.5}, 0.5)):
        replay = build("dqn", replay="prioritized", prioritized_alpha=1.0, **values).replay
        assert priority_ratio(replay, 0.0) == pytest.approx(epsilon / (1.0 + epsilon), rel=1e-6)
