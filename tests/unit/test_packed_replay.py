"""Stacked replay memories hold and draw what one memory a member does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from replay_rows import BATCH, D, as_rows, make_hyperparams

from policies.hyperparams import DQNHyperparams
from policies.packed.dqn.replay import Drawn, StackedPrioritizedReplay, StackedReplay, make_stacked_replay
from policies.packed.envs.vector import Step
from policies.packed.inputs import Inputs
from policies.replay import LastTransitions, PrioritizedReplayBuffer, ReplayBuffer, Transitions, make_replay
from tests.narrowing import present

Seen = tuple[NDArray[np.float32], NDArray[np.int64], Step]


def transitions(first: int, count: int) -> Transitions:
    """Rows that tell their number."""
    numbers = np.arange(first, first + count, dtype=np.float32)
    obs = np.stack([numbers, -numbers], axis=1)
    return Transitions(obs, (numbers % 3).astype(np.int64), numbers, obs + np.float32(0.5), numbers / np.float32(1000))


def stack_of(replay: str, *members: tuple[str, dict[str, float]]) -> StackedPrioritizedReplay | StackedReplay:
    """A memory with members of (name, further hyperparameters)."""
    stacked = make_stacked_replay(cast("Any", make_hyperparams(replay=replay)), Inputs.vector(D))
    for name, values in members:
        stacked.add_member(name, make_hyperparams(replay=replay, **values))
    return stacked


def put(stacked: StackedReplay, names: Sequence[str], *parts: Transitions) -> None:
    stacked.add(stacked.slots(names), np.stack([as_rows(part) for part in parts]))


def numbers_of(drawn: Drawn) -> NDArray[np.int64]:
    """Which rows were drawn, (M, B)."""
    return drawn.rows[..., -2].astype(int)


class Given:
    """Stands in for a random generator: gives the numbers that the stack is given."""

    def __init__(self) -> None:
        self.numbers = np.zeros(0)

    def integers(self, low: int, high: int, shape: tuple[int, int]) -> NDArray[np.int64]:
        return (self.numbers * high).astype(np.int64).reshape(shape)

    def uniform(self, low: float, high: float, size: tuple[int, int]) -> NDArray[np.float64]:
        return self.numbers * high


class Separate:
    """A memory of `policies.replay` for one member."""

    def __init__(self, hyperparams: DQNHyperparams) -> None:
        self.batch_size, self.given = hyperparams.train_batch_size, Given()
        self.replay = make_replay(hyperparams, seed=0)
        self.replay.rng = cast("Any", self.given)
        self.num_rows = 0

    def add(self, count: int) -> Transitions:
        new = transitions(self.num_rows, count)
        self.num_rows += count
        self.replay.add(new)
        return new

    def draw(self, numbers: NDArray[np.float64]) -> Transitions:
        self.given.numbers = numbers
        return next(self.replay.batches(1, self.batch_size))


class Both:
    """The same members in a stacked memory and in separate ones, which must give the same."""

    def __init__(self, replay: str, seed: int) -> None:
        self.kind, self.rng, self.stacked = replay, np.random.default_rng(seed), stack_of(replay)
        self.separate: dict[str, Separate] = {}
        self.num_draws = 0

    def come(self) -> None:
        name = f"m{self.rng.integers(1000)}"
        if name in self.separate:
            return
        hyperparams = make_hyperparams(
            replay=self.kind,
            replay_capacity=int(self.rng.integers(BATCH, 40)),
            prioritized_alpha=float(self.rng.random()),
            prioritized_beta=float(self.rng.random()),
            prioritized_epsilon=float(10 ** self.rng.uniform(-7, 1)),
        )
        self.stacked.add_member(name, hyperparams)
        self.separate[name] = Separate(hyperparams)

    def leave(self) -> None:
        if len(self.separate) > 1:
            name = str(self.rng.choice(list(self.separate)))
            self.stacked.remove_member(name)
            del self.separate[name]

    def some(self) -> list[str]:
        return cast(
            "list[str]",
            self.rng.permutation(list(self.separate))[: self.rng.integers(1, len(self.separate) + 1)].tolist(),
        )

    def add(self, names: Sequence[str], count: int) -> None:
        put(self.stacked, names, *(self.separate[name].add(count) for name in names))
        sizes = self.stacked.sizes(self.stacked.slots(names))
        assert list(sizes) == [len(self.separate[name].replay) for name in names]

    def draw(self, names: Sequence[str]) -> None:
        if any(self.separate[name].num_rows < BATCH for name in names):
            return
        slots, shape = self.stacked.slots(names), (len(names), BATCH)
        numbers, errors = self.rng.random(shape), self.rng.normal(size=shape).astype(np.float32)
        drawn = self.stacked.draw(slots, numbers)
        for index, name in enumerate(names):
            expected = self.separate[name].draw(numbers[index])
            np.testing.assert_array_equal(drawn.rows[index], as_rows(expected))
            assert (drawn.weights is None) == (expected.weights is None) == (self.kind != "prioritized")
            if drawn.weights is not None:
                np.testing.assert_allclose(drawn.weights[index], present(expected.weights), rtol=1e-6)
                np.testing.assert_array_equal(present(drawn.indices)[index], expected.indices)
                self.separate[name].replay.set_priorities(present(expected.indices), errors[index])
        if drawn.indices is not None:
            self.stacked.set_priorities(slots, drawn.indices, errors)
        self.num_draws += 1


@pytest.mark.parametrize("replay", ["uniform", "prioritized", "none"])
@pytest.mark.parametrize("seed", range(4))
def test_stacked_memories_are_separate_ones(replay: str, seed: int) -> None:
    """Members come, go, add up to more than fits, draw and set priorities, alone and together, in any order."""
    both, most = Both(replay, seed), 0
    for _ in range(3):
        both.come()
    for _ in range(300):
        if both.rng.random() < 0.03:
            both.come()
        if both.rng.random() < 0.03:
            both.leave()
        most = max(most, len(both.separate))
        names = both.some()
        both.add(names, int(both.rng.choice([1, 2, 5, 8, 45])))
        both.draw(names)
    assert both.num_draws > 200
    assert most > 3


def test_the_oldest_rows_go_first_and_of_more_than_fit_the_newest_stay() -> None:
    stacked = stack_of("uniform", ("a", {"replay_capacity": 6}), ("b", {"replay_capacity": 9}))
    for first in (0, 4):
        put(stacked, ["a", "b"], transitions(first, 4), transitions(100 + first, 4))
    numbers = (np.arange(400) / 400)[None].repeat(2, axis=0)
    found = numbers_of(stacked.draw(stacked.slots(["a", "b"]), numbers))
    assert set(found[0]) == set(range(2, 8))
    assert set(found[1]) == set(range(100, 108))
    # Both at once, of which one has room.
    put(stacked, ["b", "a"], transitions(200, 8), transitions(50, 8))
    found = numbers_of(stacked.draw(stacked.slots(["a", "b"]), numbers))
    assert set(found[0]) == set(range(52, 58))
    assert set(found[1]) == {107, *range(200, 208)}
    assert list(stacked.sizes(stacked.slots(["a", "b"]))) == [6, 9]


def test_uniform_draws_every_row_as_often() -> None:
    stacked = stack_of("uniform", ("a", {}), ("b", {"replay_capacity": 40}))
    put(stacked, ["a"], transitions(0, 10))
    put(stacked, ["b"], transitions(0, 25))
    found = numbers_of(stacked.draw(stacked.slots(["b", "a"]), np.random.default_rng(0).random((2, 10_000))))
    for drawn, count in zip(found, (25, 10), strict=True):
        observed = np.bincount(drawn, minlength=count)
        assert len(observed) == count
        # Of a chi-square distribution: mean count - 1, variance twice that.
        chi_square = ((observed - 10_000 / count) ** 2 / (10_000 / count)).sum()
        assert chi_square < count - 1 + 5 * np.sqrt(2 * (count - 1))


def test_no_replay_gives_the_newest_rows_in_order() -> None:
    stacked = stack_of("none", ("a", {}), ("b", {}))
    put(stacked, ["a", "b"], transitions(0, 4), transitions(100, 4))
    put(stacked, ["a", "b"], transitions(4, 5), transitions(104, 5))
    found = numbers_of(stacked.draw(stacked.slots(["a", "b"]), np.zeros((2, BATCH))))
    assert found.tolist() == [[3, 4, 5, 6, 7, 8], [103, 104, 105, 106, 107, 108]]


@pytest.mark.parametrize("replay", ["uniform", "none"])
def test_several_batches_at_once_are_those_of_one_after_another(replay: str) -> None:
    stacked = stack_of(replay, ("a", {}), ("b", {"replay_capacity": 40}))
    put(stacked, ["a", "b"], transitions(0, 20), transitions(100, 20))
    slots, numbers = stacked.slots(["b", "a"]), np.random.default_rng(0).random((3, 2, BATCH))
    assert stacked.draws_ahead
    together = stacked.draw(slots, numbers).rows
    assert together.shape == (3, 2, BATCH, stacked.num_columns)
    for found, own in zip(together, numbers, strict=True):
        np.testing.assert_array_equal(found, stacked.draw(slots, own).rows)


def test_priorities_decide_what_is_drawn_next() -> None:
    assert not stack_of("prioritized").draws_ahead


@pytest.mark.parametrize("replay", ["uniform", "prioritized", "none"])
def test_a_slot_that_is_used_again_holds_nothing_of_the_member_before(replay: str) -> None:
    # Also where its new member holds less, or the array has grown meanwhile.
    for capacity in (10, 7, 33):
        stacked = stack_of(replay, ("old", {}), ("other", {}))
        put(stacked, ["old", "other"], transitions(0, 10), transitions(100, 10))
        slots = stacked.slots(["old"])
        if replay == "prioritized":
            stacked.set_priorities(slots, np.arange(10)[None], np.full((1, 10), 50.0, dtype=np.float32))
        stacked.remove_member("old")
        stacked.add_member("new", make_hyperparams(replay=replay, replay_capacity=capacity))
        assert stacked.slots(["new"]) == slots
        assert list(stacked.sizes(stacked.slots(["new", "other"]))) == [0, BATCH if replay == "none" else 10]
        put(stacked, ["new"], transitions(200, BATCH))
        drawn = stacked.draw(stacked.slots(["new", "other"]), np.linspace(0, 0.999, BATCH)[None].repeat(2, axis=0))
        mine, theirs = numbers_of(drawn)
        assert set(mine) == set(range(200, 206))
        assert set(theirs) <= set(range(100, 110))
        if replay == "prioritized":
            # The highest priority is that of a new memory again.
            assert set(present(drawn.weights)[0]) == {1.0}
            assert cast("Any", stacked)._priorities.totals[slots[0]] == pytest.approx(BATCH)


@pytest.mark.parametrize("replay", ["uniform", "prioritized"])
def test_the_memory_grows_for_more_members_and_larger_ones(replay: str) -> None:
    stacked = stack_of(replay, ("a", {}))
    put(stacked, ["a"], transitions(0, 13))
    before = numbers_of(stacked.draw(stacked.slots(["a"]), np.linspace(0, 0.999, 50)[None]))
    for number, capacity in enumerate((6, 10, 11, 500)):
        stacked.add_member(f"new{number}", make_hyperparams(replay=replay, replay_capacity=capacity))
        found = numbers_of(stacked.draw(stacked.slots(["a"]), np.linspace(0, 0.999, 50)[None]))
        np.testing.assert_array_equal(found, before)
    put(stacked, ["new3"], transitions(1000, 501))
    found = numbers_of(stacked.draw(stacked.slots(["new3"]), np.linspace(0, 0.9999, 5000)[None]))
    assert set(found[0]) == set(range(1001, 1501))
    assert list(stacked.sizes(stacked.slots(["a", "new0", "new3"]))) == [10, 0, 500]


# -- priorities


def test_prioritized_draws_in_proportion_to_what_each_member_makes_of_its_errors() -> None:
    errors = np.arange(1, 9, dtype=np.float32)[None].repeat(2, axis=0)
    members = [("a", {"prioritized_alpha": 1.0, "prioritized_beta": 1.0}), ("b", {"prioritized_alpha": 0.0})]
    stacked = stack_of("prioritized", *members)
    put(stacked, ["a", "b"], transitions(0, 8), transitions(0, 8))
    slots = stacked.slots(["a", "b"])
    stacked.set_priorities(slots, np.arange(8)[None].repeat(2, axis=0), errors)
    drawn = stacked.draw(slots, np.random.default_rng(1).random((2, 20_000)))
    for found, shares in zip(numbers_of(drawn), (np.arange(1, 9) / 36, np.full(8, 1 / 8)), strict=True):
        expected = 20_000 * shares
        chi_square = ((np.bincount(found, minlength=8) - expected) ** 2 / expected).sum()
        assert chi_square < 7 + 5 * np.sqrt(14)
    # With beta 1 the weights undo the preference; the largest is 1.
    np.testing.assert_allclose(present(drawn.weights)[0], 1 / (1 + numbers_of(drawn)[0]), rtol=1e-5)
    np.testing.assert_array_equal(present(drawn.weights)[1], 1.0)


def test_priorities_of_rows_that_are_in_a_batch_twice() -> None:
    stacked = stack_of("prioritized", ("a", {"prioritized_alpha": 1.0}))
    put(stacked, ["a"], transitions(0, 4))
    indices = np.array([[2, 2, 0, 2, 0]])
    stacked.set_priorities(stacked.slots(["a"]), indices, np.array([[3.0, 3.0, 5.0, 3.0, 5.0]], dtype=np.float32))
    leaves = cast("Any", stacked)._priorities.leaves[:5]
    np.testing.assert_allclose(leaves, [5, 1, 3, 1, 0], rtol=1e-5)
    assert cast("Any", stacked)._priorities.totals[0] == pytest.approx(10, rel=1e-5)
    found = numbers_of(stacked.draw(stacked.slots(["a"]), np.array([[0.0, 0.49, 0.51, 0.59, 0.61, 0.89, 0.91]])))
    assert found.tolist() == [[0, 0, 1, 1, 2, 2, 3]]


def test_errors_that_are_no_numbers_do_not_spoil_the_trees() -> None:
    stacked = stack_of("prioritized", ("a", {}), ("b", {}))
    put(stacked, ["a", "b"], transitions(0, 4), transitions(0, 4))
    slots = stacked.slots(["a", "b"])
    errors = np.array([[np.nan, np.inf, 1.0, 2.0], [0.5, 0.5, 0.5, 0.5]], dtype=np.float32)
    stacked.set_priorities(slots, np.arange(4)[None].repeat(2, axis=0), errors)
    assert np.isfinite(cast("Any", stacked)._priorities.leaves).all()
    assert np.isfinite(cast("Any", stacked)._priorities.totals).all()
    assert np.isfinite(present(stacked.draw(slots, np.full((2, BATCH), 0.1)).weights)).all()


@pytest.mark.parametrize(
    ("replay", "kind", "reference"),
    [
        ("uniform", StackedReplay, ReplayBuffer),
        ("none", StackedReplay, LastTransitions),
        ("prioritized", StackedPrioritizedReplay, PrioritizedReplayBuffer),
    ],
)
def test_the_memory_that_the_hyperparameters_name(
    replay: str, kind: type[StackedPrioritizedReplay | StackedReplay], reference: type
) -> None:
    hyperparams = make_hyperparams(replay=replay)
    assert type(make_stacked_replay(cast("Any", hyperparams), Inputs.vector(D))) is kind
    assert type(make_replay(hyperparams, 0)) is reference


# -- n-step sums


@pytest.mark.parametrize("replay", ["uniform", "prioritized", "none"])
def test_no_rows_change_nothing(replay: str) -> None:
    stacked, plain = (stack_of(replay, ("a", {}), ("b", {})) for _ in range(2))
    put(stacked, ["a", "b"], transitions(0, 0), transitions(0, 0))
    assert stacked.sizes(stacked.slots(["a", "b"])).tolist() == [0, 0]
    for memory in (stacked, plain):
        put(memory, ["a", "b"], transitions(0, 7), transitions(50, 7))
    put(stacked, ["b"], transitions(7, 0))
    slots = stacked.slots(["a", "b"])
    stacked.set_priorities(slots, np.zeros((2, 0), dtype=np.int64), np.zeros((2, 0), dtype=np.float32))
    numbers = np.random.default_rng(0).random((2, BATCH))
    np.testing.assert_array_equal(stacked.draw(slots, numbers).rows, plain.draw(slots, numbers).rows)
