"""A sweep that is created: all of it is there, nothing has begun, and whoever drives it finds what a launch would."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

import tune_jobs
from policies.errors import CannotRunError, SpecError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import drive as driving
from tune_jobs.sweeps import verbs
from tune_jobs.sweeps.interrupted import SweepInterrupted
from tune_jobs.sweeps.outcome import SweepResult

SPEC = {"env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"uniform": [1e-4, 1e-2]}}, "num_samples": 2}
PROGRAM = """
import json, os, signal, sys
import tune_jobs
import tune_jobs.sweeps.verbs  # and with it Gymnasium, which sets a variable
def state():
    handlers = [str(signal.getsignal(number)) for number in signal.valid_signals()]
    return [handlers, dict(os.environ), [os.readlink(f"/proc/self/fd/{number}") for number in range(3)], sys.path]
before = state()
created = tune_jobs.create(json.loads(sys.argv[1]), name="mine", storage=sys.argv[2])
print(json.dumps([created.name, str(created.folder), "ray" in sys.modules, "torch" in sys.modules, state() == before]))
"""


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What would be run in place of trials: the sweeps as they stand when Ray would start."""
    seen = []

    def run_sweep(store: SweepStore, plan: SweepPlan, **settings: Any) -> SweepResult:
        seen.append((store.read_record(), store.read_trials(), plan, settings))
        return SweepResult(store.place, store.read_record(), store.read_trials())

    monkeypatch.setattr("tune_jobs.sweeps.verbs.run_sweep", run_sweep)
    monkeypatch.setattr("tune_jobs.sweeps.resume.run_sweep", run_sweep)
    return seen


def test_creating_writes_a_sweep_and_starts_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, json.dumps(SPEC), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    folder = tmp_path / "mine"
    assert json.loads(done.stdout) == ["mine", str(folder), False, False, True]
    status = tune_jobs.status(folder)
    assert (status.sweep.state, status.counts, status.alive) == ("created", {"pending": 2}, False)
    assert [status.sweep.started_at, status.sweep.run_time_s] == [None, 0.0]


def test_a_created_sweep_is_listed_and_shown_as_not_begun(tmp_path: Path, run: Callable[..., Result]) -> None:
    tune_jobs.create(SPEC, name="mine", storage=tmp_path)
    assert [status.sweep.state for status in tune_jobs.list_sweeps(tmp_path)] == ["created"]
    for command in (("status", "mine"), ("list",)):
        said = run(*command, "--storage", tmp_path).output
        assert "created" in said
        assert "2 pending" in said


@pytest.mark.parametrize("begin", [tune_jobs.drive, tune_jobs.resume])
def test_driving_a_created_sweep_begins_what_a_launch_would(
    tmp_path: Path, runs: list[Any], begin: Callable[..., Any]
) -> None:
    tune_jobs.launch(SPEC, name="mine", storage=tmp_path / "launched", progress="none")
    created = tune_jobs.create(SPEC, name="mine", storage=tmp_path)
    begin(created.folder, progress="none")
    launched, driven = (
        [run[0].model_copy(update={"created_at": 0.0}), run[1], run[2].trials, run[2].packs.num_packs] for run in runs
    )
    assert driven == launched
    assert launched[0].state == "running"


def test_a_sweep_is_driven_where_it_was_created_for_unless_somebody_says_where(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(verbs, "resume", lambda _, **settings: asked.append(settings["address"]))
    monkeypatch.setattr(driving, "connected", lambda *_: pytest.fail("nothing is joined"))
    # Larger than any machine: whether the cluster can run it is known when it is driven.
    large = SPEC | {"resources": {"num_cpus": 1000, "num_gpus": 1}, "engine": "rllib"}
    for spec, address in ((large, "ray://head:10001"), (SPEC, "ray://head:10001"), (SPEC, None)):
        created = tune_jobs.create(spec, storage=tmp_path, address=address)
        tune_jobs.drive(created.folder)
        tune_jobs.drive(created.folder, address="auto")
    assert asked == ["ray://head:10001", "auto", "ray://head:10001", "auto", None, "auto"]
    with pytest.raises(SpecError):
        tune_jobs.create(SPEC, storage=tmp_path, address="nonsense")


def test_a_cluster_does_not_change_the_trials(tmp_path: Path) -> None:
    folders = [tune_jobs.create(SPEC, storage=tmp_path, address=address).folder for address in (None, "auto")]
    here, there = (SweepStore(folder).read_trials() for folder in folders)
    assert here == there


@pytest.mark.parametrize("error", [SpecError, CannotRunError, KeyboardInterrupt])
def test_what_cannot_be_created_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    def write(*_: object) -> None:
        raise error("broken")

    monkeypatch.setattr("tune_jobs.sweeps.create.write_new", write)
    with pytest.raises(error):
        tune_jobs.create(SPEC, storage=tmp_path / "sweeps")
    assert not (tmp_path / "sweeps").exists()


def test_a_machine_that_is_too_small_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tune_jobs.sweeps.create.machine_here", lambda: Machine(0))
    with pytest.raises(CannotRunError, match="has 0"):
        tune_jobs.create(SPEC, storage=tmp_path / "sweeps")
    assert not (tmp_path / "sweeps").exists()


@pytest.mark.parametrize(("error", "begins"), [(CannotRunError("no"), True), (SweepInterrupted(), False)])
def test_a_launch_in_a_thread_leaves_nothing_if_nothing_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: CannotRunError | SweepInterrupted, begins: bool
) -> None:
    def resume(place: str, **_: object) -> None:
        store = SweepStore(Path(place))
        if begins:
            store.write_record(store.read_record().model_copy(update={"state": "interrupted"}))
        raise error

    monkeypatch.setattr(verbs, "resume", resume)
    with ThreadPoolExecutor(1) as pool, pytest.raises(type(error)):
        pool.submit(tune_jobs.launch, SPEC, name="mine", storage=tmp_path).result()
    assert (tmp_path / "mine").exists() == begins


def test_threads_create_sweeps_of_one_name_beside_each_other(tmp_path: Path) -> None:
    before = dict(os.environ)
    with ThreadPoolExecutor(3) as pool:
        made = list(pool.map(lambda _: tune_jobs.create(SPEC, storage=tmp_path), range(3)))
    assert sorted(created.name for created in made) == ["sweep", "sweep-2", "sweep-3"]
    assert dict(os.environ) == before
