"""`python -m tests.faults`: bring about faults, so many of each, and check what they leave: a line each, then a table.

A run that is cut goes on where it was, by the file of outcomes in its folder; `--fresh` begins anew. Exit code 1 if a
fault left a problem.
"""

from __future__ import annotations

import argparse
import functools
import random
import re
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from tests.faults import kills, nodes, single
from tests.faults.outcomes import Outcome, Outcomes

_IN_ONE_SWEEP = 4


def main(arguments: list[str] | None = None) -> int:
    """Run with the command line's options."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--count", type=int, default=100, help="of the faults that are brought about at random moments")
    parser.add_argument("--only", default="", metavar="NAME,...", help=f"of {', '.join(SCENARIOS)}")
    parser.add_argument("--match", default="", metavar="TEXT", help="of the single faults those whose names have it")
    parser.add_argument("--kinds", default="", metavar="KIND,...", help="of sweeps: packed, rllib, pbt, tpe")
    parser.add_argument("--seed", type=int, default=12, help="of the moments")
    parser.add_argument("--folder", type=Path, default=Path("build/faults"), help="for sweeps and outcomes")
    parser.add_argument("--fresh", action="store_true", help="forget earlier outcomes")
    options = parser.parse_args(arguments)
    folder = options.folder.absolute()
    _matching[0] = options.match
    if options.fresh:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    # So that what is undone on the way out is undone: mounts, cables, nodes.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    outcomes = Outcomes(folder / "outcomes.jsonl")
    for name, scenario in SCENARIOS.items():
        if not options.only or name in options.only.split(","):
            scenario(folder, outcomes, options.count, kills.kinds(options.kinds), options.seed)
    print(outcomes.table())
    return 1 if outcomes.num_bad else 0


def _place(folder: Path, scenario: str, done: int) -> Path:
    """An empty folder for a sweep; what was cut before is begun anew."""
    place = folder / f"{re.sub(r'[^a-z]+', '-', scenario)}-{done}"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    return place


def _until(
    outcomes: Outcomes, folder: Path, scenario: str, count: int, act: Callable[[Path, int], list[Outcome]]
) -> None:
    """Do something again and again, until there are so many outcomes; the folder of a good one is removed."""
    while (done := outcomes.count(scenario)) < count:
        place = _place(folder, scenario, done)
        found = act(place, count - done)
        outcomes.add(found)
        if not any(outcome.problems for outcome in found):
            shutil.rmtree(place, ignore_errors=True)


def drivers(folder: Path, outcomes: Outcomes, count: int, kinds: tuple[str, ...], seed: int) -> None:
    """SIGKILL of drivers: a share of the count for each kind of sweep, half of them while a checkpoint is written."""
    for index, kind in enumerate(kinds):
        share = count // len(kinds) + (index < count % len(kinds))
        scenario = f"driver killed, {kind}"

        def act(place: Path, left: int, kind: str = kind, scenario: str = scenario) -> list[Outcome]:
            done = outcomes.count(scenario)
            rng = random.Random(f"{seed} {kind} {done}")
            moments = [("any", "checkpoint")[(done + i) % 2] for i in range(min(left, _IN_ONE_SWEEP))]
            return kills.kill_drivers(place, kind, moments, rng, kills.reference(folder, kind))

        _until(outcomes, folder, scenario, share, act)


def processes(folder: Path, outcomes: Outcomes, count: int, kinds: tuple[str, ...], seed: int) -> None:
    """SIGKILL of training processes, of packs and of single trials."""
    chosen = [kind for kind in kinds if kind in ("packed", "rllib")]
    for kind in chosen:
        scenario = f"process killed, {kind}"

        def act(place: Path, left: int, kind: str = kind, scenario: str = scenario) -> list[Outcome]:
            rng = random.Random(f"{seed} {kind} {outcomes.count(scenario)}")
            number = min(left, _IN_ONE_SWEEP)
            return kills.kill_workers(place, kind, number, rng, kills.reference(folder, kind))

        _until(outcomes, folder, scenario, count // len(chosen), act)


def resumes(folder: Path, outcomes: Outcomes, count: int, kinds: tuple[str, ...], seed: int) -> None:
    """Two drivers resume a sweep at once: a tenth of the count."""
    if "packed" not in kinds:
        return
    reference = functools.partial(kills.reference, folder)
    _until(
        outcomes, folder, "two resume at once, packed", max(1, count // 10),
        lambda place, _: kills.two_resume(place, "packed", reference("packed")),
    )  # fmt: skip


def single_faults(folder: Path, outcomes: Outcomes, _: int, kinds: tuple[str, ...], __: int) -> None:
    """Those that are brought about once, for packs and for single trials."""
    for kind in (kind for kind in kinds if kind in ("packed", "rllib")):
        for name, act in single.all_of(kind, functools.partial(kills.reference, folder, kind)).items():
            _once(outcomes, folder, name, act)


def cluster_faults(folder: Path, outcomes: Outcomes, _: int, kinds: tuple[str, ...], seed: int) -> None:
    """Those of a cluster's nodes."""
    for kind in (kind for kind in kinds if kind in ("packed", "rllib")):
        for name, act in nodes.all_of(folder, kind, seed).items():
            _once(outcomes, folder, name, act)


_matching = [""]


def _once(outcomes: Outcomes, folder: Path, name: str, act: Callable[[Path], Outcome]) -> None:
    if _matching[0] in name:
        _until(outcomes, folder, name, 1, lambda place, _: [act(place)])


SCENARIOS = {
    "drivers": drivers,
    "processes": processes,
    "resumes": resumes,
    "single": single_faults,
    "cluster": cluster_faults,
}


if __name__ == "__main__":
    sys.exit(main())
