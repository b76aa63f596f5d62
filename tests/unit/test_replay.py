"""Replay memories: what goes in, what comes out, how often."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from policies.hyperparams import DQNHyperparams
from policies.replay import (
    LastTransitions,
    NStep,
    PrioritizedReplayBuffer,
    ReplayBuffer,
    Transitions,
    make_replay,
)
from tests.narrowing import present


def rows(first: int, count: int) -> Transitions:
    numbers = np.arange(first, first + count, dtype=np.float32)
    obs = np.stack([numbers, -numbers], axis=1)
    return Transitions(obs, (numbers % 3).astype(np.int64), numbers, obs + np.float32(0.5), numbers / np.float32(10))


def fragment(
    rewards: Sequence[int] | NDArray[np.int64],
    terminated: Sequence[int] | NDArray[np.int64] | tuple[Any, ...] = (),
    truncated: Sequence[int] | tuple[Any, ...] = (),
    reset: Sequence[int] | tuple[Any, ...] = (),
) -> dict[str, NDArray[Any]]:
    """One sub-environment's steps; observation t is [t]. `reset` steps only reset."""
    count = len(rewards)

    def flags(steps: Sequence[int] | NDArray[np.int64] | tuple[Any, ...]) -> NDArray[np.bool_]:
        return np.isin(np.arange(count), steps)[:, None]

    return {
        "obs": np.arange(count + 1, dtype=np.float32)[:, None, None],
        "actions": np.arange(count)[:, None],
        "rewards": np.array(rewards, dtype=np.float64)[:, None],
        "terminated": flags(terminated),
        "truncated": flags(truncated),
        "stepped": ~flags(reset),
    }


def as_rows(transitions: Transitions) -> list[tuple[Any, ...]]:
    return [
        (int(obs[0]), int(action), float(reward), int(following[0]), pytest.approx(float(discount)))
        for obs, action, reward, following, discount in zip(
            transitions.obs,
            transitions.actions,
            transitions.rewards,
            transitions.next_obs,
            transitions.discounts,
            strict=True,
        )
    ]


def test_one_step_transitions_bootstrap_unless_terminated() -> None:
    columns = fragment([1, 2, 3, 0, 5], terminated=[1], truncated=[4], reset=[2, 3])
    columns["stepped"][3] = True
    assert as_rows(NStep(1, 1, 0.9).transitions(columns)) == [
        (0, 0, 1.0, 1, 0.9),
        (1, 1, 2.0, 2, 0.0),
        (3, 3, 0.0, 4, 0.9),
        (4, 4, 5.0, 5, 0.9),  # truncated: its value goes on
    ]


def test_n_step_sums_stop_at_the_end_of_the_episode() -> None:
    columns = fragment([1, 1, 1, 1, 0, 1], terminated=[3], reset=[4])
    found = as_rows(NStep(1, 3, 0.5).transitions(columns))
    assert found == [
        (0, 0, 1.75, 3, 0.125),
        (1, 1, 1.75, 4, 0.0),
        (2, 2, 1.5, 4, 0.0),
        (3, 3, 1.0, 4, 0.0),
        # Step 5 waits for two more.
    ]


def test_truncated_n_step_sums_bootstrap_over_the_steps_they_have() -> None:
    found = as_rows(NStep(1, 3, 0.5).transitions(fragment([1, 1], truncated=[1])))
    assert found == [(0, 0, 1.5, 2, 0.25), (1, 1, 1.0, 2, 0.5)]


def test_n_step_sums_go_on_in_the_next_fragment_unless_the_streams_are_reset() -> None:
    n_step = NStep(1, 3, 1.0)
    assert as_rows(n_step.transitions(fragment([1, 2]))) == []
    assert as_rows(n_step.transitions(fragment([3]))) == [(0, 0, 6.0, 1, 1.0)]
    n_step.forget()
    assert as_rows(n_step.transitions(fragment([4, 5]))) == []


def test_streams_do_not_mix() -> None:
    columns = fragment([1, 1, 1])
    both = {
        name: np.concatenate([value, value * 10 if name == "rewards" else value], axis=1)
        for name, value in columns.items()
    }
    assert sorted(float(value) for value in NStep(2, 2, 1.0).transitions(both).rewards) == [2, 2, 20, 20]


def test_the_oldest_transitions_go_first() -> None:
    replay = ReplayBuffer(5, np.random.default_rng(0))
    for first in (0, 3, 6):
        replay.add(rows(first, 3))
    assert len(replay) == 5
    (batch,) = replay.batches(1, 400)
    assert set(batch.rewards) == {4.0, 5.0, 6.0, 7.0, 8.0}


def test_more_than_fits_keeps_the_newest() -> None:
    replay = ReplayBuffer(4, np.random.default_rng(0))
    replay.add(rows(0, 11))
    (batch,) = replay.batches(1, 200)
    assert set(batch.rewards) == {7.0, 8.0, 9.0, 10.0}


def test_rows_stay_together() -> None:
    replay = ReplayBuffer(7, np.random.default_rng(1))
    replay.add(rows(0, 12))
    for batch in replay.batches(20, 3):
        np.testing.assert_array_equal(batch.obs[:, 0], batch.rewards)
        np.testing.assert_array_equal(batch.next_obs[:, 0], batch.rewards + 0.5)
        np.testing.assert_array_equal(batch.actions, batch.rewards % 3)
        np.testing.assert_allclose(batch.discounts, batch.rewards / 10)


def test_uniform_draws_every_row_as_often_and_from_its_seed() -> None:
    def draw(seed: int) -> NDArray[np.float32]:
        replay = ReplayBuffer(10, np.random.default_rng(seed))
        replay.add(rows(0, 10))
        return np.concatenate([batch.rewards for batch in replay.batches(500, 20)])

    counts = np.bincount(draw(0).astype(int), minlength=10)
    # 1,000 expected each; the standard deviation is 30.
    assert np.all(np.abs(counts - 1000) < 150)
    np.testing.assert_array_equal(draw(3), draw(3))
    assert not np.array_equal(draw(3), draw(4))


def test_large_rows_are_drawn_in_several_gathers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("policies.replay._MAX_GATHER_BYTES", 100)
    replay = ReplayBuffer(10, np.random.default_rng(0))
    replay.add(rows(0, 10))
    batches = list(replay.batches(7, 4))
    assert len(batches) == 7
    assert len({batch.rewards.tobytes() for batch in batches}) > 3


def test_no_replay_gives_the_newest_in_order() -> None:
    replay = LastTransitions(3, np.random.default_rng(0))
    replay.add(rows(0, 2))
    replay.add(rows(2, 3))
    (batch,) = replay.batches(1, 3)
    assert list(batch.rewards) == [2.0, 3.0, 4.0]


@pytest.mark.parametrize("capacity", [1, 5, 8, 1000])
def test_prioritized_draws_in_proportion(capacity: int) -> None:
    replay = PrioritizedReplayBuffer(capacity, np.random.default_rng(0), alpha=1.0, beta=1.0)
    replay.add(rows(0, capacity))
    size = min(capacity, 5)
    replay.set_priorities(np.arange(capacity), np.zeros(capacity, dtype=np.float32))
    replay.set_priorities(np.arange(size), np.arange(1, size + 1, dtype=np.float32))
    drawn = np.concatenate([batch.rewards for batch in replay.batches(200, 50)]).astype(int)
    counts = np.bincount(drawn, minlength=capacity)[:size]
    expected = 10_000 * np.arange(1, size + 1) / (size * (size + 1) / 2)
    assert np.all(np.abs(counts - expected) < 5 * np.sqrt(expected) + 1)


def test_epsilon_is_added_to_each_error() -> None:
    replay = PrioritizedReplayBuffer(4, np.random.default_rng(0), alpha=1.0, beta=1.0, epsilon=2.0)
    replay.add(rows(0, 4))
    replay.set_priorities(np.arange(4), np.array([0.0, -2.0, 6.0, 14.0], dtype=np.float32))
    (batch,) = replay.batches(1, 500)
    weights = {int(reward): float(weight) for reward, weight in zip(batch.rewards, present(batch.weights), strict=True)}
    assert weights == pytest.approx({0: 1.0, 1: 0.5, 2: 0.25, 3: 0.125})


def test_importance_weights_undo_the_preference() -> None:
    replay = PrioritizedReplayBuffer(4, np.random.default_rng(0), alpha=1.0, beta=1.0)
    replay.add(rows(0, 4))
    replay.set_priorities(np.arange(4), np.array([1.0, 2.0, 4.0, 8.0], dtype=np.float32))
    (batch,) = replay.batches(1, 500)
    weights = {int(reward): float(weight) for reward, weight in zip(batch.rewards, present(batch.weights), strict=True)}
    assert weights == pytest.approx({0: 1.0, 1: 0.5, 2: 0.25, 3: 0.125}, rel=1e-4)


def test_new_rows_get_the_highest_priority() -> None:
    replay = PrioritizedReplayBuffer(100, np.random.default_rng(0), alpha=1.0, beta=0.4)
    replay.add(rows(0, 50))
    replay.set_priorities(np.arange(50), np.full(50, 0.01, dtype=np.float32))
    replay.set_priorities(np.array([0]), np.array([30.0], dtype=np.float32))
    where = replay.add(rows(50, 1))
    (batch,) = replay.batches(1, 1000)
    assert abs(np.mean(batch.rewards == 50) - 0.5) < 0.06
    assert list(where) == [50]


def test_priorities_that_are_no_numbers_do_not_spoil_the_tree() -> None:
    replay = PrioritizedReplayBuffer(4, np.random.default_rng(0), alpha=0.6, beta=0.4)
    replay.add(rows(0, 4))
    replay.set_priorities(np.arange(4), np.array([np.nan, np.inf, 1.0, 1.0], dtype=np.float32))
    (batch,) = replay.batches(1, 100)
    assert np.all(np.isfinite(present(batch.weights)))


@pytest.mark.parametrize(
    ("replay", "kind", "capacity"),
    [("uniform", ReplayBuffer, 700), ("prioritized", PrioritizedReplayBuffer, 700), ("none", LastTransitions, 32)],
)
def test_the_memory_that_the_hyperparameters_name(replay: str, kind: type[object], capacity: int) -> None:
    made = make_replay(DQNHyperparams(replay=replay, replay_capacity=700, train_batch_size=32), seed=3)
    assert type(made) is kind
    assert made.capacity == capacity


# -- batches without rows: what n-step sums give before the first is complete

KINDS = ("uniform", "prioritized", "none")


@pytest.mark.parametrize("replay", KINDS)
def test_no_transitions_change_nothing(replay: str) -> None:
    values = DQNHyperparams(replay=replay, replay_capacity=5, train_batch_size=4)
    plain, given_none = make_replay(values, seed=3), make_replay(values, seed=3)
    assert len(given_none.add(rows(0, 0))) == 0
    assert len(given_none) == 0
    assert list(given_none.batches(2, 4)) == []
    for memory in (plain, given_none):
        memory.add(rows(0, 4))
    given_none.add(rows(4, 0))
    given_none.set_priorities(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.float32))
    for memory in (plain, given_none):
        memory.add(rows(4, 3))
    assert len(given_none) == len(plain)
    for ours, theirs in zip(given_none.batches(3, 4), plain.batches(3, 4), strict=True):
        np.testing.assert_array_equal(ours.rewards, theirs.rewards)
        assert (ours.indices is None) == (replay != "prioritized")


@pytest.mark.parametrize("replay", KINDS)
def test_a_memory_for_all_that_will_come_gives_the_same_batches(replay: str) -> None:
    values = DQNHyperparams(replay=replay, replay_capacity=1_000, train_batch_size=4)
    whole, exact = make_replay(values, seed=3), make_replay(values, seed=3)
    exact.expect(60)
    for first in range(0, 60, 5):
        for memory in (whole, exact):
            memory.add(rows(first, 5))
        assert len(exact) == len(whole)
        for ours, theirs in zip(exact.batches(3, 4), whole.batches(3, 4), strict=True):
            for name, expected in vars(theirs).items():
                np.testing.assert_array_equal(getattr(ours, name), expected, err_msg=name)
            if theirs.indices is not None:
                for memory in (whole, exact):
                    memory.set_priorities(theirs.indices, np.sin(theirs.rewards))
    if replay != "none":
        assert [len(memory._columns["obs"]) for memory in (whole, exact)] == [1_000, 60]
    # A memory that is smaller stays so.
    exact.expect(2_000)
    assert exact.capacity == (4 if replay == "none" else 60)


def test_the_newest_transitions_are_those_that_are_there() -> None:
    replay = LastTransitions(4, np.random.default_rng(0))
    replay.add(rows(0, 3))
    (batch,) = replay.batches(1, 4)
    assert batch.rewards.tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("replay", KINDS[:2])
@pytest.mark.parametrize(
    ("n_step", "episode", "length"),
    [(3, 100, 1), (3, 2, 1), (7, 5, 3), (40, 9, 4), (40, 100, 4)],
    ids=["longer than a fragment", "longer than an episode", "both", "longer than the memory", "and no end before it"],
)
def test_sums_of_many_steps_fill_every_memory(replay: str, n_step: int, episode: int, length: int) -> None:
    """Fragments of some steps; each transition that is complete is there once, whatever the fragments are."""
    num_steps, gamma = 60, 0.9
    memory = make_replay(
        DQNHyperparams(replay=replay, replay_capacity=20, train_batch_size=4, n_step=n_step, gamma=gamma), seed=0
    )
    steps = NStep(1, n_step, gamma)
    expected = []
    for first in range(0, num_steps, length):
        numbers = np.arange(first, first + length)
        columns = fragment(numbers, terminated=np.flatnonzero(numbers % episode == episode - 1))
        columns["obs"] = columns["obs"] + first
        memory.add(steps.transitions(columns))
        end = first + length
        for start in range(end):
            last = min(start // episode * episode + episode, start + n_step)
            if last <= end:
                expected += [start] if start not in expected else []
    assert len(memory) == min(20, len(expected))
    (batch,) = memory.batches(1, 500)
    assert set(batch.obs[:, 0]) == set(expected[-20:])
    for start, reward, discount in zip(batch.obs[:, 0], batch.rewards, batch.discounts, strict=True):
        last = int(min(start // episode * episode + episode, start + n_step))
        total = sum(gamma ** (step - start) * step for step in range(int(start), last))
        assert reward == pytest.approx(total, rel=1e-5)
        assert discount == pytest.approx(0.0 if last % episode == 0 else gamma**n_step)
