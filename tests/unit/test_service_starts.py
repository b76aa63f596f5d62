"""Jobs that can't be started, as a disk is full or something is in the way; and what is kept of those that end."""

import errno
import os
from collections.abc import Iterator
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError
from store_parts import make_trial
from synthetic_sweep import make_sweep_record
from test_service_supervisor import Place, place  # noqa: F401 (a fixture)

from policies.errors import fit
from tests.narrowing import present
from tune_jobs.service import driver
from tune_jobs.service import supervisor as module
from tune_jobs.service.job_files import Ended
from tune_jobs.service.supervisor import Supervisor
from tune_jobs.sweeps.outcome import SweepResult

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def service(place: Place) -> Iterator[Supervisor]:
    made = place.new_service()
    yield made
    made.close()


def test_a_queue_that_can_not_be_written_is_no_death_of_a_driver(
    place: Place, service: Supervisor, caplog: pytest.LogCaptureFixture
) -> None:
    place.submit("a")
    # Its driver died: nobody has the lock.
    present(place.queue.claim(2.0))
    deaths: list[None] = []
    service._on_death = lambda: deaths.append(None)

    def full(*_: Any) -> None:
        raise OperationalError("UPDATE", {}, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(place.queue, "again", full)
        for _ in range(module.MAX_ATTEMPTS):
            with pytest.raises(OperationalError):
                service._look()
    assert (deaths, caplog.text) == ([], "")
    # When there is space, it goes on.
    service.start()
    (job,) = place.until_all_end()
    assert (job.outcome, job.num_attempts, len(deaths)) == ("completed", 2, 1)
    assert caplog.text.count("another one goes on") == 1


@pytest.mark.parametrize("what", ["held", "log"])
def test_a_sweep_whose_own_files_can_not_be_written_fails_and_keeps_no_other_from_running(
    place: Place, service: Supervisor, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    uid = place.submit("a").uid
    path, opened = place.service_folder / "jobs" / f"{uid}.{what}", os.open

    def full(file: Any, flags: int, *more: Any, **named: Any) -> int:
        if flags & os.O_CREAT and str(file) == str(path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))
        return opened(file, flags, *more, **named)

    monkeypatch.setattr(os, "open", full)
    place.submit("b")
    service.start()
    failed, other = place.until_all_end()
    assert (failed.outcome, failed.num_attempts) == ("failed", module.MAX_ATTEMPTS)
    told = present(failed.message)
    assert told.startswith(f"The sweep can't be started, after {module.MAX_ATTEMPTS} attempts: ")
    assert f"can't write {path}: No space left on device." in told
    assert "Check the storage folder." in told
    assert (other.outcome, other.num_attempts) == ("completed", 1)
    assert place.begins("a") == []


def test_whether_what_follows_the_trials_failed_is_kept(place: Place, service: Supervisor) -> None:
    for name, how in (("whole", {}), ("no film", {"finish_failed": True}), ("broken", {"error": "it broke"})):
        place.submit(name, **how)
    service.start()
    ended = [(job.sweep, job.finish_failed) for job in place.until_all_end()]
    assert ended == [("whole", False), ("no film", True), ("broken", None)]
    assert sorted((job.sweep, job.finish_failed) for job in place.ended) == sorted(ended)


@pytest.mark.parametrize("num_failed", [0, 1])
def test_a_job_says_why_its_sweep_has_no_best_policy(monkeypatch: pytest.MonkeyPatch, num_failed: int) -> None:
    why = "The environment MyEnv-v0 raised ValueError: bad \udcf6, while the policy was confirmed."
    trials = [make_trial(index, status="failed" if index < num_failed else "completed") for index in range(4)]
    record = make_sweep_record("mine", "ppo", "CartPole-v1", [], 1)
    notes = ("No report: no space is left.",)
    result = SweepResult("mine", record, trials, why_no_best=why, finish_failed=True, notes=notes)
    monkeypatch.setattr(driver, "_done", lambda _: result)
    said = f"No report: no space is left. No best policy: {fit(why)}"
    message = f"1 of 4 trials failed. {said}" if num_failed else said
    assert driver._ended({"attempt": 2}) == Ended(attempt=2, outcome="completed", message=message, finish_failed=True)
