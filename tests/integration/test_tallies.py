"""How far a trial is outlives its process, and is in the record of one that failed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from fake_engine import FakeClock, FakeEngine
from fake_pack import Pack
from test_packed_envs import go_on, make, own_modules
from test_record_keeper import kept, progress
from trial_runs import Trial

from policies.envs import faults as env_faults
from policies.envs import tallies
from policies.envs.checked import CheckedEnvs
from policies.envs.make import make_vector_env
from policies.envs.tallies import Reached, begin_tally, only_tally, read_tally, tally_of
from policies.errors import EnvError
from tests.narrowing import present
from tune_jobs.store.record_keeper import RecordKeeper
from tune_jobs.store.sweep_store import SweepStore

if TYPE_CHECKING:
    from policies.packed.envs.vector import PackedEnvs

__all__ = ["kept", "make", "own_modules"]

BEGUN = Reached(num_iterations=2, num_env_steps=200, num_episodes=3, time_s=7.0)
FAULTY = "odd_envs:Faulty"


@pytest.fixture(autouse=True)
def no_tallies(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a process of its own: tests of other files leave trials that were not run to their end."""
    monkeypatch.setattr(tallies, "_tallies", {})


def test_a_tally_outlives_a_process_that_is_killed(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom policies.envs.tallies import Reached, begin_tally\n"
        "tally = begin_tally('a', Path(sys.argv[1]), Reached(2, 200, 3, 7.0))\n"
        "for _ in range(5): tally.add(8, 1)\nos.kill(os.getpid(), signal.SIGKILL)"
    )
    path = tmp_path / ".tally"
    child = subprocess.run(
        [sys.executable, "-c", code, str(path)], env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        timeout=600, check=False,
    )  # fmt: skip
    assert child.returncode == -9
    reached = present(read_tally(path))
    assert (reached.num_iterations, reached.num_env_steps, reached.num_episodes) == (
        2,
        240,
        8,
    )
    assert reached.time_s >= 7.0


def test_a_process_that_has_lost_its_trial_counts_into_nothing(tmp_path: Path) -> None:
    old = begin_tally("a", tmp_path / ".tally", BEGUN)
    begin_tally("a", tmp_path / ".tally", BEGUN)
    old.add(100, 1)
    assert read_tally(tmp_path / ".tally") == BEGUN


def test_what_is_no_tally_says_nothing(tmp_path: Path) -> None:
    assert read_tally(tmp_path / ".tally") is None
    for content in (b"", b"x" * 31, np.array([np.nan, 1, 1, 1]).tobytes()):
        (tmp_path / ".tally").write_bytes(content)
        assert read_tally(tmp_path / ".tally") is None
    tally = begin_tally("a", tmp_path / "missing" / ".tally", BEGUN)
    tally.add(8, 1)
    assert tally.reached.num_env_steps == 208


@pytest.mark.parametrize("kind", ["scalar", "processes"])
def test_env_steps_of_a_pack_are_counted_up_to_the_failure(
    make: Callable[..., PackedEnvs], tmp_path: Path, kind: str
) -> None:
    for name in ("a", "b"):
        begin_tally(name, tmp_path / name, BEGUN)
    envs = make(FAULTY, kind, env_args={"raises": "OwnStop", "action": 1}, members={"a": 1, "b": 2}, num_processes=2)
    for index in range(12):
        go_on(envs, "b", 1 if index == 9 else 0)
    # Three sub-environments each; an episode takes seven steps.
    assert (present(tally_of("a")).reached.num_env_steps, present(tally_of("a")).reached.num_episodes) == (236, 6)
    assert (present(tally_of("b")).reached.num_env_steps, present(tally_of("b")).reached.num_episodes) == (227, 6)
    assert read_tally(tmp_path / "b") == present(tally_of("b")).reached
    envs.remove("b")
    go_on(envs)
    assert present(tally_of("b")).reached.num_env_steps == 227


def test_env_steps_of_a_vector_env_are_counted_without_those_that_reset(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(env_faults, "_notes_signals", True)
    begin_tally("a", tmp_path / "a", BEGUN)
    envs = CheckedEnvs(make_vector_env(FAULTY, {"raises": "OwnStop", "action": 1}, 2), FAULTY)
    envs.reset(seed=5)
    for _ in range(10):
        envs.step(np.zeros(2, dtype=np.int64))
    with pytest.raises(EnvError):
        envs.step(np.ones(2, dtype=np.int64))
    # Ten steps, one of which only reset.
    assert (present(only_tally()).reached.num_env_steps, present(only_tally()).reached.num_episodes) == (218, 5)
    begin_tally("b", tmp_path / "b", BEGUN)
    assert only_tally() is None


def test_a_trial_s_tally_follows_it_and_is_gone_at_its_end(tmp_path: Path) -> None:
    trial = Trial(tmp_path, engine=FakeEngine(raise_at=4), evaluation={"every_iterations": 2})
    path = trial.store.tally_path
    assert read_tally(path) == Reached(0, 0, 0, 0.0)
    trial.run_to(2)
    present(tally_of("t0000")).add(30, 2)
    with pytest.raises(ZeroDivisionError):
        trial.run()
    # The fourth iteration is not whole; of it is known what was counted while it lasted.
    found = present(read_tally(path))
    assert (found.num_iterations, found.num_env_steps, found.num_episodes) == (3, 300, 3)
    again = Trial(tmp_path, stop={"num_iterations": 5})
    again.run()
    assert not path.exists()
    assert tally_of("t0000") is None


def test_a_member_that_fails_tells_how_far_it_was(tmp_path: Path) -> None:
    def engine(trial_id: str) -> FakeEngine:
        return FakeEngine(raise_at=4 if trial_id == "t0001" else None)

    pack = Pack(tmp_path, engine, max_retries=1, stop={"num_iterations": 6}, checkpoints={"every_iterations": 2})
    pack.add("t0000", "t0001").run()
    reached = [report.reached for report in pack.of("t0001") if report.error is not None]
    assert [(present(one).num_iterations, present(one).num_env_steps) for one in reached] == [(3, 300), (3, 300)]
    assert not pack.store("t0000").tally_path.exists()
    assert tally_of("t0001") is None


def test_the_record_of_a_failed_trial_says_how_far_it_was(
    kept: tuple[SweepStore, RecordKeeper, FakeClock, list[Any]],
) -> None:
    store, keeper, _, _ = kept
    begin_tally("a", store.trial("t0003").tally_path, Reached(5, 512, 9, 2.5))
    keeper.started("t0003")
    keeper.failed("t0003", "it hung", retried=True)
    record = keeper.record("t0003")
    assert (record.status, record.num_iterations, record.num_env_steps) == ("pending", 5, 512)
    assert (record.num_episodes, record.time_s) == (9, 2.5)
    keeper.started("t0003")
    keeper.failed("t0003", "it raised", retried=False, reached=Reached(6, 700, 11, 3.5))
    record = keeper.record("t0003")
    assert (record.status, record.num_iterations, record.num_env_steps, record.time_s) == ("failed", 6, 700, 3.5)
    assert not store.trial("t0003").tally_path.exists()
    # Nothing is known: what it has told itself stays.
    keeper.started("t0004")
    keeper.progressed("t0004", progress(4), node="here", pid=12)
    keeper.failed("t0004", "its node is gone", retried=False)
    assert (keeper.record("t0004").num_iterations, keeper.record("t0004").num_env_steps) == (4, 400)


def test_a_trial_says_while_it_is_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trial = Trial(tmp_path, evaluation={"every_iterations": 2})
    path = trial.store.tally_path
    said = []

    def told(around: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any) -> Any:
            said.append(present(read_tally(path)).evaluates)
            return around(*args)

        return run

    monkeypatch.setattr(trial.loop._evaluator, "run", told(trial.loop._evaluator.run))
    monkeypatch.setattr(trial.engine, "train_iteration", told(trial.engine.train_iteration))
    trial.run_to(4)
    assert said == [False, False, True, False, False, True]
    assert not present(read_tally(path)).evaluates


def test_of_a_pack_those_that_are_due_say_it(tmp_path: Path) -> None:
    pack = Pack(tmp_path, evaluation={"every_iterations": 1})
    said = []

    def evaluate(evaluator: Any, policies: Any) -> Any:
        said.append([present(tally_of(name)).reached.evaluates for name in ("t0000", "t0001")])
        raise ZeroDivisionError

    pack.loop._evaluate = evaluate
    pack.add("t0000", "t0001")
    with pytest.raises(ZeroDivisionError):
        pack.run()
    assert said == [[True, True]]
    assert not any(present(tally_of(name)).reached.evaluates for name in ("t0000", "t0001"))


def test_numbers_that_are_none_are_no_tally(tmp_path: Path) -> None:
    path = tmp_path / ".tally"
    path.write_bytes(np.array([1.0, 200, 3, 7, 1]).tobytes())
    assert read_tally(path) == Reached(1, 200, 3, 7.0, evaluates=True)
    for place in range(3):
        cells = np.ones(5)
        cells[place] = np.nan
        path.write_bytes(cells.tobytes())
        assert read_tally(path) is None
