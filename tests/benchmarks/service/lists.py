"""How soon lists are there: 10,000 trials of one sweep, and 1,000 sweeps after a restart."""

from __future__ import annotations

import itertools
import statistics
import tempfile
import time
from pathlib import Path

import httpx2
from page_sweeps import write_large, write_sweep
from served import Served
from synthetic_sweep import make_sweep

NUM_REQUESTS = 400
NUM_SWEEPS = 1_000
SORTS = ("score", "lr", "trial_id", "num_env_steps", "activation")


def rows(repeats: int) -> list[tuple[str, str, str]]:
    """Measure both."""
    return [*_trials(), *_restart(repeats)]


def _trials() -> list[tuple[str, str, str]]:
    with tempfile.TemporaryDirectory() as name:
        storage = Path(name) / "sweeps"
        storage.mkdir()
        write_large(storage)
        served = Served(storage, "--spare-idle", "0")
        try:
            with httpx2.Client(base_url=f"{served.url}/api/v1", timeout=60) as client:
                _timed(client, "score", "desc")
                orders = itertools.cycle(itertools.product(SORTS, ("asc", "desc")))
                times = sorted(_timed(client, *next(orders)) for _ in range(NUM_REQUESTS))
                whole = statistics.median(_whole_list(client) for _ in range(5))
        finally:
            served.end()
    p99 = times[int(0.99 * len(times))]
    return [
        ("a page of 100 of 10,000 trials, sorted: p99", f"{p99 * 1e3:.0f} ms", "100 ms"),
        ("  median", f"{statistics.median(times) * 1e3:.0f} ms", ""),
        ("  all 10,000 in ten pages", f"{whole * 1e3:.0f} ms", ""),
    ]


def _timed(client: httpx2.Client, sort: str, order: str) -> float:
    begin = time.perf_counter()
    answer = client.get("/sweeps/large/trials", params={"sort": sort, "order": order, "limit": 100})
    assert len(answer.raise_for_status().json()["trials"]) == 100
    return time.perf_counter() - begin


def _whole_list(client: httpx2.Client) -> float:
    begin, cursor, found = time.perf_counter(), None, 0
    while True:
        query = {"limit": 1_000} | ({} if cursor is None else {"cursor": cursor})
        page = client.get("/sweeps/large/trials", params=query).raise_for_status().json()
        found += len(page["trials"])
        cursor = page["next_cursor"]
        if cursor is None:
            break
    assert found == 10_000
    return time.perf_counter() - begin


def _restart(repeats: int) -> list[tuple[str, str, str]]:
    with tempfile.TemporaryDirectory() as name:
        storage = Path(name) / "sweeps"
        points = [{"lr": 10.0**-power} for power in range(2, 6)]
        for index in range(NUM_SWEEPS):
            write_sweep(storage, make_sweep(name=f"s{index:04d}", points=points, max_steps=5_000, with_best=False))
        times = []
        for _ in range(repeats + 1):
            begin = time.perf_counter()
            served = Served(storage, "--spare-idle", "0")
            try:
                answer = httpx2.get(f"{served.url}/api/v1/sweeps?limit=1000", timeout=60)
                assert len(answer.raise_for_status().json()["sweeps"]) == NUM_SWEEPS
                times.append(time.perf_counter() - begin)
            finally:
                served.end()
    # The first start makes the database.
    return [
        (f"{NUM_SWEEPS:,} sweeps: restart to the whole list", f"{statistics.median(times[1:]):.1f} s", "3 s"),
    ]
