"""A service that ends together with its database: sweeps save all the same, and it is no error."""

import logging
import os
import signal
import threading
from pathlib import Path

import pytest
from live_service import wait_until
from served import Served
from test_service_supervisor import PATIENCE_S, Place, place  # noqa: F401 (a fixture)

from tests.narrowing import present
from tune_jobs.service.job_files import Holder, JobFiles

# ruff: noqa: F811 - fixtures are named as arguments


def test_sweeps_save_while_the_database_is_away(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    first = place.new_service()
    first.start()
    job = place.submit("a", seconds=1.0)
    place.until_it_runs(job)
    files = JobFiles(place.service_folder, job.uid)
    file, away = place.service_folder / "service.db", place.service_folder / "away.db"
    file.rename(away)
    try:
        assert first.drain(PATIENCE_S)
        assert not files.is_run()
        assert present(files.read_ended(1)).outcome == "interrupted"
        assert "The service's database can't be used" in caplog.text
    finally:
        away.rename(file)
    assert place.queue.job(job.id).state == "running"
    second = place.new_service()
    second.start()
    (job,) = place.until_all_end()
    second.close()
    assert (job.outcome, job.num_attempts, len(place.begins("a"))) == ("completed", 2, 2)


def test_one_that_does_not_save_in_time_is_told_and_waited_for_no_longer(place: Place) -> None:
    service = place.new_service()
    service.start()
    job = place.submit("a", seconds=100)
    pid = place.until_it_runs(job)
    os.kill(pid, signal.SIGSTOP)
    (place.service_folder / "service.db").rename(place.service_folder / "away.db")
    try:
        assert not service.drain(0.3)
        assert JobFiles(place.service_folder, job.uid).is_run()
    finally:
        os.kill(pid, signal.SIGKILL)


def test_one_whose_lock_can_not_be_read_keeps_no_other_from_saving(place: Place) -> None:
    service = place.new_service()
    service.start()
    (place.service_folder / "jobs").mkdir()
    (place.service_folder / "jobs" / "0.held").symlink_to("nothing")
    job = place.submit("a", seconds=100)
    place.until_it_runs(job)
    assert service.drain(PATIENCE_S)
    assert place.queue.job(job.id).state == "waiting"


def test_a_driver_that_says_late_who_it_is_is_asked_then(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    job = place.submit("a")
    files = JobFiles(place.service_folder, job.uid)
    lock = present(files.take())
    service = place.new_service()
    drained: list[bool] = []
    worker = threading.Thread(target=lambda: drained.append(service.drain(PATIENCE_S)))
    asked: list[int] = []
    with pytest.MonkeyPatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(os, "kill", lambda pid, number: asked.append(number))
        worker.start()
        try:
            files.say_who(Holder(pid=os.getpid(), sweep="a"))
            wait_until(lambda: asked)
        finally:
            os.close(lock)
            worker.join(PATIENCE_S)
    assert (drained, asked) == ([True], [signal.SIGHUP])


def test_the_command_ends_well_without_its_database(tmp_path: Path) -> None:
    server = Served(tmp_path / "sweeps", "--spare-idle", "0", "--drain", "5")
    try:
        folder = tmp_path / "sweeps" / ".service"
        (folder / "service.db").rename(folder / "away.db")
        assert server.end() == 0
    finally:
        server.process.kill()
        server.process.wait()
    said = server.said()
    assert "bug" not in said
    assert "Traceback" not in said
