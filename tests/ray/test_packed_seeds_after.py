"""Random numbers of members that go on: new episodes each time, and after each copy numbers of its own."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from test_packed_copies import copied, engine_with, member_of, saved, task_of

from policies import random_streams
from policies.packed.member import AnyMember
from policies.packed.stack import Stack

pytestmark = pytest.mark.ray


@pytest.fixture
def seeds(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The seeds of the environments of members that are added to stacks, one after the other."""
    found: list[int] = []
    add = Stack.add

    def noting(self: Stack, member: AnyMember, env_seed: int, *rest: int) -> None:  # type: ignore[type-arg]
        found.append(env_seed)
        add(self, member, env_seed, *rest)

    monkeypatch.setattr(Stack, "add", noting)
    return found


def test_a_trial_that_goes_on_plays_no_episodes_again(tmp_path: Path, seeds: list[int]) -> None:
    task = task_of(tmp_path, "ppo", 0)
    engine = engine_with(task)
    for iteration in (1, 2):
        engine.train_iteration()
        folder = saved(engine, "t0000", tmp_path / f"{iteration:06d}")
        engine.remove("t0000")
        engine.add(dataclasses.replace(task, num_iterations=iteration), folder)
    engine.close()
    assert seeds == [task.seed, *(random_streams.member_env_seed_after(task.seed, iteration) for iteration in (1, 2))]
    assert len(set(seeds)) == 3


def test_a_member_that_waited_plays_no_episodes_again(tmp_path: Path, seeds: list[int]) -> None:
    tasks = [task_of(tmp_path, "ppo", number) for number in (0, 1)]
    engine = engine_with(*tasks)
    engine.train_iteration()
    engine.train_iteration({"t0001"})
    engine.close()
    # It got a stack of its own while the other was trained.
    assert seeds[2:] == [random_streams.member_env_seed_after(tasks[1].seed, 1)]


def test_each_copy_draws_and_plays_by_its_own_count(tmp_path: Path, seeds: list[int]) -> None:
    tasks = [task_of(tmp_path, "ppo", number) for number in (0, 1)]
    engine = engine_with(*tasks)
    for _ in range(3):
        engine.train_iteration()
    folder = saved(engine, "t0000", tmp_path / "000003")
    copied(engine, tasks[1], folder)
    # After two iterations of its own, whatever those of the other one are.
    expected = random_streams.member_draws_after(tasks[1].seed, 2)
    assert member_of(engine, "t0001").rng.bit_generator.state == expected.bit_generator.state
    assert seeds[2:] == [random_streams.member_env_seed_after(tasks[1].seed, 2)]
    engine.close()
