"""While no trial of a sweep is written, what is told of it has how far its trials are within their iterations."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import make_sweep_folder
from test_service_watching import Clock, write

from policies.envs.tallies import Reached, Tally
from tune_jobs.service.statuses import Statuses
from tune_jobs.store.opening import open_storage
from tune_jobs.store.sweep_store import SweepStore


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SweepStore]:
    """A sweep of four trials that seems to be driven, two of which run and are at 100 env steps."""
    made = make_sweep_folder(tmp_path / "mine")
    made.write_record(made.read_record().model_copy(update={"state": "running"}))
    for trial_id in ("t0001", "t0002"):
        write(made, trial_id, status="running", num_env_steps=100, time_s=10.0)
    with made.lock():
        yield made


class Looking:
    """Who looks at it, with a clock."""

    def __init__(self, store: SweepStore) -> None:
        self.clock = Clock()
        self.statuses = Statuses(open_storage(store.folder.parent), self.clock)

    def after(self, seconds: float) -> Any:
        self.clock.now += seconds
        return self.statuses.see("mine")


def tally_of(store: SweepStore, trial_id: str, steps: int) -> Tally:
    return Tally(store.trial(trial_id).tally_path, Reached(1, steps, 2, 20.0))


def steps_of(seen: Any, status: str = "running") -> dict[str, int]:
    return {record.trial_id: record.num_env_steps for record in seen.trials.records if record.status == status}


def test_trials_and_status_have_what_was_trained_since(store: SweepStore) -> None:
    looking = Looking(store)
    first = looking.after(0)
    assert steps_of(first) == {"t0001": 100, "t0002": 100}
    tally = tally_of(store, "t0001", 100)
    tally.add(50, 1)
    assert looking.after(4).trials is first.trials
    second = looking.after(1)
    assert steps_of(second) == {"t0001": 150, "t0002": 100}
    assert second.status.num_env_steps == first.status.num_env_steps + 50
    assert second.trials.scores == first.trials.scores
    # The others are the objects that they were.
    same = [one is other for one, other in zip(first.trials.records, second.trials.records, strict=True)]
    assert same == [True, False, True, True]
    # Nothing more was trained.
    third = looking.after(3)
    assert third.trials is second.trials
    assert third.status is second.status
    tally.add(10, 0)
    assert steps_of(looking.after(3)) == {"t0001": 160, "t0002": 100}


def test_a_record_that_is_written_takes_its_place_and_others_stay(store: SweepStore) -> None:
    looking = Looking(store)
    looking.after(0)
    tally_of(store, "t0001", 150)
    tally_of(store, "t0002", 170)
    assert steps_of(looking.after(6)) == {"t0001": 150, "t0002": 170}
    # It goes on from an earlier checkpoint, in a process that has not begun yet.
    write(store, "t0001", num_env_steps=60)
    assert steps_of(looking.after(3)) == {"t0001": 60, "t0002": 170}
    write(store, "t0002", num_env_steps=200)
    assert steps_of(looking.after(3)) == {"t0001": 60, "t0002": 200}


def test_trials_that_are_written_are_not_looked_at(store: SweepStore) -> None:
    looking = Looking(store)
    looking.after(0)
    tally_of(store, "t0001", 150)
    for index in range(4):
        write(store, "t0002", num_env_steps=101 + index)
        assert steps_of(looking.after(3)) == {"t0001": 100, "t0002": 101 + index}


def test_of_a_sweep_that_nobody_drives_any_more_nothing_is_taken_for_trained(tmp_path: Path) -> None:
    made = make_sweep_folder(tmp_path / "mine")
    made.write_record(made.read_record().model_copy(update={"state": "running"}))
    write(made, "t0001", status="running", num_env_steps=100)
    looking = Looking(made)
    with made.lock():
        looking.after(0)
        tally_of(made, "t0001", 150)
        assert steps_of(looking.after(6)) == {"t0001": 150}
    assert steps_of(looking.after(6), "paused") == {"t0001": 100}
    assert steps_of(looking.after(60), "paused") == {"t0001": 100}
