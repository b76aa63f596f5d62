"""Of several receivers, one that is dead or slow keeps the others from being told for a moment alone."""

import json
from typing import Any

import pytest
from databases import database_url, postgresql  # noqa: F401 (fixtures)
from sqlalchemy import Engine
from test_service_telling import Clock, engine  # noqa: F401 (a fixture)

from tune_jobs.service import telling
from tune_jobs.service.telling import Teller

# ruff: noqa: F811 - fixtures are named as arguments

SLOW, LIVING = "http://slow.example/", "http://living.example/"


def patient(monkeypatch: pytest.MonkeyPatch, clock: Clock, how: dict[str, tuple[float, str | None]]) -> list[Any]:
    """Let targets take so many seconds for a message, and say so; returns what was sent where."""
    sent: list[Any] = []

    def send(_: Teller, message_id: str, event: str, target: str, body: str) -> str | None:
        took_s, error = how[target]
        clock.at += took_s
        sent.append((target, json.loads(body)["data"]["number"], clock.at))
        return error

    monkeypatch.setattr(Teller, "_sent", send)
    return sent


def test_a_dead_receiver_holds_the_others_up_for_one_timeout(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    teller = Teller(engine, [SLOW, LIVING], now=clock)
    for number in range(50):
        teller.tell("sweep.best", {"number": number})
        clock.at += 0.001
    began, timeout_s = clock.at, telling._TIMEOUT_S
    sent = patient(monkeypatch, clock, {SLOW: (timeout_s, "timed out"), LIVING: (0.0, None)})
    rounds = 0
    while sum(target == LIVING for target, _, _ in sent) < 50:
        teller.send_due()
        rounds += 1
        assert clock.at < began + 2 * timeout_s
    assert rounds == 1
    assert [number for target, number, _ in sent if target == LIVING] == list(range(50))
    teller.send_due()
    # What was left is tried in the next round, in its order.
    assert [number for target, number, _ in sent if target == SLOW] == [0, 1]


def test_a_receiver_that_is_slow_holds_the_others_up_for_two(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    teller = Teller(engine, [SLOW, LIVING], now=clock)
    for number in range(20):
        teller.tell("sweep.best", {"number": number})
    began = clock.at
    sent = patient(monkeypatch, clock, {SLOW: (0.9 * telling._TIMEOUT_S, None), LIVING: (0.0, None)})
    assert teller.send_due() == 22
    assert max(at for target, _, at in sent if target == LIVING) <= began + 2 * telling._TIMEOUT_S
    while teller.send_due():
        pass
    assert sorted(number for target, number, _ in sent if target == SLOW) == list(range(20))


def test_what_one_receiver_has_not_got_hides_nothing_of_another(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    dead = Teller(engine, [SLOW], now=clock)
    for number in range(120):
        dead.tell("sweep.best", {"number": number})
        clock.at += 0.001
    both = Teller(engine, [SLOW, LIVING], now=clock)
    both.tell("sweep.best", {"number": 120})
    patient(monkeypatch, clock, {SLOW: (0.0, "refused"), LIVING: (0.0, None)})
    assert both.send_due() == 1
