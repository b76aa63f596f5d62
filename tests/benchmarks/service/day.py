"""A day of a service with a submission a minute, at speed: its memory, and whether every sweep ran once."""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from fake_driver import JOURNAL
from served import Served

from tests.benchmarks.service import simulated

ROOT = Path(__file__).parents[3]
SPEED = 120
KEPT = 100
"""So many finished sweeps are left; older ones are deleted, as a person who tidies up does."""
SPEC = {"env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-4, 1e-2]}}, "num_samples": 4}


def rows(hours: float) -> list[tuple[str, str, str]]:
    """Simulate it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "sweeps"
        path = f"{ROOT}:{ROOT / 'tests' / 'unit'}"
        served = Served(
            folder, "--spare-idle", "600", command=[sys.executable, "-m", simulated.__name__, "serve"],
            variables={"PYTHONPATH": path, simulated.SPEED: str(SPEED)},
        )  # fmt: skip
        try:
            names, memory = _submit_all(served, hours)
            served.wait(lambda: not _unended(served), "some sweeps never end")
            outcomes = Counter(job["outcome"] for job in served.ask("GET", "jobs"))
        finally:
            served.end()
        journal = [json.loads(line) for line in (folder / ".service" / JOURNAL).read_text().splitlines()]
    begun = Counter(line["sweep"] for line in journal if line["what"] == "begin")
    once = sum(begun[name] == 1 for name in names)
    fifth = max(1, len(memory) // 5)
    early, late = statistics.median(memory[fifth : 2 * fifth]), statistics.median(memory[-fifth:])
    return [
        (f"{hours:g} h with a sweep a minute: each run once", f"{once:,} of {len(names):,}", "all"),
        ("  jobs that did not complete", f"{sum(outcomes.values()) - outcomes['completed']}", "0"),
        ("  memory, second fifth and last", f"{early / 2**20:.0f} and {late / 2**20:.0f} MiB", "the same"),
    ]


def _submit_all(served: Served, hours: float) -> tuple[list[str], list[int]]:
    begin = time.monotonic()
    names: list[str] = []
    memory: list[int] = []
    for minute in range(round(60 * hours)):
        time.sleep(max(0.0, begin + 60.0 * minute / SPEED - time.monotonic()))
        body: dict[str, Any] = {"spec": SPEC, "name": f"s{minute:04d}", "priority": minute % 3}
        names.append(served.ask("POST", "sweeps", body)["sweep"])
        memory.append(_resident_bytes(served.process.pid))
        if minute >= KEPT:
            _delete(served, names[minute - KEPT])
    return names, memory


def _resident_bytes(pid: int) -> int:
    """Memory of one process (Linux)."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _delete(served: Served, name: str) -> None:
    # Its job ends a moment after its record says so.
    served.wait(lambda: _ended(served, name), f"{name} never ends")
    served.ask("DELETE", f"sweeps/{name}?force=true")


def _ended(served: Served, name: str) -> bool:
    seen = served.ask("GET", f"sweeps/{name}")
    return bool(seen["state"] == "completed" and seen["job"]["state"] == "ended")


def _unended(served: Served) -> list[Any]:
    return list(served.ask("GET", "jobs?state=waiting&state=running&state=creating"))
