"""How long a sweep ran is what passed while it did, whatever the machine's clock is set to meanwhile."""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from sweep_folders import MACHINE, make_sweep_folder

from tests.narrowing import present
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.ray_tune import run_trials
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.closing import close_run
from tune_jobs.sweeps.drive import Shared, run_trials_of


def test_a_clock_that_is_set_back_takes_nothing_from_the_run_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    trial = store.trial("t0000")
    done = trial.read_record()
    trial.write_record(done.model_copy(update={"status": "paused"}))
    store.write_record(store.read_record().model_copy(update={"state": "interrupted", "run_time_s": 100.0}))
    now, set_back_s = time.time, 0.0
    monkeypatch.setattr(time, "time", lambda: now() - set_back_s)

    def train(*_: object) -> None:
        nonlocal set_back_s
        set_back_s = 1800.0
        time.sleep(0.05)
        trial.write_record(done)

    monkeypatch.setattr(run_trials, "run_trials", train)
    plan = make_plan(stored_spec(store.read_record()), MACHINE)
    with store.lock(), Shared() as shared:
        shared.connection = cast("Any", SimpleNamespace(is_client=False))
        run_trials_of(store, plan, shared, address=None, machine=MACHINE, progress="none")
    record = store.read_record()
    assert 100.05 <= record.run_time_s < 160.0
    assert (record.state, present(record.ended_at) < now() - 1000.0) == ("completed", True)


def test_a_run_that_two_processes_close_counts_once(tmp_path: Path) -> None:
    """The driver on a cluster, whose Ray has died, and the process that waited for it."""
    store = make_sweep_folder(tmp_path / "mine")
    for run_time_s in (30.0, 31.0, 30.5, 0.0):
        close_run(store, run_time_s)
    assert store.read_record().run_time_s == 31.0
