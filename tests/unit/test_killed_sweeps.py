"""What is told of a sweep whose process was killed: its trials that ran are paused, wherever they are told of."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import make_sweep_folder
from test_service_within import Looking

import tune_jobs
from tune_jobs.service.derived import Derived
from tune_jobs.service.statuses import Statuses
from tune_jobs.store.opening import open_storage
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.drawing import ReportMatter
from tune_jobs.sweeps.exports import trials_csv
from tune_jobs.sweeps.sweep_file import _document


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    """A sweep of four trials, one of which ran when its process was killed."""
    made = make_sweep_folder(tmp_path / "mine")
    made.write_record(made.read_record().model_copy(update={"state": "running"}))
    trial = made.trial("t0001")
    trial.write_record(trial.read_record().model_copy(update={"status": "running", "ended_at": None}))
    return made


def statuses_of(trials: Any) -> dict[str, str]:
    return {trial.trial_id: trial.status for trial in trials}


EXPECTED = {"t0000": "completed", "t0001": "paused", "t0002": "completed", "t0003": "completed"}


def test_trials_are_told_as_they_are_counted(store: SweepStore) -> None:
    counts = {"completed": 3, "paused": 1}
    storage = store.folder.parent
    assert tune_jobs.status("mine", storage=storage).counts == counts
    assert statuses_of(tune_jobs.trials("mine", storage=storage)) == EXPECTED
    seen = Looking(store).after(0)
    assert (seen.status.state, seen.status.counts) == ("interrupted", counts)
    assert statuses_of(seen.trials.records) == EXPECTED
    document = _document(store)
    assert document["status"]["counts"] == counts
    assert {row["trial_id"]: row["status"] for row in document["trials"]} == EXPECTED
    assert {row["trial_id"]: row["status"] for row in csv.DictReader(trials_csv(store).splitlines())} == EXPECTED
    assert statuses_of(ReportMatter.read(store, None, None).trials) == EXPECTED
    made = Derived(open_storage(storage), Statuses(open_storage(storage)))
    assert {row["trial_id"]: row["status"] for row in json.loads(made.records("mine"))} == EXPECTED


def test_what_is_written_stays(store: SweepStore) -> None:
    Looking(store).after(0)
    _document(store)
    assert store.trial("t0001").read_record().status == "running"


def test_they_run_while_a_process_drives_it_and_again_once_it_goes_on(store: SweepStore) -> None:
    looking = Looking(store)
    running = EXPECTED | {"t0001": "running"}
    with store.lock():
        assert statuses_of(looking.after(0).trials.records) == running
        assert statuses_of(tune_jobs.trials("mine", storage=store.folder.parent)) == running
    killed = looking.after(6)
    assert statuses_of(killed.trials.records) == EXPECTED
    # Whoever follows it is told of nothing that has not changed.
    assert looking.after(60).trials is killed.trials
    with store.lock():
        assert statuses_of(looking.after(6).trials.records) == running
