"""Requests that take long: whoever sends many of them holds up neither others, nor the end of the service."""

import asyncio
import http.client
import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from live_service import Live, live, serving, wait_until  # noqa: F401 (a fixture)
from services import FAKE
from sweep_folders import make_sweep_folder

from tune_jobs.service.derived import Derived
from tune_jobs.service.http.models import NewSweep
from tune_jobs.service.turns import Turns
from tune_jobs.service.views import SweepView

# ruff: noqa: F811 - fixtures are named as arguments
MANY = 60
"""More than there are threads for requests."""


class Gate:
    """Holds those who come until it is opened, and knows how many did."""

    def __init__(self) -> None:
        self.opened, self.lock = threading.Event(), threading.Lock()
        self.num_came = self.num_inside = self.most_inside = 0

    def wait(self) -> None:
        with self.lock:
            self.num_came += 1
            self.num_inside += 1
            self.most_inside = max(self.most_inside, self.num_inside)
        self.opened.wait(60)
        with self.lock:
            self.num_inside -= 1


@pytest.fixture
def gate(live: Live, monkeypatch: pytest.MonkeyPatch) -> Iterator[Gate]:
    """What each planning waits for; it is of one sweep, whatever was asked for."""
    made, planned = Gate(), live.service.submitter._planned(NewSweep(spec=FAKE).submission())

    def slow(_: Any) -> Any:
        made.wait()
        return planned

    monkeypatch.setattr(live.service.submitter, "_planned", slow)
    yield made
    made.opened.set()


def ask(live: Live, method: str, path: str, body: Any = None, timeout_s: float = 30.0) -> tuple[int, Any, Any]:
    """The status, headers and body of an answer, on a connection of its own."""
    connection = http.client.HTTPConnection(live.url.removeprefix("http://"), timeout=timeout_s)
    try:
        content = None if body is None else json.dumps(body)
        connection.request(method, path, content, {"Content-Type": "application/json"})
        answer = connection.getresponse()
        return answer.status, answer.headers, json.loads(answer.read())
    finally:
        connection.close()


def plan(live: Live, timeout_s: float = 30.0) -> tuple[int, Any, Any]:
    return ask(live, "POST", "/api/v1/plans", {"spec": FAKE}, timeout_s)


def is_answered(live: Live) -> bool:
    return ask(live, "GET", "/api/v1/me", timeout_s=10)[0] == 200


# -- planning


@pytest.mark.parametrize("path", ["plans", "sweeps"])
def test_whoever_plans_much_leaves_threads_for_the_others(live: Live, gate: Gate, path: str) -> None:
    with ThreadPoolExecutor(MANY) as pool:
        try:
            asked = [pool.submit(ask, live, "POST", f"/api/v1/{path}", {"spec": FAKE}, 120) for _ in range(MANY)]
            wait_until(lambda: gate.num_came >= live.service.planning.of_one)
            assert is_answered(live)
            assert is_answered(live)
        finally:
            gate.opened.set()
        # All of them are done, one after the other.
        assert {answer.result()[0] for answer in asked} == {200 if path == "plans" else 201}
    assert gate.num_came == MANY
    assert gate.most_inside == live.service.planning.of_one


def test_who_waits_for_too_long_is_told_when_to_come_again(
    live: Live, gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live.service.planning, "wait_s", 0.3)
    with ThreadPoolExecutor(2) as pool:
        first = [pool.submit(plan, live) for _ in range(2)]
        wait_until(lambda: gate.num_came == 2)
        status, headers, body = plan(live)
        assert (status, headers["Retry-After"], body["status"]) == (429, "10", 429)
        assert "at most 2 of one person at once" in body["detail"]
        gate.opened.set()
        assert [answer.result()[0] for answer in first] == [200, 200]
    assert plan(live)[0] == 200
    assert gate.num_came == 3


def test_what_nobody_waits_for_any_more_is_not_planned(live: Live, gate: Gate) -> None:
    with ThreadPoolExecutor(2) as pool:
        first = [pool.submit(plan, live) for _ in range(2)]
        wait_until(lambda: gate.num_came == 2)
        for _ in range(20):
            with pytest.raises(TimeoutError):
                plan(live, timeout_s=0.05)
        wait_until(lambda: len(live.server.server_state.connections) == 2)
        gate.opened.set()
        assert [answer.result()[0] for answer in first] == [200, 200]
    assert plan(live)[0] == 200
    assert gate.num_came == 3


def test_who_waits_when_the_service_ends_is_told_so(live: Live, gate: Gate) -> None:
    with ThreadPoolExecutor(5) as pool:
        first = [pool.submit(plan, live) for _ in range(2)]
        wait_until(lambda: gate.num_came == 2)
        others = [pool.submit(plan, live) for _ in range(3)]
        wait_until(lambda: len(live.service.planning._waiting) == 3)
        live.server.should_exit = True
        for answer in others:
            status, headers, body = answer.result()
            assert (status, headers["Retry-After"]) == (503, "10")
            assert "The service is ending" in body["detail"]
        gate.opened.set()
        # What was begun is answered.
        assert [answer.result()[0] for answer in first] == [200, 200]
    assert gate.num_came == 2


def test_a_request_that_is_wrong_gives_its_turn_back(live: Live) -> None:
    for body in ({"spec": FAKE, "prioriti": 1}, {"spec": FAKE | {"env": "NoSuchEnv-v0"}}, {}):
        for _ in range(3):
            assert ask(live, "POST", "/api/v1/plans", body)[0] == 422
    assert plan(live)[0] == 200


# -- what is made of whole sweeps, and looked at


def ask_all(live: Live, pool: ThreadPoolExecutor, path: str) -> list[Future[int]]:
    """Ask for something many times at once; all requests are there when it returns."""
    asked = [pool.submit(lambda: live.get(path).status_code) for _ in range(MANY)]
    wait_until(lambda: len(live.server.server_state.connections) == MANY)
    return asked


@pytest.mark.parametrize(
    "path",
    [
        "/sweeps/a/importance", "/sweeps/a/what-mattered", "/sweeps/a/front", "/sweeps/a/trials.csv", "/sweeps/a/file",
        "/sweeps/a/records", "/comparison?source=a&source=b", "/comparisons?sweeps=a,b",
    ],
)  # fmt: skip
def test_whoever_asks_for_what_is_being_made_leaves_threads_for_the_others(
    live: Live, path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        make_sweep_folder(live.storage / name)
    assert live.get("/sweeps/b/importance").status_code == 200
    make, held = Derived._make, Gate()

    def slow(*args: Any) -> Any:
        held.wait()
        return make(*args)

    monkeypatch.setattr(Derived, "_make", slow)
    with ThreadPoolExecutor(MANY) as pool:
        try:
            asked = ask_all(live, pool, path)
            wait_until(lambda: held.num_came == 1)
            assert is_answered(live)
            # It is kept, and nothing has to be made for it.
            assert ask(live, "GET", "/api/v1/sweeps/b/importance", timeout_s=10)[0] == 200
        finally:
            held.opened.set()
        assert {answer.result() for answer in asked} == {200}
    assert held.num_came == 1


def test_whoever_asks_for_a_sweep_that_is_looked_at_leaves_threads_for_the_others(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_sweep_folder(live.storage / "a")
    changes, held = SweepView.changes, Gate()

    def slow(view: SweepView) -> Any:
        held.wait()
        return changes(view)

    monkeypatch.setattr(SweepView, "changes", slow)
    with ThreadPoolExecutor(MANY) as pool:
        try:
            asked = ask_all(live, pool, "/sweeps/a/curves")
            wait_until(lambda: held.num_came >= 1)
            assert is_answered(live)
            # Of many that come at once, one looks.
            assert held.num_came == 1
        finally:
            held.opened.set()
        assert {answer.result() for answer in asked} == {200}
    assert len(live.service.watching._watches) == 1


def test_a_stream_waits_for_no_later_look_at_its_sweep(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    make_sweep_folder(live.storage / "a")
    assert live.get("/sweeps/a/curves").status_code == 200
    changes, held = SweepView.changes, Gate()

    def slow(view: SweepView) -> Any:
        held.wait()
        return changes(view)

    monkeypatch.setattr(SweepView, "changes", slow)
    try:
        wait_until(lambda: held.num_inside == 1)
        with live.events("/sweeps/a/events") as events:
            wait_until(lambda: events.status == 200)
    finally:
        held.opened.set()


# -- turns


async def come(turns: Turns, who: str, came: list[str], leaves: asyncio.Event) -> bool:
    async with turns.turn(who) as turn:
        if turn.has_come:
            came.append(who)
            await leaves.wait()
        return turn.has_come


async def settled() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


def test_one_person_never_has_all_turns_and_the_first_who_may_is_next() -> None:
    async def run() -> None:
        turns, came = Turns(at_once=3, of_one=2), list[str]()
        leaves = [asyncio.Event() for _ in range(6)]
        asked = [
            asyncio.create_task(come(turns, who, came, leaf))
            for who, leaf in zip(["ann", "ann", "ann", "bob", "eve", "bob"], leaves, strict=True)
        ]
        await settled()
        assert came == ["ann", "ann", "bob"]
        leaves[3].set()
        await settled()
        # Before Bob's second; Ann has two.
        assert came[3:] == ["eve"]
        leaves[0].set()
        await settled()
        assert came[4:] == ["ann"]
        for leaf in leaves:
            leaf.set()
        assert all(await asyncio.gather(*asked))
        assert came == ["ann", "ann", "bob", "eve", "ann", "bob"]

    asyncio.run(asyncio.wait_for(run(), 20))


def test_a_turn_that_is_given_up_goes_to_the_next() -> None:
    async def run() -> None:
        turns, came, never, now = Turns(at_once=1, of_one=1), list[str](), asyncio.Event(), asyncio.Event()
        now.set()
        first, second = (asyncio.create_task(come(turns, who, came, never)) for who in ("ann", "bob"))
        await settled()
        third = asyncio.create_task(come(turns, "eve", came, now))
        await settled()
        # One that has its turn, and one that waits.
        for task in (second, first):
            task.cancel()
        assert await third
        assert came == ["ann", "eve"]
        # One that ends twice has ended once.
        async with turns.turn("ann") as turn:
            assert turn.has_come
            turn.end()
            other = asyncio.create_task(come(turns, "bob", came, never))
            await settled()
        late = asyncio.create_task(come(turns, "eve", came, now))
        await settled()
        assert came == ["ann", "eve", "bob"]
        other.cancel()
        assert await late

    asyncio.run(asyncio.wait_for(run(), 20))


# -- the end of the service


def test_the_service_drains_while_requests_have_all_its_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held, drained = Gate(), threading.Event()
    with serving(tmp_path / "sweeps") as live, ThreadPoolExecutor(MANY) as pool:
        monkeypatch.setattr(live.service.statuses, "see", lambda _: held.wait())

        def drain(_: float) -> bool:
            drained.set()
            return True

        monkeypatch.setattr(live.service.supervisor, "drain", drain)
        for _ in range(MANY):
            pool.submit(ask, live, "GET", "/api/v1/sweeps/mine/spec")
        try:
            wait_until(lambda: held.num_inside == 40)
            began = time.monotonic()
            live.server.should_exit = True
            assert drained.wait(30)
            assert time.monotonic() - began < 15
            assert held.num_inside == 40
        finally:
            held.opened.set()
