"""Whole records over HTTP: numbers that JSON lacks arrive as texts, in every part of them."""

import json
import math
from typing import Any

import pytest
from live_service import Live, live  # noqa: F401 (a fixture)
from store_parts import make_best
from sweep_folders import chosen, make_sweep_folder

from policies.errors import SpecError
from tune_jobs.client.client import Client
from tune_jobs.store.sweep_store import SweepStore

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def odd(live: Live) -> SweepStore:
    """A sweep whose best has an endless score, and two trials of which one has none that is a number."""
    store = make_sweep_folder(live.storage / "odd")
    store.write_best(make_best(**chosen(store), selection_score=math.inf))
    for trial_id, value in {"t0001": math.nan, "t0002": -math.inf}.items():
        trial = store.trial(trial_id)
        trial.write_record(trial.read_record().model_copy(update={"evaluation_return": value, "time_s": value}))
    return store


def strictly(text: str) -> Any:
    """What JSON says, which knows no NaN and no Infinity."""

    def refuse(name: str) -> None:
        raise SpecError(f"{name} is no JSON.")

    return json.loads(text, parse_constant=refuse)


def test_a_score_that_is_no_number_is_a_text_in_records_and_nothing_in_tables(live: Live, odd: SweepStore) -> None:
    status = strictly(live.get("/sweeps/odd/status").text)
    # Where it is concerns the machine of the service alone.
    assert "place" not in status
    assert (status["best"]["trial_id"], status["best"]["score"]) == ("t0003", "Infinity")
    (same,) = strictly(live.get("/statuses").text)["statuses"]
    assert same == status
    assert strictly(live.get("/sweeps/odd").text)["best"]["score"] is None
    records = strictly(live.get("/sweeps/odd/records").text)
    assert [record["time_s"] for record in records][1:3] == ["NaN", "-Infinity"]
    rows = {row["trial_id"]: row for row in strictly(live.get("/sweeps/odd/trials").text)["trials"]}
    assert (rows["t0001"]["time_s"], rows["t0002"]["time_s"]) == (None, None)


def test_the_client_has_the_number_again(live: Live, odd: SweepStore) -> None:
    best = Client(live.url).status("odd").best
    assert best is not None
    assert best.score == math.inf


def test_trials_are_sorted_by_what_may_be_no_number(live: Live, odd: SweepStore) -> None:
    found, cursor = [], None
    while True:
        query = {"sort": "time_s", "limit": "1"} | ({} if cursor is None else {"cursor": cursor})
        page = live.get("/sweeps/odd/trials", params=query).json()
        found += [row["trial_id"] for row in page["trials"]]
        cursor = page["next_cursor"]
        if cursor is None:
            break
    assert sorted(found) == ["t0000", "t0001", "t0002", "t0003"]
    # What is no number comes last.
    assert found[2:] == ["t0002", "t0001"]
