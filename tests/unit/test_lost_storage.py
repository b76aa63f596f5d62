"""A run whose storage is gone in the middle says so, whatever error that led to, and how to go on."""

import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest
from s3_faults import Faults
from store_parts import make_sweep
from sweep_folders import make_sweep_folder

from analysis.records import JobRecord
from policies.errors import CannotRunError, NotFoundError
from tune_jobs.ray_tune.run_trials import _saying_how_to_go_on
from tune_jobs.store.objects import outbox
from tune_jobs.store.objects.bucket import StorageError
from tune_jobs.store.objects.object_sweep import ObjectSweep
from tune_jobs.store.objects.parts import Parts
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.opening import resume_command
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.storage_watch import StorageWatch
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import stages
from tune_jobs.sweeps.drive import Shared, _giving_way_to
from tune_jobs.sweeps.lost_storage import told_if_it_is_gone
from tune_jobs.sweeps.monitor import SweepMonitor


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    return make_sweep_folder(tmp_path / "mounted" / "mine", iterations=1)


def taken_away(store: SweepStore) -> None:
    store.folder.parent.rename(store.folder.parent.with_name("elsewhere"))


ERRORS = [
    NotFoundError("No sweep at /x/sweep.json.", "List the sweeps here with `tune-jobs list`."),
    OwnershipLostError("/x has been taken over by another process."),
    FileNotFoundError(2, "No such file or directory"),
]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_of_a_storage_that_is_gone_says_so(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def run(_: object, __: object, shared: Shared, **___: object) -> NoReturn:
        shared.monitor = SweepMonitor("mine", [], caps={})
        shared.monitor.reported_at = time.mktime((2026, 5, 4, 13, 2, 1, 0, 0, -1))
        taken_away(store)
        raise error

    store.write_record(store.read_record().model_copy(update={"address": "10.0.0.1:6379"}))
    monkeypatch.setattr(stages, "_run_sweep", run)
    plan: object = None
    with pytest.raises(CannotRunError) as caught:
        stages.run_sweep(store, plan, address=None, machine=None, finish=True, progress="none")  # type: ignore[arg-type]
    assert type(caught.value) is CannotRunError
    assert caught.value.exit_code == 5
    assert f"The storage of sweep mine is gone: No sweep at {store.record_path}. It was missed at" in str(caught.value)
    assert "; a trial last reported at 13:02:01." in caught.value.message
    assert f"`tune-jobs resume {store.place} --address 10.0.0.1:6379`" in caught.value.hint


def test_the_command_that_goes_on_finds_the_sweep_and_its_cluster(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = store.read_record()
    assert resume_command(store, record) == f"tune-jobs resume {store.place}"
    monkeypatch.setenv("TUNE_JOBS_STORAGE", str(store.folder.parent))
    assert resume_command(store, None) == "tune-jobs resume mine"
    on_cluster = record.model_copy(update={"address": "ray://head:10001"})
    assert resume_command(store, on_cluster) == "tune-jobs resume mine --address ray://head:10001"
    job = JobRecord(id="a", address="http://head:8265")
    by_job = on_cluster.model_copy(update={"job": job})
    assert resume_command(store, by_job) == "tune-jobs resume mine --address http://head:8265 --detach"
    monkeypatch.setenv("TUNE_JOBS_STORAGE", "s3://bucket/sweeps")
    assert resume_command(store, None) == f"tune-jobs resume {store.place}"


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_of_a_storage_that_is_there_stays_as_it_is(store: SweepStore, error: Exception) -> None:
    with pytest.raises(type(error)) as caught, told_if_it_is_gone(store, lambda: None):
        raise error
    assert caught.value is error


def test_an_object_store_that_does_not_answer_is_gone_too(url: ObjectUrl) -> None:
    store = ObjectSweep(url)
    with pytest.raises(CannotRunError) as caught, told_if_it_is_gone(store, lambda: None):
        raise StorageError("s3://x cannot be written: the connection was refused.", "Check it.", passes=True)
    assert "is gone: s3://x cannot be written: the connection was refused. It was missed at" in caught.value.message
    assert "tune-jobs resume" in caught.value.hint


@pytest.mark.parametrize("what", ["read", "list", "write"])
def test_credentials_that_expire_in_the_middle_are_one_error_that_says_what_to_do(
    faults: Faults, url: ObjectUrl, what: str
) -> None:
    store = ObjectSweep(url)
    store.write_record(make_sweep())
    store = ObjectSweep(url)
    body = "<Error><Code>ExpiredToken</Code><Message>The provided token has expired.</Message></Error>"
    faults.rule("status", status=403, body=body, times=10_000)
    ask: dict[str, Callable[[], object]] = {
        "read": store.stop_requested,
        "list": store.read_trials,
        "write": lambda: store.write_record(make_sweep(state="completed")),
    }
    with pytest.raises(CannotRunError) as caught, told_if_it_is_gone(store, lambda: None):
        ask[what]()
    assert (type(caught.value), caught.value.exit_code) == (CannotRunError, 5)
    assert "403 Forbidden, ExpiredToken, The provided token has expired." in caught.value.message
    assert "has expired or is not valid: get new ones" in caught.value.hint
    assert f"What is done is kept; continue with `tune-jobs resume {shlex.quote(store.place)}`." in caught.value.hint


def test_no_folder_is_made_where_a_storage_is_gone(store: SweepStore) -> None:
    run, pack = store.take(), store.pack("p00")
    run.release()
    taken_away(store)
    with pytest.raises(OwnershipLostError), run.held():
        pass
    with pytest.raises(CannotRunError, match="is gone"):
        pack.take(run)
    assert not store.folder.parent.exists()
    # Nor a file in what lies there instead.
    store.folder.mkdir(parents=True)
    with pytest.raises(OwnershipLostError), run.held():
        pass
    assert list(store.folder.iterdir()) == []


def test_a_store_that_was_away_too_long_for_an_upload_is_gone(url: ObjectUrl, monkeypatch: pytest.MonkeyPatch) -> None:
    away = StorageError("s3://x cannot be written: no answer.", "Check it.", passes=True, reason="no answer")

    def upload() -> NoReturn:
        raise away

    monkeypatch.setattr(outbox, "PATIENCE_S", -1.0)
    uploads = outbox.Outbox()
    uploads.add("a", upload)
    with pytest.raises(StorageError) as raised:
        uploads.settle(["a"])
    assert (raised.value.passes, raised.value.reason) == (True, "no answer")
    with pytest.raises(CannotRunError) as caught, told_if_it_is_gone(ObjectSweep(url), lambda: None):
        # The next write is told, too.
        uploads.add("a", upload)
    assert "is gone: s3://x cannot be written" in caught.value.message


def test_a_store_that_is_away_while_it_is_waited_for_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    def upload() -> NoReturn:
        raise StorageError("s3://x cannot be written: no answer.", "Check it.", passes=True)

    uploads = outbox.Outbox()
    uploads.add("a", upload)
    with pytest.raises(StorageError, match=r"1 uploads have not ended within 0 s. s3://x cannot be written") as raised:
        uploads.settle(["a"], timeout_s=0.3)
    assert raised.value.passes


def test_an_error_that_names_the_store_says_still_that_it_passes(url: ObjectUrl) -> None:
    parts = Parts(url)
    with pytest.raises(StorageError) as raised, parts.named():
        raise StorageError(f"{parts.own()}/x cannot be read.", "Check it.", passes=True, reason="no answer")
    assert raised.value.message == f"{url.short}/x cannot be read."
    assert raised.value.args == (raised.value.message, "Check it.")
    assert (raised.value.passes, raised.value.reason) == (True, "no answer")


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_folder_that_is_away_for_a_moment_is_waited_for_and_one_that_stays_away_ends_the_run(
    store: SweepStore,
) -> None:
    clock = Clock()
    watch = StorageWatch(store, clock)
    away = store.folder.parent.with_name("elsewhere")
    for clock.now in (1.0, 1.1, 2.0):
        watch.check()
    store.folder.parent.rename(away)
    for clock.now in (2.5, 3.0, 4.0):
        watch.check()
    away.rename(store.folder.parent)
    clock.now = 5.0
    watch.check()
    store.folder.parent.rename(away)
    clock.now = 7.9
    watch.check()
    clock.now = 9.0
    with pytest.raises(CannotRunError, match="has not been there for 4 s"):
        watch.check()


def test_what_cannot_be_written_at_the_end_gives_way_to_what_ended_the_run() -> None:
    full = CannotRunError("sweep.json cannot be written: read-only.", "Free it.")
    earlier = CannotRunError("trial.json cannot be written: read-only.")
    with _giving_way_to(earlier):
        raise full
    # Nothing else has told it.
    with pytest.raises(CannotRunError) as caught, _giving_way_to(None):
        raise full
    assert caught.value is full
    # A defect is none of the storage's.
    with pytest.raises(KeyError), _giving_way_to(earlier):
        raise KeyError("x")


def test_a_storage_that_ends_a_run_says_how_to_go_on_once() -> None:
    full = CannotRunError("trial.json cannot be written: read-only.", "Free it.")
    with pytest.raises(CannotRunError) as caught, _saying_how_to_go_on("tune-jobs resume mine"):
        raise full
    assert caught.value.message == full.message
    assert caught.value.hint == "Free it. What is done is kept; continue with `tune-jobs resume mine`."
    # Those that are more than that say it themselves.
    for other in (OwnershipLostError("/x has been taken over."), StorageError("s3://x is refused."), KeyError("x")):
        with pytest.raises(type(other)) as kept, _saying_how_to_go_on("tune-jobs resume mine"):
            raise other
        assert kept.value is other
