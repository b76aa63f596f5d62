"""SIGKILL of drivers, of training processes and of Ray's parts, several in one sweep, which goes on after each."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.faults.outcomes import Outcome
from tests.faults.sweeps import KINDS, Before, Disturbed, Sweep, spec, wait_for, wrong
from tests.kills.processes import Family

_GONE_S = 60.0
_LONGEST_DELAY_S = 3.0


def reference(folder: Path, kind: str, mark: str = "", **changes: Any) -> Sweep:
    """The undisturbed sweep of a kind, with settings changed, which `mark` names; it is run once."""
    place = folder / f"undisturbed-{kind}{mark}"
    place.mkdir(parents=True, exist_ok=True)
    # The files that the environment asks for, which are never there, are its own.
    sweep = Sweep(place, spec(kind, place, **changes))
    if not (sweep.place / "sweep.json").is_file() or any(r["status"] != "completed" for r in sweep.records()):
        found = sweep.end()
        if found:
            raise RuntimeError(f"The undisturbed sweep of kind {kind} failed: {found}")
    return sweep


def kill_drivers(folder: Path, kind: str, moments: list[str], rng: random.Random, undisturbed: Sweep) -> list[Outcome]:
    """Kill the driver of one sweep at these moments, one after the other; it is resumed each time, and checked.

    Args:
        folder: An empty folder.
        kind: Of sweep.
        moments: `checkpoint`, while one is being written, or `any`.
        rng: For the moments' delays.
        undisturbed: From `reference`.
    """
    # Packs and the processes that Ray starts for them are what a short cycle waits for: one is enough.
    sweep = Sweep(folder, spec(kind, folder), num_cpus=1 if kind in ("packed", "tpe") else 2)
    outcomes: list[Outcome] = []
    for moment in moments:
        sweep.slow.touch()
        started = time.monotonic()
        known = sum(sweep.newest(name) for name in sweep.trial_ids())
        process = sweep.begin()
        with Family(process.pid) as family:
            found: list[str] = []
            if not wait_for(_moment(sweep, moment, known), process):
                found.append(f"the moment never came: {sweep.said()}")
            if moment == "any":
                time.sleep(rng.uniform(0, _LONGEST_DELAY_S))
            if process.poll() is None:
                process.kill()
            process.wait()
            if family.wait_until_gone(_GONE_S) is None:
                found.append(f"still there {_GONE_S:g} s after the kill: {family.left}")
                family.kill_all()
        before = Before(sweep)
        outcome = Outcome(f"driver killed, {kind}", moment, found, recomputed=before.recomputed)
        outcome.check = before.problems
        outcome.seconds = time.monotonic() - started
        outcomes.append(outcome)
    _conclude(sweep, Disturbed(kind), undisturbed, outcomes, sweep.end())
    return outcomes


def _moment(sweep: Sweep, moment: str, known: int) -> Callable[[], bool]:
    def trains() -> bool:
        return sum(sweep.newest(name) for name in sweep.trial_ids()) > known

    if moment == "any":
        return trains
    return lambda: any(sweep.place.glob("trials/*/checkpoints/.*")) and (known > 0 or trains())


def kill_workers(folder: Path, kind: str, number: int, rng: random.Random, undisturbed: Sweep) -> list[Outcome]:
    """Kill training processes of one sweep at random, so many times; its driver goes on."""
    # Each kill counts against the retries of who was in the process.
    sweep = Sweep(folder, spec(kind, folder, max_retries=10 * number))
    sweep.slow.touch()
    outcomes: list[Outcome] = []
    process = sweep.begin()
    for _ in range(number):
        started = time.monotonic()
        known = {name: sweep.newest(name) for name in sweep.trial_ids()}
        victims: list[int] = []

        def training(known: dict[str, int] = known, victims: list[int] = victims) -> bool:
            victims[:] = [
                int(record["pid"])
                for record in sweep.records()
                if record["status"] == "running" and record["pid"] and _runs(record["pid"])
                and sweep.newest(record["trial_id"]) > known.get(record["trial_id"], 0)
            ]  # fmt: skip
            return bool(victims)

        if wait_for(training, process):
            time.sleep(rng.uniform(0, 1.0))
            before = Before(sweep)
            with contextlib.suppress(ProcessLookupError):
                os.kill(rng.choice(victims), signal.SIGKILL)
            outcome = Outcome(f"process killed, {kind}", "any", recomputed=before.recomputed)
            outcome.check = before.problems
        else:
            outcome = Outcome(f"process killed, {kind}", "any", [f"nothing trained: {sweep.said()}"])
        outcome.seconds = time.monotonic() - started
        outcomes.append(outcome)
    found = sweep.end(process)
    counted = sum(record["num_failures"] for record in sweep.records())
    if counted < number:
        found.append(f"{counted} failures are on record, after {number} kills")
    # A kill is a failure of each trial of the process, and no more.
    _conclude(sweep, Disturbed(kind, most_failures=number), undisturbed, outcomes, found)
    return outcomes


def _runs(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def two_resume(folder: Path, kind: str, undisturbed: Sweep) -> list[Outcome]:
    """Two drivers resume a killed sweep at once: one does, the other says so."""
    sweep = Sweep(folder, spec(kind, folder))
    sweep.slow.touch()
    outcome = Outcome(f"two resume at once, {kind}", "killed", [])
    started = time.monotonic()
    process = sweep.begin()
    wait_for(lambda: any(sweep.newest(name) for name in sweep.trial_ids()), process)
    process.kill()
    process.wait()
    before = Before(sweep)
    outcome.check = before.problems
    both = [sweep.begin(), sweep.begin()]
    # It goes on slowly until one of them was sent away: one that comes when the other is done has nothing to do.
    if not wait_for(lambda: both[1].poll() is not None, both[0], _GONE_S):
        wait_for(lambda: both[0].poll() is not None, both[1], _GONE_S)
    sweep.slow.unlink()
    codes = sorted(process.wait(600) for process in both)
    if codes != [0, 5]:
        outcome.problems.append(f"exit codes {codes}: {sweep.said()}")
    outcome.seconds = time.monotonic() - started
    _conclude(sweep, Disturbed(kind), undisturbed, [outcome], [])
    return [outcome]


def _conclude(sweep: Sweep, may: Disturbed, undisturbed: Sweep, outcomes: list[Outcome], found: list[str]) -> None:
    """Check the sweep after its end; what is wrong with it is a problem of its last fault."""
    for outcome in outcomes:
        if outcome.check is not None:
            outcome.problems += outcome.check()
    outcomes[-1].problems += found + wrong(sweep, undisturbed, may)


def kinds(only: str) -> tuple[str, ...]:
    """Those of these kinds, by commas; empty: all."""
    return tuple(kind for kind in KINDS if not only or kind in only.split(","))
