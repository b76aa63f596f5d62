"""Curves and events over real HTTP: what is appended to a sweep's trials reaches those who watch, once."""

import functools
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest
from live_service import EventReader, Live, live, serving, wait_until  # noqa: F401 (a fixture)
from sweep_folders import make_sweep_folder

from analysis.records import IterationRecord
from tune_jobs.service import watching
from tune_jobs.service.http import event_stream
from tune_jobs.store.sweep_store import SweepStore

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def store(live: Live) -> Iterator[SweepStore]:
    """A sweep of 4 trials with 6 iterations each, which seems to be driven, and its first trial to be trained."""
    with running(live.storage / "mine") as made:
        yield made


@contextmanager
def running(folder: Path) -> Iterator[SweepStore]:
    store = make_sweep_folder(folder)
    trial = store.trial("t0000")
    trial.write_record(trial.read_record().model_copy(update={"status": "running"}))
    store.write_record(store.read_record().model_copy(update={"state": "running"}))
    with store.lock():
        yield store


def iteration(number: int, **changes: Any) -> IterationRecord:
    return IterationRecord(
        iteration=number, num_env_steps=100 * number, num_episodes=number, time_s=number, **changes
    )  # fmt: skip


def rows_of(reader: EventReader, trial_id: str = "t0000") -> list[int]:
    """The iterations of a trial that came, in the order in which they did."""
    return [
        number
        for event in reader.of("iterations")
        for number in event.data["trials"].get(trial_id, {}).get("iteration", ())
    ]


# -- curves


def test_curves_are_the_results_in_columns(live: Live, store: SweepStore) -> None:
    found = live.get("/sweeps/mine/curves").json()
    assert list(found["trials"]) == ["t0000", "t0001", "t0002", "t0003"]
    for trial_id, curve in found["trials"].items():
        records = store.trial(trial_id).read_iterations()
        assert len(records) == 6
        for name in ("iteration", "num_env_steps", "training_return", "evaluation_return"):
            assert curve[name] == [getattr(record, name) for record in records]
    assert found["last_event_id"]


def test_long_curves_are_thinned_to_their_ends_and_their_best(live: Live, store: SweepStore) -> None:
    trial = store.trial("t0000")
    trial.append_iterations(
        [iteration(number, evaluation_return=500.0 if number == 678 else 1.0 if number % 5 == 0 else None)
         for number in range(7, 1_001)]
    )  # fmt: skip
    curves = live.get("/sweeps/mine/curves", params={"points": 20}).json()["trials"]
    curve = curves["t0000"]
    assert len(curve["iteration"]) <= 20
    assert (curve["iteration"][0], curve["iteration"][-1]) == (1, 1_000)
    assert 678 in curve["iteration"]
    assert curve["iteration"] == sorted(set(curve["iteration"]))
    assert sum(value is not None for value in curve["evaluation_return"]) >= 9
    assert len({len(column) for column in curve.values()}) == 1
    assert len(curves["t0001"]["iteration"]) == 6
    assert live.get("/sweeps/mine/curves", params={"points": 1}).status_code == 422


# -- events


def test_who_begins_is_told_how_it_is_now(live: Live, store: SweepStore) -> None:
    job, _ = live.service.queue.begin("mine", "drive", {}, owner="me")
    with live.events("/sweeps/mine/events") as reader:
        reader.wait_for(lambda: len(reader.events) == 2)
        assert reader.of("status")[0].data["name"] == "mine"
        assert reader.of("status")[0].data == live.get("/sweeps/mine").json()
        assert reader.of("job")[0].data["uid"] == job.uid
        assert reader.last_id


def test_what_is_appended_comes_once_and_in_order(live: Live, store: SweepStore) -> None:
    with live.events("/sweeps/mine/events") as reader:
        for number in range(7, 27):
            store.trial("t0000").append_iterations([iteration(number, training_return=number / 3)])
            time.sleep(0.05)
        reader.wait_for(lambda: rows_of(reader)[-1:] == [26])
    assert rows_of(reader) == list(range(7, 27))
    known = 6
    for event in reader.of("iterations"):
        rows = event.data["trials"]["t0000"]
        assert rows["after"] == known
        assert rows["training_return"] == [number / 3 for number in rows["iteration"]]
        known = rows["iteration"][-1]
    # Several iterations came at once: clients are not sent each by itself.
    assert len(reader.of("iterations")) < 20


def test_records_that_change_come_as_they_are_listed(live: Live, store: SweepStore) -> None:
    with live.events("/sweeps/mine/events") as reader:
        reader.wait_for(lambda: reader.of("status"))
        trial = store.trial("t0000")
        trial.write_record(trial.read_record().model_copy(update={"status": "failed", "error": "no room"}))
        reader.wait_for(lambda: reader.of("trials"))
        (row,) = reader.of("trials")[0].data["trials"]
        assert row == live.get("/sweeps/mine/trials/t0000").json()
        assert (row["status"], row["error"], row["score"]) == ("failed", "no room", None)
        # What follows from it is told too.
        reader.wait_for(lambda: reader.of("status")[-1].data["counts"] == {"failed": 1, "completed": 3})


def test_jobs_and_labels_come(live: Live, store: SweepStore) -> None:
    with live.events("/sweeps/mine/events") as reader:
        reader.wait_for(lambda: reader.of("status"))
        job, _ = live.service.queue.begin("mine", "extend", {"to_num_samples": 3}, owner="me")
        live.service.labels.change("mine", note="look at this")
        reader.wait_for(lambda: reader.of("status")[-1].data["note"] == "look at this" and reader.of("job"))
        assert reader.of("job")[0].data["id"] == job.id
        assert reader.of("status")[-1].data["job"]["state"] == "waiting"
        live.service.queue.request_stop("mine")
        reader.wait_for(lambda: reader.of("job")[-1].data["outcome"] == "cancelled")


def test_a_trial_that_goes_back_to_its_checkpoint_says_so(live: Live, store: SweepStore) -> None:
    trial = store.trial("t0000")
    with live.events("/sweeps/mine/events") as reader:
        trial.append_iterations([iteration(7), iteration(8)])
        reader.wait_for(lambda: rows_of(reader) == [7, 8])
        trial.keep_iterations(trial.read_iterations()[:2])
        trial.append_iterations([iteration(3, training_return=-5.0)])
        reader.wait_for(lambda: rows_of(reader)[-1] == 3)
    # Whatever came in between, a client that drops what is later than `after` has what is there.
    known: dict[int, Any] = {}
    for event in reader.of("iterations"):
        rows = event.data["trials"]["t0000"]
        known = {number: value for number, value in known.items() if number <= rows["after"]}
        known |= dict(zip(rows["iteration"], rows["training_return"], strict=True))
    assert list(known) == [1, 2, 3]
    assert known[3] == -5.0
    assert live.get("/sweeps/mine/curves").json()["trials"]["t0000"]["iteration"] == [1, 2, 3]


def test_curves_and_the_events_after_them_are_all(live: Live, store: SweepStore) -> None:
    """While a trial reports, whoever asks for the curves and follows from there misses nothing."""
    over = threading.Event()

    def train() -> None:
        number = 6
        while not over.wait(0.01):
            number += 1
            store.trial("t0000").append_iterations([iteration(number)])

    thread = threading.Thread(target=train)
    thread.start()
    try:
        for _ in range(3):
            time.sleep(0.4)
            found = live.get("/sweeps/mine/curves", params={"points": 10_000}).json()
            with live.events(f"/sweeps/mine/events?last_event_id={found['last_event_id']}") as reader:
                reader.wait_for(lambda: len(reader.of("iterations")) >= 2)
            seen = found["trials"]["t0000"]["iteration"] + rows_of(reader)
            assert seen == list(range(1, len(seen) + 1))
    finally:
        over.set()
        thread.join()


# -- coming back


def test_who_comes_back_gets_what_came_meanwhile(live: Live, store: SweepStore) -> None:
    with live.events("/sweeps/mine/events") as first:
        store.trial("t0000").append_iterations([iteration(7)])
        first.wait_for(lambda: rows_of(first) == [7])
    store.trial("t0000").append_iterations([iteration(8)])
    with live.events("/sweeps/mine/events") as other:
        other.wait_for(lambda: rows_of(other) == [8])
    with live.events("/sweeps/mine/events", last_id=first.last_id) as second:
        second.wait_for(lambda: rows_of(second) == [8])
        store.trial("t0000").append_iterations([iteration(9)])
        second.wait_for(lambda: rows_of(second) == [8, 9])
        assert not second.of("reset")
    # A query parameter does the same, for a first request.
    with live.events(f"/sweeps/mine/events?last_event_id={first.last_id}") as third:
        third.wait_for(lambda: rows_of(third) == [8, 9])


@pytest.mark.parametrize("last_id", ["", "x", "x-1", "-5", "{start}-0", "{start}-99999999999999999999", "{start}-²"])
def test_an_id_that_means_nothing_gives_a_reset(live: Live, store: SweepStore, last_id: str) -> None:
    start = live.get("/sweeps/mine/curves").json()["last_event_id"].partition("-")[0]
    query = httpx2.QueryParams({"last_event_id": last_id.format(start=start)})
    with live.events(f"/sweeps/mine/events?{query}") as reader:
        reader.wait_for(lambda: reader.events)
        assert reader.events[0].kind == ("status" if not last_id else "reset")
        store.trial("t0000").append_iterations([iteration(7)])
        reader.wait_for(lambda: rows_of(reader) == [7])


def test_a_service_that_began_anew_gives_a_reset(tmp_path: Path) -> None:
    storage = tmp_path / "sweeps"
    with running(storage / "mine") as store, serving(storage) as one, one.events("/sweeps/mine/events") as reader:
        store.trial("t0000").append_iterations([iteration(7)])
        reader.wait_for(lambda: rows_of(reader) == [7])
    with serving(tmp_path / "sweeps") as second, second.events("/sweeps/mine/events", reader.last_id) as again:
        again.wait_for(lambda: again.events)
        assert again.events[0].kind == "reset"
        assert not rows_of(again)


def test_a_sweep_that_nobody_watches_is_followed_no_more(
    live: Live, store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "LINGER_S", 0.2)
    with live.events("/sweeps/mine/events") as reader:
        store.trial("t0000").append_iterations([iteration(7)])
        reader.wait_for(lambda: rows_of(reader) == [7])
        time.sleep(1.0)
        assert threads_of("mine") == 1
    wait_until(lambda: not threads_of("mine"))
    with live.events("/sweeps/mine/events", reader.last_id) as again:
        again.wait_for(lambda: again.of("reset"))


def threads_of(name: str) -> int:
    return sum(thread.name == f"watch sweep {name}" for thread in threading.enumerate())


# -- many clients, slow ones, and the end


def test_a_hundred_idle_streams_are_one_thread(live: Live, store: SweepStore) -> None:
    streams = [open_stream(live) for _ in range(100)]
    try:
        wait_until(lambda: live.service.watching.num_watchers == 100)
        assert threads_of("mine") == 1
        before = threading.active_count()
        store.trial("t0000").append_iterations([iteration(7)])
        for stream in streams:
            read_until(stream, b'"iteration":[7]')
        assert threading.active_count() <= before
        assert live.get("/sweeps").status_code == 200
    finally:
        for stream in streams:
            stream.close()
    wait_until(lambda: live.service.watching.num_watchers == 0)


def open_stream(live: Live) -> socket.socket:
    host = live.url.removeprefix("http://")
    made = socket.create_connection(("127.0.0.1", int(host.rpartition(":")[2])), timeout=30)
    made.sendall(f"GET /api/v1/sweeps/mine/events HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    return made


def read_until(stream: socket.socket, wanted: bytes) -> None:
    found = b""
    while wanted not in found:
        more = stream.recv(65536)
        assert more, "the stream has ended"
        found += more


def test_a_client_that_does_not_read_is_dropped_and_no_one_waits_for_it(
    live: Live, store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_stream, "SLOW_S", 1.0)
    slow = open_stream(live)
    wait_until(lambda: live.service.watching.num_watchers == 1)
    trial = store.trial("t0000")
    record, number = trial.read_record(), 0
    with live.events("/sweeps/mine/events") as reader:
        while live.service.watching.num_watchers == 2:
            number += 1
            assert number < 200, "the slow one holds its place"
            # More at once than the buffers of a connection take.
            trial.write_record(record.model_copy(update={"error": f"{number} " + "x" * 2_000_000}))
            wait_until(functools.partial(has_told, reader, number))
    slow.close()
    assert told(reader) == list(range(1, number + 1))


def has_told(reader: EventReader, number: int) -> bool:
    return told(reader)[-1:] == [number]


def told(reader: EventReader) -> list[int]:
    """The numbers in the errors that came."""
    return [int(event.data["trials"][0]["error"].split()[0]) for event in reader.of("trials")]


def test_there_are_as_many_watchers_as_the_operator_lets(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "sweeps" / "mine")
    with serving(tmp_path / "sweeps", watchers=2) as live:
        with live.events("/sweeps/mine/events") as first, live.events("/events") as second:
            assert (first.status, second.status) == (200, 200)
            refused = live.get("/sweeps/mine/events")
            assert refused.status_code == 429
            assert refused.headers["content-type"] == "application/problem+json"
            assert "2 clients watch" in refused.json()["detail"]
            assert int(refused.headers["retry-after"]) > 0
        wait_until(lambda: live.service.watching.num_watchers == 0)
        with live.events("/sweeps/mine/events") as third:
            assert third.status == 200


def test_streams_end_when_the_service_does(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "sweeps" / "mine")
    with (
        serving(tmp_path / "sweeps") as live,
        live.events("/sweeps/mine/events") as one,
        live.events("/events") as other,
    ):
        live.server.should_exit = True
        for reader in (one, other):
            assert reader.has_ended.wait(20)
            # Else the server has given up waiting, and cut the connection.
            assert reader.error is None
        live.thread.join(20)
        assert not live.thread.is_alive()
    assert not threads_of("mine")


def test_who_hears_nothing_hears_that_the_stream_lives(
    live: Live, store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_stream, "HEARTBEAT_S", 0.1)
    with live.events("/sweeps/mine/events") as reader:
        reader.wait_for(lambda: reader.comments > 3)


def test_a_sweep_that_is_deleted_is_the_end(live: Live) -> None:
    make_sweep_folder(live.storage / "mine")
    with live.events("/sweeps/mine/events") as reader:
        reader.wait_for(lambda: reader.of("status"))
        assert httpx2.delete(f"{live.url}/api/v1/sweeps/mine").status_code == 204
        assert reader.has_ended.wait(10)
        assert reader.events[-1].kind == "deleted"
    answer = live.get("/sweeps/mine/events")
    assert answer.status_code == 404
    # Another one of that name is another one.
    make_sweep_folder(live.storage / "mine")
    with live.events("/sweeps/mine/events", reader.last_id) as again:
        again.wait_for(lambda: again.events)
        assert again.events[0].kind == "reset"


@pytest.mark.parametrize("what", ["curves", "events"])
@pytest.mark.parametrize("name", ["nothing", "%2e%2e", "a%2Fb", "x" * 300])
def test_there_is_nothing_of_an_unknown_sweep(live: Live, name: str, what: str) -> None:
    answer = live.get(f"/sweeps/{name}/{what}")
    assert answer.status_code == 404
    assert answer.json()["status"] == 404
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("watch sweep")]


# -- the list


def test_the_list_of_sweeps_is_followed(live: Live) -> None:
    make_sweep_folder(live.storage / "a")
    with live.events("/events") as reader:
        wait_until(lambda: reader.last_id)
        assert not reader.events
        make_sweep_folder(live.storage / "b", iterations=1)
        reader.wait_for(lambda: reader.of("sweeps"))
        assert [item["name"] for event in reader.of("sweeps") for item in event.data["sweeps"]][-1] == "b"
        live.service.labels.change("a", tags=["x"])
        reader.wait_for(lambda: reader.of("sweeps")[-1].data["sweeps"][0]["tags"] == ["x"])
        assert [item["name"] for item in reader.of("sweeps")[-1].data["sweeps"]] == ["a"]
        assert httpx2.delete(f"{live.url}/api/v1/sweeps/a").status_code == 204
        reader.wait_for(lambda: reader.of("deleted"))
        assert reader.of("deleted")[0].data == {"names": ["a"]}
    with live.events("/events", reader.last_id) as again:
        time.sleep(1.5)
        assert not again.of("reset")
