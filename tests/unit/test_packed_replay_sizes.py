"""Members of one stacked replay memory whose own memories differ in size: each takes the room of its own."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from fake_engine import make_task
from numpy.typing import NDArray
from replay_rows import BATCH, D, make_hyperparams

from policies.packed.dqn.replay import StackedPrioritizedReplay, StackedReplay, make_stacked_replay
from policies.packed.inputs import Inputs
from policies.sum_trees import SumTrees
from tune_jobs.training.packed import PackedEngine

KINDS = ("uniform", "prioritized", "none")
SIZES: dict[str, Any] = {
    "train_batch_size": 8, "learning_starts": 8, "env_steps_per_iteration": 128, "num_envs": 2, "hidden_sizes": (8,),
}  # fmt: skip


def memory_of(replay: str, **capacities: int) -> StackedReplay:
    stacked = make_stacked_replay(cast("Any", make_hyperparams(replay=replay)), Inputs.vector(D))
    for name, capacity in capacities.items():
        join(stacked, replay, name, capacity)
    return stacked


def join(stacked: StackedReplay, replay: str, name: str, capacity: int) -> None:
    alpha = 0.3 + len(name) / 10
    stacked.add_member(name, make_hyperparams(replay=replay, replay_capacity=capacity, prioritized_alpha=alpha))


def put(stacked: StackedReplay, name: str, count: int, first: int = 0) -> None:
    """Add rows that tell their number in every column."""
    numbers = np.arange(first, first + count, dtype=np.float32)
    stacked.add(stacked.slots([name]), np.repeat(numbers[None, :, None], stacked.num_columns, axis=2))


def written(stacked: StackedReplay, name: str) -> NDArray[np.float32]:
    (slot,) = stacked.slots([name]).tolist()
    return stacked.written(slot).copy()


@pytest.mark.parametrize("replay", ["uniform", "prioritized"])
def test_a_large_memory_makes_no_other_one_larger(replay: str) -> None:
    capacities = {"large": 100_000} | {f"small{number}": 2_000 for number in range(11)}
    stacked = memory_of(replay, **capacities)
    assert stacked._rows.nbytes <= sum(capacities.values()) * stacked.num_columns * 4
    if isinstance(stacked, StackedPrioritizedReplay):
        # Trees' leaves are powers of 2, 131,072 and 2,048, and together a multiple of the largest.
        assert len(stacked._priorities.leaves) == 2 * 131_072


@pytest.mark.parametrize("replay", KINDS)
def test_memories_for_all_that_will_come_give_the_same_batches(replay: str) -> None:
    hyperparams = [make_hyperparams(replay=replay, replay_capacity=capacity) for capacity in (10_000, 25)]
    whole, exact = memory_of(replay), memory_of(replay)
    for name, own in zip("ab", hyperparams, strict=True):
        whole.add_member(name, own)
        exact.add_member(name, own, 60)
    assert len(exact._rows) == (2 * BATCH if replay == "none" else 60 + 25)
    rng, slots = np.random.default_rng(0), whole.slots(["a", "b"])
    for _ in range(12):
        new = rng.normal(size=(2, 5, whole.num_columns)).astype(np.float32)
        numbers, errors = rng.random((2, BATCH)), rng.normal(size=(2, BATCH)).astype(np.float32)
        for memory in (whole, exact):
            memory.add(slots, new)
        theirs, ours = whole.draw(slots, numbers), exact.draw(slots, numbers)
        for name, expected in vars(theirs).items():
            np.testing.assert_array_equal(getattr(ours, name), expected, err_msg=name)
        if theirs.indices is not None:
            for memory in (whole, exact):
                memory.set_priorities(slots, theirs.indices, errors)


@pytest.mark.parametrize("replay", ["uniform", "prioritized"])
def test_a_trial_has_no_larger_memory_than_it_fills(replay: str, tmp_path: Path) -> None:
    ends = []
    for capacity in (2_000, 10**15):
        hyperparams = SIZES | {"replay": replay, "replay_capacity": capacity}
        task = replace(make_task(tmp_path, hyperparams=hyperparams, stop={"num_iterations": 4}), algorithm="dqn")
        engine = PackedEngine("scalar")
        engine.add(task, None)
        stats = [engine.train_iteration()[task.trial_id] for _ in range(4)]
        (stack,) = engine._stacks.values()
        ends.append((stats, stack.member(task.trial_id)))
        engine.close()
    (stats, member), (stats2, member2) = ends
    assert stats == stats2
    assert member.num_updates == member2.num_updates > 0
    for name, weight in member.weights.items():
        np.testing.assert_array_equal(member2.weights[name], weight, err_msg=name)


@pytest.mark.parametrize("replay", ["uniform", "prioritized"])
def test_members_that_join_take_the_room_of_those_that_left(replay: str) -> None:
    stacked = memory_of(replay, a=30, large=1_000, b=40)
    for name in ("a", "large", "b"):
        put(stacked, name, 35)
    array, starts = stacked._rows, stacked._start[stacked.slots(["a", "b"])]
    numbers = np.random.default_rng(0).random((2, 200))
    before = [written(stacked, name) for name in ("a", "b")]
    drawn = stacked.draw(stacked.slots(["a", "b"]), numbers)
    stacked.remove_member("large")
    for number in range(10):
        join(stacked, replay, f"new{number}", 100)
        put(stacked, f"new{number}", 100, first=1_000 * (number + 1))
    # Nobody was moved for it.
    assert stacked._rows is array
    np.testing.assert_array_equal(stacked._start[stacked.slots(["a", "b"])], starts)
    for name, rows in zip(("a", "b"), before, strict=True):
        np.testing.assert_array_equal(written(stacked, name), rows)
    again = stacked.draw(stacked.slots(["a", "b"]), numbers)
    np.testing.assert_array_equal(again.rows, drawn.rows)
    np.testing.assert_array_equal(cast("Any", again.weights), cast("Any", drawn.weights))
    for number in range(10):
        np.testing.assert_array_equal(written(stacked, f"new{number}")[:, 0], 1_000 * (number + 1) + np.arange(100))


def test_room_that_lies_in_pieces_is_put_together_without_a_second_array() -> None:
    stacked = memory_of("uniform", a=20_000, b=20_000, c=20_000, d=20_000)
    for number, name in enumerate("abcd"):
        put(stacked, name, 15_000, first=100_000 * number)
    array, before = stacked._rows, [written(stacked, name) for name in "bd"]
    for name in "ac":
        stacked.remove_member(name)
    tracemalloc.start()
    join(stacked, "uniform", "large", 40_000)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert stacked._rows is array
    assert peak < array.nbytes / 20
    put(stacked, "large", 40_000, first=900_000)
    for name, rows in zip("bd", before, strict=True):
        np.testing.assert_array_equal(written(stacked, name), rows)
    np.testing.assert_array_equal(written(stacked, "large")[:, 0], 900_000 + np.arange(40_000))
    # More than all of it makes it as large as all members need.
    stacked.remove_member("b")
    join(stacked, "uniform", "larger", 50_000)
    assert len(stacked._rows) == 20_000 + 40_000 + 50_000
    np.testing.assert_array_equal(written(stacked, "d"), before[1])


@pytest.mark.parametrize("gone", ["a", "b", "c"])
def test_room_that_is_one_row_too_small_is_not_taken(gone: str) -> None:
    stacked = memory_of("uniform", a=20, b=20, c=20)
    kept = [name for name in "abc" if name != gone]
    for number, name in enumerate(kept):
        put(stacked, name, 20, first=100 * number)
    stacked.remove_member(gone)
    join(stacked, "uniform", "new", 21)
    put(stacked, "new", 21, first=900)
    assert len(stacked._rows) == 61
    for number, name in enumerate(kept):
        np.testing.assert_array_equal(written(stacked, name)[:, 0], 100 * number + np.arange(20))
    np.testing.assert_array_equal(written(stacked, "new")[:, 0], 900 + np.arange(21))


@pytest.mark.parametrize("replay", KINDS)
def test_members_of_any_sizes_draw_what_each_draws_alone(replay: str) -> None:
    """To the bit: rows, weights and places, while members of other sizes come and go."""
    rng, sizes = np.random.default_rng(3), (7, 5_000, 64, 65, 6, 900, 33, 3_000)
    together, alone = memory_of(replay), dict[str, StackedReplay]()
    for turn in range(120):
        if turn % 4 == 0:
            if len(alone) == 5:
                gone = str(rng.choice(list(alone)))
                together.remove_member(gone)
                del alone[gone]
            name, capacity = f"{'m' * (turn % 3 + 1)}{turn}", sizes[turn // 4 % len(sizes)]
            join(together, replay, name, capacity)
            alone[name] = memory_of(replay, **{name: capacity})
        names = rng.permutation(list(alone))[: rng.integers(1, len(alone) + 1)].tolist()
        slots, rows = together.slots(names), rng.random((len(names), 150, together.num_columns), dtype=np.float32)
        together.add(slots, rows)
        numbers, errors = rng.random((len(names), BATCH)), rng.normal(size=(len(names), BATCH)).astype(np.float32)
        drawn = together.draw(slots, numbers)
        if drawn.indices is not None:
            together.set_priorities(slots, drawn.indices, errors)
        for at, name in enumerate(names):
            own, one = alone[name], np.array([0])
            own.add(one, rows[at : at + 1])
            found = own.draw(one, numbers[at : at + 1])
            np.testing.assert_array_equal(found.rows[0], drawn.rows[at])
            if drawn.indices is not None:
                np.testing.assert_array_equal(cast("Any", found.weights)[0], cast("Any", drawn.weights)[at])
                np.testing.assert_array_equal(cast("Any", found.indices)[0], drawn.indices[at])
                own.set_priorities(one, cast("Any", found.indices), errors[at : at + 1])


def test_a_member_whose_priorities_do_not_fit_into_memory_leaves_nothing_behind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> SumTrees:
        raise MemoryError

    stacked = memory_of("prioritized", a=20)
    put(stacked, "a", 20)
    before = stacked.draw(stacked.slots(["a"]), np.linspace(0, 0.99, 30)[None])
    with monkeypatch.context() as patch:
        patch.setattr(SumTrees, "resized", fail)
        with pytest.raises(MemoryError):
            join(stacked, "prioritized", "b", 5_000)
    assert set(stacked._slots) == {"a"}
    join(stacked, "prioritized", "b", 5_000)
    put(stacked, "b", 10)
    again = stacked.draw(stacked.slots(["a"]), np.linspace(0, 0.99, 30)[None])
    np.testing.assert_array_equal(again.rows, before.rows)
