"""Texts that processes print and names that folders have, which no database takes: they keep nothing from running."""

import os
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

import pytest
from databases import database_url, postgresql  # noqa: F401 (fixtures)
from test_service_supervisor import Place, place  # noqa: F401 (a fixture)

from policies.errors import CheckpointError
from tests.narrowing import present
from tune_jobs.service import driver, supervisor
from tune_jobs.service.database.opening import open_database
from tune_jobs.service.database.tables import MOST_LETTERS
from tune_jobs.service.job_files import Ended, JobFiles
from tune_jobs.service.queue import Queue

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def either(place: Place, database_url: str) -> Place:
    """A storage folder with a queue in a database of each kind."""
    place.engine.dispose()
    place.engine = open_database(database_url)
    place.queue = Queue(place.engine)
    return place


def test_a_log_with_a_nul_ends_its_job_once_and_no_others(either: Place) -> None:
    bad = either.submit("bad")
    present(either.queue.claim(2.0))
    for _ in range(supervisor.MAX_ATTEMPTS - 1):
        either.queue.again(bad.id)
    good = either.submit("good")
    files = JobFiles(either.service_folder, bad.uid)
    files.log.parent.mkdir()
    files.log.write_bytes(b"x\x00y\xf6\n")
    service = either.new_service()
    service.start()
    bad, good = either.until_all_end()
    service.close()
    assert (bad.outcome, good.outcome) == ("failed", "completed")
    assert present(bad.message).endswith(f"died {supervisor.MAX_ATTEMPTS} times.\nx\\x00y\N{REPLACEMENT CHARACTER}")
    assert [(job.sweep, job.message) for job in either.ended] == [("bad", bad.message), ("good", None)]


def test_the_queue_takes_any_message(either: Place) -> None:
    job = either.submit("mine")
    assert either.queue.end(job.id, "failed", "a\0\udcf6b").message == "a\\x00\\udcf6b"


def raising(error: BaseException) -> Callable[[Mapping[str, Any]], NoReturn]:
    def done(_: Mapping[str, Any]) -> NoReturn:
        raise error

    return done


@pytest.mark.parametrize("text", ["\udcf6.npy is missing", "a\0b"], ids=["half", "nul"])
def test_what_no_text_is_is_written_as_why_a_sweep_failed(
    place: Place, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.setattr(driver, "_done", raising(ValueError(text)))
    files = JobFiles(place.service_folder, "job")
    os.close(present(files.take()))
    files.write_ended(driver._ended({"attempt": 1}))
    said = text.encode("unicode_escape").decode()
    assert files.read_ended(1) == Ended(attempt=1, outcome="failed", message=f"ValueError: {said}")


def test_a_folder_whose_name_is_no_text_keeps_no_other_sweep_from_running(
    either: Place, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("odd", "long", "good"):
        either.add(name, state="running")
    (either.folder / "odd").rename(either.folder / os.fsdecode(b"l\xf6we"))
    (either.folder / "long").rename(either.folder / ("x" * (MOST_LETTERS + 1)))
    either.new_service().reconcile()
    assert [job.sweep for job in either.queue.jobs("waiting")] == ["good"]
    first, second = sorted(record.getMessage() for record in caplog.records)
    assert first.startswith("Sweep l\\udcf6we is left alone: The name of the folder 'l\\udcf6we' is no text in UTF-8")
    assert second.startswith(f"Sweep {'x' * (MOST_LETTERS + 1)} is left alone: The name of the folder 'xxx")
    assert second.endswith(f"has {MOST_LETTERS + 1} letters, and the queue takes {MOST_LETTERS}.\nRename the folder.")


def test_the_longest_name_has_a_job(either: Place) -> None:
    name = "\N{LATIN SMALL LETTER O WITH DIAERESIS}" * MOST_LETTERS
    assert either.queue.begin(name, "drive", {}, owner="ann")[0].sweep == name
    with pytest.raises(CheckpointError):
        either.queue.begin(f"{name}x", "drive", {}, owner="ann")
