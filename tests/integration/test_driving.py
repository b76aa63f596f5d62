"""What a launch, resume or extend leaves when nothing is to be run, when it fails, and when a signal ends it."""

import os
import signal
import sys
from pathlib import Path
from signal import Signals
from typing import Any, cast

import pytest
from sweep_folders import kept_before_each_write

from policies.errors import CannotRunError
from tests.narrowing import present
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.process.interruption import current
from tune_jobs.spec.file import load_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude as finish
from tune_jobs.sweeps import drive as driving
from tune_jobs.sweeps import resume as resuming
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.drive import write_new
from tune_jobs.sweeps.interrupted import SweepInterrupted

SPEC = {"env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"uniform": [1e-4, 1e-2]}}, "num_samples": 2}


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    """A sweep whose trials are all done, two days ago."""
    spec = load_spec(SPEC)
    store = SweepStore(tmp_path / "mine")
    store.create()
    write_new(store, spec, make_plan(spec, Machine(2)), None)
    for trial in store.read_trials():
        store.trial(trial.trial_id).write_record(trial.model_copy(update={"status": "completed"}))
    times = {"state": "completed", "started_at": 1_000.0, "ended_at": 2_000.0, "run_time_s": 1_000.0}
    store.write_record(store.read_record().model_copy(update=times))
    return store


def test_a_finished_sweep_is_not_written_anew_when_nothing_is_run(store: SweepStore) -> None:
    before = {path: path.read_bytes() for path in store.folder.rglob("*.json")}
    result = sweeps.resume(store.folder, finish=False, progress="none")
    assert (result.interrupted, result.exit_code, result.sweep.ended_at) == (False, 0, 2_000.0)
    assert {path: path.read_bytes() for path in store.folder.rglob("*.json")} == before


def test_finishing_anew_changes_no_times(store: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finish, "make_report", lambda store, _: store.report_folder / "index.html")
    before = store.record_path.read_bytes()
    # No trial has a checkpoint: there is no winner, and the report says so.
    result = sweeps.resume(store.folder, progress="none")
    assert result.why_no_best is not None
    assert store.record_path.read_bytes() == before


def test_an_extend_killed_between_any_two_files_leaves_a_sweep_that_goes_on_with_all_of_its_trials(
    store: SweepStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resuming, "run_sweep", lambda store, *_, **__: [t.trial_id for t in store.read_trials()])
    with kept_before_each_write(store, tmp_path) as left:
        all_ids = cast("Any", sweeps.extend(store.folder, 2, progress="none"))
    assert all_ids == ["t0000", "t0001", "t0002", "t0003"]
    assert len(left) >= 3
    before, *during = left
    assert cast("Any", sweeps.resume(before, progress="none")) == all_ids[:2]
    for folder in during:
        assert sweeps.resume(folder, progress="none") == all_ids
        record = SweepStore(folder).read_record()
        assert (record.num_trials, record.spec["num_samples"]) == (4, 4)
        assert [trial.seed for trial in sweeps.trials(folder)] == [trial.seed for trial in sweeps.trials(store.folder)]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("step", ["choose_best", "make_report"])
def test_a_signal_while_the_rest_is_made_ends_it_and_keeps_the_state(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch, number: Signals, step: str
) -> None:
    made = []

    def interrupt(*_: object, **__: object) -> None:
        os.kill(os.getpid(), number)
        made.append("more")

    monkeypatch.setattr(finish, "make_report", lambda store, _: store.report_folder / "index.html")
    monkeypatch.setattr(finish, step, interrupt)
    with pytest.raises(SweepInterrupted) as caught:
        sweeps.resume(store.folder, progress="none")
    assert made == []
    assert present(caught.value.result).exit_code == 130
    assert "report" not in present(caught.value.result).artifacts
    assert (store.read_record().state, store.read_record().ended_at) == ("completed", 2_000.0)
    assert not store.is_driven()


def test_stop_ends_what_comes_after_the_trials_too(store: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    def choose(store: SweepStore, **_: object) -> None:
        store.request_stop()
        raise CannotRunError("No best.")

    monkeypatch.setattr(finish, "choose_best", choose)
    monkeypatch.setattr(finish, "make_report", lambda store, _: pytest.fail("it was asked to stop"))
    # Another process asked: nobody pressed Ctrl-C here, so nothing is raised.
    result = sweeps.resume(store.folder, progress="none")
    assert (result.interrupted, result.exit_code) == (True, 130)
    assert not store.stop_requested()


def pend(store: SweepStore) -> None:
    """Let a trial wait, and the sweep say that it runs: its driver was killed."""
    trial = store.read_trials()[1]
    store.trial(trial.trial_id).write_record(trial.model_copy(update={"status": "running"}))
    store.write_record(store.read_record().model_copy(update={"state": "running", "ended_at": None}))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_ray_starts_leaves_the_sweep_interrupted(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch, number: Signals
) -> None:
    pend(store)

    def connect(*_: object, **__: object) -> None:
        os.kill(os.getpid(), number)  # the first one asks
        assert store.stop_requested()
        os.kill(os.getpid(), signal.SIGTERM if number == signal.SIGHUP else number)  # a SIGHUP is never the second

    monkeypatch.setattr(driving, "connected", connect)
    with pytest.raises(SweepInterrupted) as caught:
        sweeps.resume(store.folder, progress="none")
    assert present(caught.value.result).interrupted
    assert store.read_record().state == "interrupted"
    assert store.read_record().ended_at is not None
    assert [trial.status for trial in store.read_trials()] == ["completed", "paused"]
    assert not store.stop_requested()
    assert not store.is_driven()


@pytest.mark.parametrize("error", [CannotRunError("no Ray"), ValueError("a bug")])
def test_a_run_that_fails_leaves_no_sweep_that_says_it_runs(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch, error: ValueError | CannotRunError
) -> None:
    pend(store)

    def connect(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(driving, "connected", connect)
    with pytest.raises(type(error)):
        sweeps.resume(store.folder, progress="none")
    assert store.read_record().state == "interrupted"
    assert not store.is_driven()


def test_a_plan_that_fails_leaves_no_sweep_that_says_it_runs(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    pend(store)
    monkeypatch.setattr("tune_jobs.sweeps.resume.machine_here", lambda: Machine(0))
    with pytest.raises(CannotRunError, match="has 0"):
        sweeps.resume(store.folder, progress="none")
    assert store.read_record().state == "interrupted"


def test_a_signal_before_a_new_sweep_is_there_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def plan(*_: object, **__: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(sweeps, "make_plan", plan)
    with pytest.raises(SweepInterrupted) as caught:
        sweeps.launch(SPEC, name="new", storage=tmp_path / "storage", progress="none")
    assert caught.value.result is None
    assert not (tmp_path / "storage").exists()


def test_a_signal_while_a_new_sweeps_records_are_written_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweeps, "write_new", lambda *_: os.kill(os.getpid(), signal.SIGHUP))
    with pytest.raises(SweepInterrupted):
        sweeps.launch(SPEC, name="new", storage=tmp_path / "storage", progress="none")
    assert not (tmp_path / "storage").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("where", ["SweepStore.take", "SweepMonitor", "connected"])
def test_a_signal_once_a_new_sweeps_records_are_written_keeps_it_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: Signals, where: str
) -> None:
    """Before the trials are prepared, too: "nothing was kept" would be wrong."""
    original = SweepStore.take if where == "SweepStore.take" else getattr(driving, where)

    def interrupt(*args: Any, **kwargs: Any) -> Any:
        if current()._ask is not None:
            os.kill(os.getpid(), number)  # the first one asks
            raise KeyboardInterrupt
        os.kill(os.getpid(), number)
        return original(*args, **kwargs)

    place = "tune_jobs.store.sweep_store" if where == "SweepStore.take" else "tune_jobs.sweeps.drive"
    monkeypatch.setattr(f"{place}.{where}", interrupt)
    with pytest.raises(SweepInterrupted) as caught:
        sweeps.launch(SPEC, name="new", storage=tmp_path, progress="none")
    result = caught.value.result
    assert result is not None
    assert (result.sweep.state, result.exit_code, len(result.trials)) == ("interrupted", 130, 2)
    assert SweepStore(tmp_path / "new").read_record().state == "interrupted"


def test_a_signal_while_a_sweeps_new_trials_are_written_is_not_forgotten(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    pend(store)
    monkeypatch.setattr("tune_jobs.sweeps.adding._add_trials", lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM))
    monkeypatch.setattr(driving, "connected", lambda *_: pytest.fail("the trials must not begin"))
    with pytest.raises(SweepInterrupted) as caught:
        sweeps.resume(store.folder, progress="none")
    assert present(caught.value.result).sweep.state == "interrupted"


@pytest.mark.parametrize("error", [CannotRunError("no Ray"), KeyboardInterrupt()])
def test_a_run_leaves_no_file_of_its_sweep_open(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch, error: KeyboardInterrupt | CannotRunError
) -> None:
    """Also while somebody holds what was raised, or nobody has collected garbage."""
    pend(store)

    def connect(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(driving, "connected", connect)
    with pytest.raises((CannotRunError, SweepInterrupted)) as caught:
        sweeps.resume(store.folder, progress="none")
    links = [link for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    assert [link for link in links if str(link.readlink()).startswith(str(store.folder))] == []
    assert caught.value is not None


def test_a_loop_over_launches_stops_at_the_first_signal(store: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finish, "choose_best", lambda *_, **__: os.kill(os.getpid(), signal.SIGINT))
    runs = []

    def loop() -> None:
        for _ in range(3):
            runs.append(1)
            try:
                sweeps.resume(store.folder, progress="none")
            except Exception:  # noqa: BLE001 (what such loops do)
                continue

    with pytest.raises(KeyboardInterrupt):
        loop()
    assert runs == [1]


def test_the_plan_asks_the_ray_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without importing ray where nobody has."""
    monkeypatch.delitem(sys.modules, "ray", raising=False)
    here = driving.machine_here()
    assert here.source == "this machine"
    ray: Any = type(sys)("ray")
    monkeypatch.setitem(sys.modules, "ray", ray)
    assert driving.machine_here().source == "this machine"  # it is only being imported
    ray.is_initialized = lambda: False
    assert driving.machine_here().source == "this machine"
    ray.is_initialized = lambda: True
    connected_ray: Any = type(sys)("tune_jobs.ray_tune.connected_ray")
    connected_ray.is_of_a_sweep = lambda: False
    connected_ray.connected_machine = lambda: Machine(1, source="the connected one")
    monkeypatch.setitem(sys.modules, "tune_jobs.ray_tune.connected_ray", connected_ray)
    assert driving.machine_here().source == "the connected one"


@pytest.mark.parametrize(
    ("cpus", "hint"), [(1, "Set resources.num_cpus to at most 1, or free some."), (0, "Free some.")]
)
def test_a_hint_asks_for_no_trial_without_a_cpu(cpus: int, hint: str) -> None:
    spec = load_spec({**SPEC, "resources": {"num_cpus": 2}})
    with pytest.raises(CannotRunError) as caught:
        make_plan(spec, Machine(cpus, more="free some"))
    assert caught.value.hint == hint


def test_modules_of_a_sweep_are_not_allowed_to_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A class that was given to a launch is of that sweep alone."""
    import odd_envs

    from policies.envs import modules as env_modules

    monkeypatch.setattr(env_modules, "_allowed", set())

    def plan(*_: object, **__: object) -> None:
        raise CannotRunError(str(env_modules.allowed_modules()))

    monkeypatch.setattr(sweeps, "make_plan", plan)
    with pytest.raises(CannotRunError, match="odd_envs"):
        sweeps.launch({**SPEC, "env": odd_envs.Fragile}, name="new", storage=tmp_path, progress="none")
    assert env_modules.allowed_modules() == ()
