"""What a service begins again when it starts, and what not."""

import errno
import time
from pathlib import Path
from typing import Any

import pytest
from broken_storage import Fail, fail, pathlib_of  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder
from test_service_supervisor import Place, place  # noqa: F401 (a fixture)

from analysis.records import FINISHED
from policies.errors import CheckpointError
from policies.files import write_atomic
from tune_jobs.service import driver
from tune_jobs.service.spare import Driver
from tune_jobs.store import transitions
from tune_jobs.store.opening import open_storage
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import stages
from tune_jobs.sweeps.outcome import SweepResult

# ruff: noqa: F811 - fixtures are named as arguments


def test_a_start_begins_nothing_again_that_somebody_stopped_or_that_failed(place: Place) -> None:
    for name, state in (("waits", "created"), ("killed", "running"), ("dies", "running"), ("anew", "created")):
        place.add(name, state=state)
        job = place.queue.begin(name, "drive", {}, owner="ann", num_cpus=1.0)[0]
        if name == "waits":
            place.queue.request_stop(name)
        elif name == "anew":
            # The job of one of the same name, long before.
            place.queue.end(job.id, "stopped", at=1.0)
        else:
            place.queue.end(job.id, "stopped" if name == "killed" else "failed")
    for _ in range(2):
        place.new_service().reconcile()
        assert [job.sweep for job in place.queue.jobs("waiting")] == ["anew"]


@pytest.mark.usefixtures("pathlib_of")
def test_a_start_forgets_no_job_whose_sweep_gives_no_answer(place: Place, fail: Fail) -> None:
    store = place.add("written")
    job, _ = place.queue.begin("written", "drive", {}, owner="ann", key=("k", "d"), state="creating")
    with fail(store.record_path, errno.EIO), pytest.raises(CheckpointError, match=r"sweep\.json cannot be read"):
        place.new_service().reconcile()
    place.new_service().reconcile()
    assert [(known.id, known.state) for known in place.queue.jobs()] == [(job.id, "waiting")]


def test_a_sweep_that_was_being_written_has_no_name_and_no_key_any_more(place: Place) -> None:
    """The service was killed meanwhile, and the same request comes again."""
    for name in ("half", "others"):
        SweepStore(place.folder / name).create()
        place.queue.begin(name, "drive", {}, owner="ann", key=(name, "d"), state="creating")
    write_atomic(place.folder / "others" / "notes.txt", "What has nothing to do with a sweep.")
    place.new_service().reconcile()
    storage = open_storage(place.folder)
    assert not storage.is_taken("half")
    assert sorted(path.name for path in (place.folder / "others").iterdir()) == ["notes.txt", "trials"]
    assert place.queue.jobs() == []
    assert place.queue.known("ann", "half", "d") is None


def test_a_driver_is_told_when_its_job_began(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []
    give = Driver.give

    def giving(driver: Driver, request: Any, *others: Any) -> None:
        given.append(request)
        give(driver, request, *others)

    monkeypatch.setattr(Driver, "give", giving)
    place.submit("mine")
    service = place.new_service()
    service.start()
    (job,) = place.until_all_end()
    service.close()
    assert [request["started_at"] for request in given] == [job.started_at]


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The trials that were trained, all of which fail again."""
    found: list[str] = []

    def run_trials(store: SweepStore, *_: Any, **__: Any) -> SweepResult:
        for record in store.read_trials():
            if record.status not in FINISHED:
                found.append(record.trial_id)
                fail_trial(store, record.trial_id)
        return SweepResult(store.place, store.read_record(), store.read_trials())

    monkeypatch.setattr(stages, "run_trials_of", run_trials)
    monkeypatch.setattr(stages, "finish_sweep", lambda store, result, *_, **__: result)
    return found


def fail_trial(store: SweepStore, trial_id: str) -> None:
    trial = store.trial(trial_id)
    failed = transitions.failed(trial.read_record(), "it crashes", time.time(), retried=False, reached=None)
    trial.write_record(failed)


def test_a_failed_trial_is_retried_once_for_each_job_that_asks_for_it(tmp_path: Path, trained: list[str]) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    fail_trial(store, "t0001")
    fail_trial(store, "t0003")
    request: dict[str, Any] = {
        "sweep": store.place, "verb": "retry", "arguments": {}, "address": None, "num_cpus": 2.0, "wait_for_nodes": 0.0,
        "job": "u", "started_at": time.time(),
    }  # fmt: skip
    for attempt in (1, 2):
        driver._done(request | {"attempt": attempt})
        assert trained == ["t0001", "t0003"]
    # Its first attempt was killed when only one of them waited.
    del trained[:]
    store.trial("t0001").write_record(transitions.tried_again(store.trial("t0001").read_record()))
    request["started_at"] = time.time()
    driver._done(request | {"attempt": 2})
    assert trained == ["t0001", "t0003"]
    # The clocks of a cluster's nodes may differ: of a first attempt they are not asked.
    driver._done(request | {"attempt": 1})
    assert trained == ["t0001", "t0003"] * 2
