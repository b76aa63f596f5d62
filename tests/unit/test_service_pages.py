"""Pages of lists that are sorted by long texts: each cursor is taken, and all items come once, in order."""

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.http.pages import MAX_CURSOR, page_of
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


def all_pages(items: dict[str, Any], *, descending: bool, limit: int = 2) -> list[str]:
    found, cursor, longest = [], None, 0
    while True:
        page, cursor = page_of(
            items, key=items.__getitem__, identity=str, descending=descending, cursor=cursor, limit=limit
        )
        found += page
        if cursor is None:
            assert longest <= MAX_CURSOR
            return found
        longest = max(longest, len(cursor))


@pytest.mark.parametrize("descending", [False, True])
@pytest.mark.parametrize(
    "letter", ["x", "\x01", '"', "\N{GRINNING FACE}", "\udcff"], ids=["ascii", "control", "quote", "wide", "half"]
)
def test_items_come_once_and_in_order_however_long_their_texts_are(letter: str, *, descending: bool) -> None:
    texts = [letter * length + end for length in (1, 150, 198, 5_000) for end in ("", "a", "b")]
    items = {f"item {number}": text for number, text in enumerate(texts)} | {"none": None, "number": 3.5}
    found = all_pages(items, descending=descending)
    assert sorted(found) == sorted(items)
    assert found == all_pages(items, descending=descending, limit=100)
    known = [str(items[name]) for name in found if name not in ("none", "number")]
    # What differs within the first 200 characters is in order.
    assert [text[:200] for text in known] == sorted((text[:200] for text in texts), reverse=descending)


def test_texts_that_begin_alike_are_told_apart_when_others_come_between_two_pages() -> None:
    items = {name: "x" * 300 + name for name in "abcdef"}
    whole = all_pages(items, descending=False)
    first, cursor = page_of(items, key=items.__getitem__, identity=str, descending=False, cursor=None, limit=3)
    # The last one of the page is gone, and one has come.
    later = {name: text for name, text in items.items() if name != first[-1]} | {"new": "x" * 300 + "new"}
    rest, end = page_of(later, key=later.__getitem__, identity=str, descending=False, cursor=cursor, limit=100)
    assert end is None
    assert [name for name in rest if name != "new"] == whole[3:]


def test_the_longest_name_of_a_folder_fits_into_a_cursor() -> None:
    items = {letter * 254 + end: letter * 254 + end for letter in "\x01" for end in "ab"}
    assert all_pages(items, descending=False, limit=1) == sorted(items)


def test_failed_trials_are_listed_by_why_they_failed_page_by_page(client: TestClient, service: Service) -> None:
    store = make_sweep_folder(Path(service.config.storage) / "mine")
    for number, trial_id in enumerate(("t0000", "t0001", "t0002", "t0003")):
        trial = store.trial(trial_id)
        error = (
            "Traceback\n" + '  File "env.py", line 1 \N{LATIN SMALL LETTER O WITH DIAERESIS}\n' * 200 + str(number % 2)
        )
        trial.write_record(trial.read_record().model_copy(update={"status": "failed", "error": error}))
    found, cursor = [], None
    for _ in range(4):
        query = {"sort": "error", "limit": "1"} | ({} if cursor is None else {"cursor": cursor})
        answer = client.get("/api/v1/sweeps/mine/trials", params=query)
        assert answer.status_code == 200, answer.text
        found += [row["trial_id"] for row in answer.json()["trials"]]
        cursor = answer.json()["next_cursor"]
    assert cursor is None
    assert sorted(found) == ["t0000", "t0001", "t0002", "t0003"]
