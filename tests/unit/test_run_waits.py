"""A sweep whose nodes leave in the middle of its run: its record says that it waits until a trial runs again."""

from pathlib import Path
from typing import Any

import pytest
from sweep_folders import make_sweep_folder

from tune_jobs.cli.output import show_sweeps
from tune_jobs.ray_tune.run_waits import RunWaits
from tune_jobs.store.record_keeper import RecordKeeper
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.status import list_sweeps, status_of


class Run:
    """A run whose clock stands."""

    def __init__(self, folder: Path, address: str | None) -> None:
        self.store: SweepStore = make_sweep_folder(folder)
        changes: dict[str, Any] = {"state": "running", "address": address}
        self.store.write_record(self.store.read_record().model_copy(update=changes))
        trial = self.store.read_trials()[0].model_copy(update={"status": "pending"})
        self.store.trial(trial.trial_id).write_record(trial)
        self.keeper = RecordKeeper(self.store, [trial.trial_id], lambda record: None)
        self.trial_id, self.now = trial.trial_id, 100.0
        self.waits = RunWaits(self.store, self.keeper, lambda: self.now)
        self.waits.resources = {"CPU": 2.0}

    def after(self, seconds: float) -> bool:
        """Whether its record says so many seconds later that it waits."""
        self.now += seconds
        self.waits.look()
        return self.store.read_record().waiting is not None


def test_it_waits_when_no_trial_runs_for_a_while_until_one_does(tmp_path: Path) -> None:
    run = Run(tmp_path / "mine", "auto")
    # Before its first trial it starts.
    assert not run.after(60)
    run.keeper.started(run.trial_id)
    assert not run.after(60)
    run.keeper.moved(run.trial_id, "Node 10.0.0.7 was lost.")
    assert not run.after(9)
    assert run.after(2)
    wait = run.store.read_record().waiting
    assert wait is not None
    assert (wait.until, wait.resources) == (None, {"CPU": 2.0})
    assert run.after(600)
    assert run.store.read_record().waiting == wait
    run.keeper.started(run.trial_id)
    assert not run.after(0)


def test_others_are_told_and_the_end_of_the_run_takes_it_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run(tmp_path / "mine", "auto")
    run.keeper.started(run.trial_id)
    run.after(0)
    run.keeper.moved(run.trial_id, "Node 10.0.0.7 was lost.")
    assert run.after(11)
    with run.store.lock():
        show_sweeps(list_sweeps(tmp_path), as_json=False)
        assert "waiting for nodes" in " ".join(capsys.readouterr().out.split())
        facts = status_of(run.store, run.store.read_record(), run.store.read_trials()).facts()
        assert facts["waits for"].startswith("nodes with room for one trial (2 CPUs), since ")
        assert "at most" not in facts["waits for"]
        assert facts["waits for"].endswith("Trials are left, and none runs: no node that is there has room for one.")
        assert facts["state"] == "running"
    run.waits.end()
    assert run.store.read_record().waiting is None
    show_sweeps(list_sweeps(tmp_path), as_json=False)
    assert "waiting for nodes" not in " ".join(capsys.readouterr().out.split())


def test_one_machine_waits_for_no_nodes(tmp_path: Path) -> None:
    run = Run(tmp_path / "mine", None)
    run.keeper.started(run.trial_id)
    run.after(0)
    run.keeper.paused(run.trial_id)
    assert not run.after(60)


def test_nothing_waits_when_all_trials_have_ended(tmp_path: Path) -> None:
    run = Run(tmp_path / "mine", "auto")
    run.keeper.started(run.trial_id)
    run.after(0)
    run.keeper.failed(run.trial_id, "It broke.", retried=False)
    assert {record.status for record in run.keeper.all_records()} <= {"completed", "failed", "stopped"}
    assert not run.after(60)
