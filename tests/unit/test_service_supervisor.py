"""The supervisor: each job is run by one driver process at a time, whoever is killed, and ends as its sweep did.

The driver processes are real, their sweeps only wait.
"""

import contextlib
import functools
import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_driver import JOURNAL
from synthetic_sweep import make_sweep_record

from tests.narrowing import present
from tune_jobs.service import supervisor as module
from tune_jobs.service.database.opening import open_database, sqlite_url
from tune_jobs.service.job_files import KEPT_S, SERVICE_FOLDER, Ended, Holder, JobFiles
from tune_jobs.service.jobs import Job
from tune_jobs.service.queue import Queue
from tune_jobs.service.spare import Driver
from tune_jobs.service.supervisor import Supervisor
from tune_jobs.service.surroundings import Surroundings
from tune_jobs.store.opening import open_storage
from tune_jobs.store.sweep_store import SweepStore

PATIENCE_S = 60.0


class Place:
    """A storage folder with a queue, and services that come and go."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.service_folder = folder, folder / SERVICE_FOLDER
        self.service_folder.mkdir(parents=True)
        self.engine = open_database(sqlite_url(self.service_folder / "service.db"))
        self.queue = Queue(self.engine)
        self.ended: list[Job] = []

    def new_service(self, *, num_cpus: float = 2.0, spare_idle_s: float = 0.0) -> Supervisor:
        return Supervisor(
            self.queue, open_storage(self.folder),
            Surroundings(self.folder, self.service_folder, None, num_cpus, ()),
            spare_idle_s=spare_idle_s, on_end=self.ended.append,
            make_driver=functools.partial(Driver, module="fake_driver"),
        )  # fmt: skip

    def add(self, name: str, *, seconds: float = 0.0, state: str = "created", **how: Any) -> SweepStore:
        store = SweepStore(self.folder / name)
        store.create()
        record = make_sweep_record(name, "ppo", "CartPole-v1", [], 1)
        spec = record.spec | {"hyperparams": {"seconds": seconds, **how}}
        store.write_record(record.model_copy(update={"state": state, "spec": spec}))
        return store

    def submit(self, name: str, **how: Any) -> Job:
        self.add(name, **how)
        return self.queue.begin(name, "drive", {}, owner="ann", num_cpus=1.0)[0]

    def wait(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f"{what}: {self.queue.jobs()}, {self.journal()}"
            time.sleep(0.01)

    def until_all_end(self) -> list[Job]:
        self.wait(lambda: all(job.state == "ended" for job in self.queue.jobs()), "a job never ended")
        return self.queue.jobs()

    def until_it_runs(self, job: Job) -> int:
        """The id of the process that has begun a job's sweep."""
        self.wait(lambda: self.begins(job.sweep), "it never began")
        return int(self.begins(job.sweep)[-1]["pid"])

    def journal(self) -> list[dict[str, Any]]:
        with contextlib.suppress(FileNotFoundError):
            return [json.loads(line) for line in (self.service_folder / JOURNAL).read_text().splitlines()]
        return []

    def begins(self, sweep: str) -> list[dict[str, Any]]:
        return [line for line in self.journal() if line["sweep"] == sweep and line["what"] == "begin"]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    monkeypatch.setattr(module, "TICK_S", 0.02)
    monkeypatch.setattr(module, "_wait_s", lambda _: 0.0)
    made = Place(tmp_path / "sweeps")
    yield made
    for line in made.journal():
        with contextlib.suppress(ProcessLookupError):
            os.kill(line["pid"], signal.SIGKILL)
    made.engine.dispose()


@pytest.fixture
def service(place: Place) -> Iterator[Supervisor]:
    made = place.new_service()
    made.start()
    yield made
    made.close()


def test_jobs_are_run_and_end_as_their_sweeps_do(place: Place, service: Supervisor) -> None:
    place.submit("a")
    place.submit("broken", error="it broke")
    good, bad = place.until_all_end()
    assert (good.outcome, good.message) == ("completed", None)
    assert (bad.outcome, bad.message) == ("failed", "ValueError: it broke")
    told = sorted((job.id, job.outcome, job.message, job.ended_at) for job in place.ended)
    assert told == [(job.id, job.outcome, job.message, job.ended_at) for job in (good, bad)]


def test_a_sweep_is_stopped_and_goes_on_when_it_is_asked_for(place: Place, service: Supervisor) -> None:
    job = place.submit("a", seconds=100)
    place.until_it_runs(job)
    place.queue.request_stop("a")
    assert place.until_all_end()[0].outcome == "stopped"
    assert SweepStore(place.folder / "a").read_record().state == "interrupted"


def test_who_stops_a_sweep_from_a_terminal_means_it(place: Place, service: Supervisor) -> None:
    job = place.submit("a", seconds=100)
    place.until_it_runs(job)
    SweepStore(place.folder / "a").request_stop()
    assert place.until_all_end()[0].outcome == "stopped"
    assert len(place.begins("a")) == 1


def test_another_driver_goes_on_where_one_was_killed(place: Place, service: Supervisor) -> None:
    job = place.submit("a", seconds=0.5)
    os.kill(place.until_it_runs(job), signal.SIGKILL)
    (job,) = place.until_all_end()
    assert (job.outcome, job.num_attempts) == ("completed", 2)


def test_a_sweep_that_ends_its_process_again_and_again_fails(place: Place, service: Supervisor) -> None:
    place.submit("a", exit=True)
    (job,) = place.until_all_end()
    assert job.outcome == "failed"
    assert job.message is not None
    assert job.message.startswith(f"The process that ran the sweep died {module.MAX_ATTEMPTS} times.")
    assert len(place.begins("a")) == module.MAX_ATTEMPTS


def test_a_service_that_was_drained_often_leaves_a_sweep_as_many_deaths_as_before(place: Place) -> None:
    job = place.submit("a", seconds=0.5)
    for _ in range(module.MAX_ATTEMPTS):
        job = present(place.queue.claim(2.0))
        place.queue.give_back(job.id)
    files = JobFiles(place.service_folder, job.uid)
    os.close(present(files.take()))
    files.write_ended(Ended(attempt=job.num_attempts, outcome="interrupted"))
    service = place.new_service()
    service.start()
    os.kill(place.until_it_runs(job), signal.SIGKILL)
    (job,) = place.until_all_end()
    service.close()
    assert (job.outcome, job.num_attempts) == ("completed", module.MAX_ATTEMPTS + 2)


def test_a_driver_that_a_signal_ends_is_no_end_of_its_sweep(place: Place, service: Supervisor) -> None:
    job = place.submit("a", seconds=0.5)
    os.kill(place.until_it_runs(job), signal.SIGTERM)
    (job,) = place.until_all_end()
    assert job.outcome == "completed"
    assert len(place.begins("a")) == 2


def test_what_runs_is_found_again_after_a_restart(place: Place) -> None:
    first = place.new_service()
    first.start()
    job = place.submit("a", seconds=1.0)
    pid = place.until_it_runs(job)
    first.close()
    second = place.new_service()
    second.start()
    (job,) = place.until_all_end()
    second.close()
    assert (job.outcome, job.num_attempts) == ("completed", 1)
    assert [line["pid"] for line in place.begins("a")] == [pid]


def test_what_ended_while_no_service_ran_has_ended(place: Place) -> None:
    first = place.new_service()
    first.start()
    job = place.submit("a", seconds=0.3)
    place.until_it_runs(job)
    first.close()
    place.wait(lambda: not JobFiles(place.service_folder, job.uid).is_run(), "the driver lives on")
    second = place.new_service()
    second.start()
    (job,) = place.until_all_end()
    second.close()
    assert (job.outcome, len(place.begins("a"))) == ("completed", 1)


def test_draining_lets_sweeps_save_and_wait(place: Place) -> None:
    first = place.new_service()
    first.start()
    job = place.submit("a", seconds=3.0)
    waiting = place.submit("b")
    place.until_it_runs(job)
    place.wait(lambda: place.queue.job(waiting.id).state == "ended", "b never ended")
    assert first.drain(PATIENCE_S)
    assert place.queue.job(job.id).state == "waiting"
    second = place.new_service()
    second.start()
    place.until_all_end()
    second.close()
    assert len(place.begins("a")) == 2


def test_draining_asks_no_process_that_has_the_id_of_a_driver_elsewhere_or_of_one_before(place: Place) -> None:
    job = place.submit("a")
    files = JobFiles(place.service_folder, job.uid)
    # Of the second attempt's driver only the lock is there yet.
    before = present(files.take())
    files.say_who(Holder(pid=os.getpid(), sweep="a"))
    assert files.holder() is not None
    os.close(before)
    lock = present(files.take())
    assert files.holder() is None
    with subprocess.Popen(["sleep", "60"]) as bystander:
        try:
            # In another container, the driver has an id that is this process's here.
            files.say_who(Holder(pid=bystander.pid, sweep="a"))
            place.queue.claim(2.0)
            service = place.new_service()
            service.start()
            assert not service.drain(0.3)
            assert bystander.poll() is None
        finally:
            bystander.kill()
            os.close(lock)


def test_with_the_database_lost_sweeps_are_found_by_their_folders(place: Place) -> None:
    first = place.new_service()
    first.start()
    job = place.submit("runs", seconds=1.5)
    pid = place.until_it_runs(job)
    first.close()
    place.engine.dispose()
    for file in place.service_folder.glob("service.db*"):
        file.unlink()
    place.add("waits")
    place.add("done", state="completed")
    place.add("stopped", state="interrupted")
    place.add("killed", state="running")
    place.engine = open_database(sqlite_url(place.service_folder / "service.db"))
    place.queue = Queue(place.engine)
    second = place.new_service()
    second.start()
    jobs = place.until_all_end()
    second.close()
    assert sorted(job.sweep for job in jobs) == ["killed", "runs", "waits"]
    assert {job.outcome for job in jobs} == {"completed"}
    # The first driver ran its sweep to the end; the second one found nothing to do but to say so.
    first_begin, *others = place.begins("runs")
    ends = [line["pid"] for line in place.journal() if line["sweep"] == "runs" and line["what"] == "end"]
    assert first_begin["pid"] == pid == ends[0]
    assert len(others) == 1


def test_a_job_whose_sweep_was_never_written_is_forgotten(place: Place) -> None:
    place.queue.begin("never", "drive", {}, owner="ann", key=("k", "d"), state="creating")
    place.add("written")
    place.queue.begin("written", "drive", {}, owner="ann", state="creating")
    service = place.new_service()
    service.start()
    jobs = place.until_all_end()
    service.close()
    assert [(job.sweep, job.outcome) for job in jobs] == [("written", "completed")]
    assert place.queue.known("ann", "k", "d") is None


def test_a_sweep_that_somebody_else_drives_is_waited_for(place: Place, service: Supervisor) -> None:
    store = place.add("a")
    with store.lock():
        job, _ = place.queue.begin("a", "drive", {}, owner="ann", num_cpus=1.0)
        other = place.submit("b")
        place.wait(lambda: place.queue.job(other.id).state == "ended", "b never ended")
        assert place.queue.job(job.id).state == "waiting"
    assert [item.outcome for item in place.until_all_end()] == ["completed", "completed"]


def test_a_warm_process_takes_the_next_sweep(place: Place) -> None:
    service = place.new_service(spare_idle_s=600.0)
    service.start()
    place.wait(lambda: service._spare is not None and service._spare.is_warm(), "none became warm")
    assert service._spare is not None
    pid = service._spare.pid
    job = place.submit("a")
    service.wake()
    assert place.until_it_runs(job) == pid
    place.until_all_end()
    place.wait(lambda: service._spare is not None and service._spare.pid != pid, "no other one is kept")
    spare = service._spare.pid
    service.close()
    with pytest.raises(ProcessLookupError):
        os.kill(spare, 0)


def test_what_is_kept_warm_ends_when_no_sweep_comes(place: Place) -> None:
    service = place.new_service(spare_idle_s=5.0)
    service.start()
    place.wait(lambda: service.spare() is not None, "none is kept")
    place.wait(lambda: service.spare() is None, "it is kept for ever")
    place.submit("a")
    place.until_all_end()
    place.wait(lambda: service.spare() is not None, "no other one is kept")
    place.wait(lambda: (service.spare() or {}).get("warm"), "none became warm")
    assert (service.spare() or {})["memory_bytes"] > 10**6
    assert service.spare_is_warm() is True
    service.close()


def test_a_warm_process_ends_with_a_service_that_is_killed(place: Place) -> None:
    driver = Driver({}, module="fake_driver")
    place.wait(driver.is_warm, "it never became warm")
    driver._socket.close()
    place.wait(lambda: driver.poll() is not None, "it lives on")


def test_no_more_run_at_once_than_there_are_cpus(place: Place, service: Supervisor) -> None:
    for job in [place.submit(name, seconds=100) for name in ("s0", "s1")]:
        place.until_it_runs(job)
    for index in range(2, 6):
        place.submit(f"s{index}", seconds=0.2)
    for name in ("s0", "s1"):
        place.queue.request_stop(name)
    place.until_all_end()
    at_once = most = 0
    for line in place.journal():
        at_once += 1 if line["what"] == "begin" else -1
        most = max(most, at_once)
    assert most == 2


def files_of(place: Place) -> set[str]:
    """The names of the files of all jobs."""
    return {path.name for path in (place.service_folder / "jobs").iterdir()}


def test_of_jobs_that_ended_only_what_the_failed_ones_said_is_kept(place: Place, service: Supervisor) -> None:
    place.submit("good")
    place.submit("bad", error="it broke")
    place.submit("dies", exit=True)
    stopped, runs = place.submit("stopped", seconds=100), place.submit("runs", seconds=100)
    place.until_it_runs(stopped)
    place.queue.request_stop("stopped")
    place.until_it_runs(runs)
    place.wait(lambda: len(place.queue.jobs("ended")) == 4, "they never ended")
    uids = {job.sweep: job.uid for job in place.queue.jobs()}
    kept = {f"{uids['bad']}.log", f"{uids['dies']}.log", f"{uids['runs']}.log", f"{uids['runs']}.held"}
    place.wait(lambda: files_of(place) == kept, "other files are left")
    # A good one whose files could not be removed, as the service was killed, and a failed one of long ago.
    old = time.time() - KEPT_S - 60
    os.utime(place.service_folder / "jobs" / f"{uids['bad']}.log", (old, old))
    for name in ("left.held", "left.json"):
        (place.service_folder / "jobs" / name).write_text("{}")
    place.submit("last")
    place.wait(lambda: len(place.queue.jobs("ended")) == 5, "it never ended")
    place.wait(lambda: files_of(place) == kept - {f"{uids['bad']}.log"}, "other files are left")


def test_a_start_removes_the_files_of_jobs_that_ended_and_no_others(place: Place) -> None:
    first = place.new_service()
    first.start()
    runs = place.submit("runs", seconds=3.0)
    pid = place.until_it_runs(runs)
    first.close()
    jobs = place.service_folder / "jobs"
    for name in ("ended.held", "ended.json", "ended.log"):
        (jobs / name).write_text("{}")
    # Of a job that the database has lost, whose driver lives.
    unknown = JobFiles(place.service_folder, "unknown")
    lock = unknown.take()
    second = place.new_service()
    second.reconcile()
    assert files_of(place) == {"ended.log", f"{runs.uid}.held", f"{runs.uid}.log", "unknown.held"}
    assert lock is not None
    os.close(lock)
    second.start()
    (job,) = place.until_all_end()
    second.close()
    assert (job.outcome, [line["pid"] for line in place.begins("runs")]) == ("completed", [pid])
    assert files_of(place) == {"ended.log"}
