"""Environments of a pack that raise, or whose process dies: their member fails, the others go on."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest
from odd_envs import EXIT, RAISE, WRONG_SHAPE
from test_packed_envs import assert_equal_bits, go_on, make, own_modules, rows_of, seen_by

from policies.errors import EnvError
from tests.narrowing import present

if TYPE_CHECKING:
    from policies.packed.envs.vector import PackedEnvs

__all__ = ["make", "own_modules"]


@pytest.mark.parametrize("kind", ["scalar", "processes"])
@pytest.mark.parametrize(("how", "words"), [(RAISE, "the motor broke"), (WRONG_SHAPE, r"shape \(5,\), not \(2,\)")])
def test_an_env_that_raises_fails_its_member_alone(
    make: Callable[..., PackedEnvs], kind: str, how: int, words: str
) -> None:
    envs = make("odd_envs:Fragile", kind, members={"a": 1, "b": 2, "c": 3}, num_processes=2)
    alone = make("odd_envs:Fragile", "scalar", members={"a": 1, "c": 3})
    for index in range(20):
        step, expected = go_on(envs, "b", how if index == 3 else 0), go_on(alone)
        for member_id in ("a", "c"):
            assert_equal_bits([seen_by(envs, step, member_id)], [seen_by(alone, expected, member_id)])
        if index >= 3:
            assert all((values == 0).all() for values in seen_by(envs, step, "b").values())
            assert (envs.observations[rows_of(envs, "b")] == 0).all()
    assert list(envs.errors) == ["b"]
    error = envs.errors["b"]
    assert isinstance(error, EnvError)
    with pytest.raises(EnvError, match=rf"odd_envs:Fragile raised an error in step\(\): .*{words}"):
        raise error
    # Where in the env it happened, for the trial's log.
    assert ("odd_envs.py" if how == RAISE else "sub_envs.py") in "".join(traceback.format_exception(error))
    envs.arrange(["b", "c", "a"])
    envs.remove("b")
    assert envs.errors == {}
    envs.add("b", 2)
    step = go_on(envs)
    assert (step.observations[rows_of(envs, "b")] != 0).all()
    assert envs.errors == {}


@pytest.mark.parametrize("kind", ["scalar", "processes"])
def test_a_member_that_cannot_be_reset_is_none(make: Callable[..., PackedEnvs], kind: str) -> None:
    envs = make("odd_envs:RefusesSeeds", kind, num_envs=2, members={"a": 2}, num_processes=2)
    with pytest.raises(EnvError, match=r"reset\(\): ValueError: 13 brings bad luck"):
        envs.add("b", 12)  # its second sub-environment, in another process than the first
    assert envs.member_ids == ("a",)
    assert envs.errors == {}
    go_on(envs)
    envs.add("b", 14)
    step = go_on(envs)
    alone = make("odd_envs:RefusesSeeds", "scalar", num_envs=2, members={"b": 14})
    np.testing.assert_array_equal(step.observations[2:], go_on(alone).observations)


def test_members_of_a_process_that_dies_fail_and_the_guilty_one_takes_no_others_with_it_again(
    make: Callable[..., PackedEnvs],
) -> None:
    envs = make("odd_envs:Fragile", "processes", members={"a": 1, "b": 2}, num_processes=2)
    go_on(envs)
    # Places 0 and 2 of a, and place 1 of b, are in one process.
    step = go_on(envs, "b", EXIT)
    assert set(envs.errors) == {"a", "b"}
    assert "ended with exit code 7" in str(envs.errors["a"])
    assert (step.observations == 0).all()
    assert not go_on(envs).rewards.any()
    for member_id, seed in (("a", 1), ("b", 2)):
        envs.remove(member_id)
        envs.add(member_id, seed)
    envs.add("c", 3)
    assert envs.errors == {}
    go_on(envs)
    step = go_on(envs, "b", EXIT)
    assert list(envs.errors) == ["b"]
    alone = make("odd_envs:Fragile", "scalar", members={"a": 1, "c": 3})
    go_on(alone)
    expected = go_on(alone)
    for member_id in ("a", "c"):
        assert_equal_bits([seen_by(envs, step, member_id)], [seen_by(alone, expected, member_id)])


def test_a_process_that_is_killed_fails_its_members(make: Callable[..., PackedEnvs]) -> None:
    envs = make("odd_envs:Fragile", "processes", num_envs=2, members={"a": 1}, num_processes=1)
    os.kill(present(multiprocessing.active_children()[0].pid), signal.SIGKILL)
    go_on(envs)
    assert "was killed by SIGKILL" in str(envs.errors["a"])
    assert isinstance(envs.errors["a"], EnvError)
    envs.remove("a")
    envs.add("b", 2)  # another process takes its place
    assert go_on(envs).rewards.all()


def test_what_an_env_has_forked_does_not_hide_that_its_process_has_ended(make: Callable[..., PackedEnvs]) -> None:
    envs = make("odd_envs:Helped", "processes", num_envs=2, members={"a": 1}, num_processes=2)
    go_on(envs)
    assert envs.errors == {}
    before = time.monotonic()
    envs.step(np.array([0, EXIT]))
    assert "ended with exit code 7" in str(envs.errors["a"])
    envs.remove("a")
    assert time.monotonic() - before < 6


def test_an_env_that_cannot_be_closed_has_its_failure_looked_up(make: Callable[..., PackedEnvs]) -> None:
    envs = make("odd_envs:ClosesBadly", "scalar", members={"a": 1}, failure_penalty=-7.0)
    for _ in range(7):
        step = go_on(envs)
    assert (step.rewards == -7).all()


def test_a_process_that_is_dead_when_a_member_comes_fails_both(make: Callable[..., PackedEnvs]) -> None:
    envs = make("odd_envs:Fragile", "processes", num_envs=2, members={"a": 1}, num_processes=1)
    process = multiprocessing.active_children()[0]
    process.kill()
    process.join()
    with pytest.raises(EnvError, match="SIGKILL"):
        envs.add("b", 2)
    assert envs.member_ids == ("a",)
    assert list(envs.errors) == ["a"]
    assert (envs.observations == 0).all()
    envs.add("b", 2)
    go_on(envs)
    assert list(envs.errors) == ["a"]


# -- which kind
