"""What following sweeps takes: what is read again, what is kept of events and curves."""

import contextlib
import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from store_parts import make_iteration
from sweep_folders import make_sweep_folder

from tune_jobs.service import statuses as module
from tune_jobs.service import watching
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.event_log import EventLog
from tune_jobs.service.service import opened
from tune_jobs.service.statuses import Statuses
from tune_jobs.service.views import ListView, SweepView
from tune_jobs.service.watching import Follower
from tune_jobs.store.opening import open_storage
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.sweeps.curves import Curves
from tune_jobs.sweeps.status import status_of


class Clock:
    """Seconds as a test says."""

    def __init__(self) -> None:
        self.now = 1_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SweepStore]:
    """A sweep of 4 trials that seems to be driven."""
    made = make_sweep_folder(tmp_path / "mine")
    made.write_record(made.read_record().model_copy(update={"state": "running"}))
    with made.lock():
        yield made


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The trials whose records were read."""
    names: list[str] = []
    original = TrialStore.read_record

    def note(self: TrialStore) -> Any:
        names.append(self.trial_id)
        return original(self)

    monkeypatch.setattr(TrialStore, "read_record", note)
    return names


def write(store: SweepStore, trial_id: str, **changes: Any) -> None:
    trial = store.trial(trial_id)
    trial.write_record(trial.read_record().model_copy(update=changes))


# -- statuses


def test_only_records_that_were_written_are_read_again(store: SweepStore, read: list[str]) -> None:
    clock = Clock()
    statuses = Statuses(open_storage(store.folder.parent), clock)
    first = statuses.see("mine")
    assert sorted(read) == ["t0000", "t0001", "t0002", "t0003"]
    write(store, "t0002", status="failed")
    read.clear()
    # A moment later it is as it was.
    assert statuses.see("mine") is first
    clock.now += 1
    second = statuses.see("mine")
    assert read == ["t0002"]
    assert [before is after for before, after in zip(first.trials.records, second.trials.records, strict=True)] == [
        True, True, False, True,
    ]  # fmt: skip
    assert second.status.counts == {"completed": 3, "failed": 1}
    assert second.trials.scores == {"t0000": 6.0, "t0001": 16.0, "t0002": None, "t0003": 36.0}
    read.clear()
    clock.now += 1
    third = statuses.see("mine")
    assert not read
    assert (third.status, third.trials) == (second.status, second.trials)
    assert third.status is second.status


def test_a_sweep_that_begins_or_ends_is_seen_at_once(tmp_path: Path, read: list[str]) -> None:
    store, clock = make_sweep_folder(tmp_path / "mine"), Clock()
    statuses = Statuses(open_storage(tmp_path), clock)
    assert statuses.see("mine").is_over
    read.clear()
    clock.now += 3_600
    statuses.see("mine")
    # One that is over is not even listed.
    assert not read
    with store.lock():
        write(store, "t0000", status="running")
        assert statuses.see("mine").status.alive
        assert statuses.see("mine").status.counts["running"] == 1
        write(store, "t0000", status="completed")
    seen = statuses.see("mine")
    assert not seen.status.alive
    assert seen.status.counts == {"completed": 4}


def test_the_end_of_the_process_that_runs_a_sweep_is_an_event(tmp_path: Path) -> None:
    """After its trials it writes the result: nothing else tells that this is there."""
    store = make_sweep_folder(tmp_path / "sweeps" / "mine")
    with opened(ServiceConfig(storage=tmp_path / "sweeps", port=0, spare_idle_s=0)) as service:
        view = SweepView("mine", service.storage, service.statuses, service.queue, service.labels)
        whole = ListView(service.statuses, service.queue, service.labels)
        with store.lock():
            (kind, data), *_ = view.changes()
            assert (kind, data["state"], data["alive"]) == ("status", "completed", True)
            assert whole.changes() == view.changes() == []
        ((kind, data),) = view.changes()
        assert (kind, data["state"], data["alive"]) == ("status", "completed", False)
        ((kind, data),) = whole.changes()
        assert (kind, data["sweeps"][0]["alive"]) == ("sweeps", False)
        assert view.changes() == []


def test_what_takes_long_is_done_less_often_and_yet_done(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch, read: list[str]
) -> None:
    clock, sums = Clock(), []
    original = status_of

    def slow(*arguments: Any, **named: Any) -> Any:
        clock.now += 0.06
        sums.append(clock.now)
        return original(*arguments, **named)

    monkeypatch.setattr(module, "status_of", slow)
    statuses = Statuses(open_storage(store.folder.parent), clock)
    statuses.see("mine")
    write(store, "t0002", status="failed")
    clock.now += 1
    seen = statuses.see("mine")
    # The trials are those of now, what was made of all of them is not yet.
    assert seen.trials.records[2].status == "failed"
    assert "failed" not in seen.status.counts
    clock.now += 2.5
    assert statuses.see("mine").status.counts["failed"] == 1
    clock.now += 60
    statuses.see("mine")
    assert len(sums) == 2
    # However long it takes, it is not older than a few seconds.
    assert module.Done(0.0, 100.0).is_due(5.0, 5.0)
    assert not module.Done(0.0, 0.0).is_due(0.3, 5.0)


# -- curves


def test_points_in_memory_are_bounded(store: SweepStore) -> None:
    curves = Curves(store, max_points=400)
    trial_ids = [f"t{index:04d}" for index in range(4)]
    assert {len(rows["iteration"]) for rows in curves.update(trial_ids).values()} == {6}
    for begin in range(7, 500, 31):
        records = [make_iteration(number, evaluation_return=0.0) for number in range(begin, begin + 31)]
        store.trial("t0000").append_iterations(records)
        assert curves.update(["t0000"])["t0000"]["after"] == begin - 1
    found = curves.columns(10_000)
    assert len(found["t0000"]["iteration"]) <= 100
    assert (found["t0000"]["iteration"][0], found["t0000"]["iteration"][-1]) == (1, 502)
    assert len(found["t0001"]["iteration"]) == 6
    assert curves.update(trial_ids) == {}


def test_a_trial_whose_results_cannot_be_read_has_no_curve(store: SweepStore, caplog: pytest.LogCaptureFixture) -> None:
    store.trial("t0001").results_path.unlink()
    store.trial("t0001").results_path.mkdir()
    assert set(Curves(store).update(["t0000", "t0001"])) == {"t0000"}
    assert "t0001" in caplog.text


@pytest.mark.parametrize("most", [2, 3, 5, 50])
def test_thinned_curves_have_no_more_points_than_asked_for(store: SweepStore, most: int) -> None:
    records = [make_iteration(number, evaluation_return=1_000.0 - abs(number - 70)) for number in range(7, 200)]
    store.trial("t0000").append_iterations(records)
    curves = Curves(store)
    curves.update(["t0000"])
    shown = curves.columns(most)["t0000"]["iteration"]
    assert most // 2 <= len(shown) <= most
    assert {1, 199} <= set(shown)
    # The highest evaluation.
    assert (70 in shown) == (most > 2)


# -- the log of events


def frames(log: EventLog, number: int) -> list[str] | None:
    taken = log.since(number)
    return None if taken is None else [line for line in taken.frames.decode().splitlines() if line.startswith("data")]


def test_old_events_are_forgotten_and_whoever_needs_them_told_so() -> None:
    log = EventLog("s", max_events=3)
    begun = log.begin(None)
    log.add([("a", {"n": number}) for number in range(3)])
    assert frames(log, begun.number) == ['data: {"n":0}', 'data: {"n":1}', 'data: {"n":2}']
    log.add([("a", {"n": 3})])
    assert log.since(begun.number) is None
    assert frames(log, begun.number + 1) == ['data: {"n":1}', 'data: {"n":2}', 'data: {"n":3}']
    assert b"event: reset" in log.begin(f"s-{begun.number}").frames
    assert log.begin(f"s-{begun.number + 1}").frames == b""
    assert log.begin(log.last_id).frames == b""


def test_what_is_kept_and_what_is_sent_at_once_is_bounded_in_bytes() -> None:
    log = EventLog("s", max_bytes=1_500_000)
    begun = log.begin(None)
    log.add([("a", {"n": number, "text": "x" * 400_000}) for number in range(5)])
    assert log.since(begun.number + 1) is None
    number, seen = begun.number + 2, []
    while (more := log.since(number)) is not None and more.frames:
        assert len(more.frames) < 1_000_000
        number = more.number
        seen.append(more.frames.count(b"event:"))
    assert seen == [1, 1, 1]
    # One that is larger than all that is kept is sent all the same.
    log.add([("a", {"text": "x" * 5_000_000})])
    last = log.since(number)
    assert last is not None
    assert len(last.frames) > 5_000_000


def test_numbers_are_shared_and_events_are_greeted_by_kind() -> None:
    numbers = itertools.count(1)
    one, other = (EventLog("s", numbers, greeting=("status",)) for _ in range(2))
    one.add([("status", {"n": 1}), ("trials", {}), ("status", {"n": 2})])
    other.add([("status", {"n": 3})])
    assert one.begin(None).frames.count(b"event:") == 1
    assert b'{"n":2}' in one.begin(None).frames
    assert one.begin(None).frames.startswith(f"id: {one.last_id}\n".encode())
    assert one.last_id != other.last_id
    # NaN is no JSON.
    other.add([("status", {"n": float("nan")})])
    assert b'{"n":null}' in other.begin(None).frames


def test_listeners_are_woken_and_forgotten() -> None:
    log, woken = EventLog("s"), threading.Event()
    with log.listening(woken.set):
        assert log.num_listeners == 1
        log.add([])
        assert not woken.is_set()
        log.add([("a", {})])
        assert woken.is_set()
        woken.clear()
        log.end()
        assert woken.is_set()
    assert log.num_listeners == 0
    assert log.has_ended


class Quiet:
    """A view in which nothing changes."""

    interval_s = 0.5

    def changes(self) -> list[Any]:
        return []


class Slow(Quiet):
    """One whose first look takes a while; later ones take none."""

    interval_s = 0.05

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def changes(self) -> list[Any]:
        time.sleep(self.seconds)
        self.seconds = 0.0
        return []


def has_ended(follower: Follower, within_s: float) -> bool:
    """Whether a follower ends within some seconds."""
    deadline = time.monotonic() + within_s
    while not follower.log.has_ended and time.monotonic() < deadline:
        time.sleep(0.01)
    return follower.log.has_ended


def test_it_may_be_joined_at_each_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    follower = Follower("it", Slow(0.0), EventLog("s"))

    class Thread(threading.Thread):
        def start(self) -> None:
            # As another thread does that closes all just now.
            follower.end()
            follower.join()
            super().start()

    monkeypatch.setattr(threading, "Thread", Thread)
    follower.begin()
    follower.join()
    assert has_ended(follower, 5.0)


def test_what_was_looked_at_for_longer_than_one_lingers_is_followed_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watching, "LINGER_S", 0.5)
    follower = Follower("it", Slow(1.0), EventLog("s"))
    follower.begin()
    assert not has_ended(follower, 0.25)
    assert has_ended(follower, 20)


def test_what_somebody_has_asked_for_is_followed_until_they_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page has the curves, and loads trials for minutes before it watches."""
    monkeypatch.setattr(watching, "LINGER_S", 0.1)
    monkeypatch.setattr(watching, "AWAITED_S", 2.0, raising=False)
    for comes in (False, True):
        follower = Follower("it", Slow(0.0), EventLog("s"))
        follower.begin()
        follower.curves(10)
        assert not has_ended(follower, 1.0)
        if comes:
            with follower.log.listening(lambda: None):
                time.sleep(0.3)
            # Whoever leaves does not leave it to others for so long.
            assert has_ended(follower, 0.7)
        assert has_ended(follower, 20)


class Pauses:
    """An event that is set when it has been waited for twice, and knows for how long."""

    def __init__(self) -> None:
        self.asked_s: list[float] = []

    def wait(self, timeout_s: float) -> bool:
        self.asked_s.append(timeout_s)
        return len(self.asked_s) > 1

    def set(self) -> None:
        pass


@pytest.mark.parametrize(("num_clients", "wait_s"), [(1, 0.5), (100, 1.0), (1_000, 5.0)])
def test_whoever_watches_waits_a_little_longer_the_more_do(
    num_clients: int, wait_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    follower, pauses = Follower("it", Quiet(), EventLog("s")), Pauses()
    monkeypatch.setattr(follower, "_over", pauses)
    with contextlib.ExitStack() as stack:
        for _ in range(num_clients):
            # Each a function of its own.
            stack.enter_context(follower.log.listening(threading.Event().set))
        follower.begin()
        follower.join()
    assert pauses.asked_s == [0.5, wait_s]
