"""Trials of a pack whose environments share processes: the one whose environment ends them fails, and only that one."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pytest
from fake_engine import make_task
from test_packed_envs import go_on, make, own_modules

from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.policy import Policy
from policies.packed.envs.sub_envs import HostDiedError
from tests.narrowing import present
from tune_jobs.training.pack_loop import MemberReport, PackLoop
from tune_jobs.training.packed import PackedEngine

if TYPE_CHECKING:
    from policies.packed.envs.vector import PackedEnvs

__all__ = ["make", "own_modules"]


def evaluate(_: Evaluator, policies: Sequence[Policy]) -> list[Episodes | Exception]:
    return [Episodes((1, 2), (1.0, 2.0), (1, 2)) for _ in policies]


@pytest.mark.usefixtures("own_modules")
def test_without_retries_one_that_ends_the_process_of_another_fails_by_itself(tmp_path: Path) -> None:
    engine, reports = PackedEngine("processes", 2), list[MemberReport]()
    loop = PackLoop(engine, cast("Evaluator", None), evaluate, stop_requested=lambda: False, max_retries=0)
    hyperparams: dict[str, Any] = {
        "train_batch_size": 16, "minibatch_size": 16, "num_epochs": 1, "num_envs": 2, "hidden_sizes": (4,),
    }  # fmt: skip
    for trial_id, seed in (("t0000", 5), ("t0001", 60)):
        task = make_task(tmp_path, hyperparams=hyperparams, stop={"num_iterations": 2})
        task = dataclasses.replace(task, env_id="odd_envs:EndsFor", env_args={"seed": 60})
        loop.add(dataclasses.replace(task, trial_id=trial_id, seed=seed))
    for _ in range(9):
        reports += loop.advance(0.0, until_evaluated=True)
    engine.close()
    assert loop.trial_ids == ()
    failures = {
        name: [(one.retried, one.counts) for one in reports if one.trial_id == name and one.error is not None]
        for name in ("t0000", "t0001")
    }
    assert failures == {"t0000": [(True, False)], "t0001": [(True, False), (False, True)]}
    last = present(next(one.progress for one in reversed(reports) if one.trial_id == "t0000"))
    assert (last.status, last.num_iterations) == ("completed", 2)
    assert multiprocessing.active_children() == []


def in_company(error: BaseException) -> bool:
    assert isinstance(error, HostDiedError)
    return error.in_company


def test_whoever_is_with_others_in_a_process_that_dies_is_known(make: Callable[..., PackedEnvs]) -> None:
    suspects = set[str]()
    envs = make("odd_envs:Fragile", "processes", num_envs=2, members={"a": 1}, num_processes=1, suspects=suspects)
    (process,) = multiprocessing.active_children()
    process.kill()
    process.join()
    # Nobody but a has an environment there yet, and b would have been the next.
    with pytest.raises(HostDiedError) as failure:
        envs.add("b", 2)
    assert in_company(failure.value)
    assert in_company(envs.errors["a"])
    assert suspects == {"a", "b"}
    # Others know of it, too: there each has a process of its own.
    more = make("odd_envs:Fragile", "processes", num_envs=2, members={"a": 1}, num_processes=1, suspects=suspects)
    (process,) = multiprocessing.active_children()
    os.kill(present(process.pid), signal.SIGKILL)
    go_on(more)
    assert not in_company(more.errors["a"])


def test_who_finds_several_processes_dead_was_in_company(make: Callable[..., PackedEnvs]) -> None:
    envs = make("odd_envs:Fragile", "processes", num_envs=2, members={"a": 1, "b": 2}, num_processes=2)
    for process in multiprocessing.active_children():
        process.kill()
        process.join()
    with pytest.raises(HostDiedError) as failure:
        envs.add("c", 3)
    assert in_company(failure.value)
    assert all(in_company(error) for error in envs.errors.values())
    assert set(envs.errors) == {"a", "b"}
