"""How much of the driver a cluster uses that is not at hand, by costs that were measured on one that is.

The driver of a sweep is one process, which handles one event after another: a trial's start and end, and its reports.
A process that trains waits for the driver after each report, and for its next trial. So the model is a queue with one
server and as many customers as trials run at once (`used`); `fitted` finds the costs of a trial and of a report by
least squares. `python -m tests.benchmarks.cluster.model FILE` prints the table of
docs/guides/large-clusters.md from what `python -m tests.benchmarks --only cluster --save FILE` measured, and the costs
on standard error.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.benchmarks.cluster.measured import Driven

CORES_A_NODE = 8
NUM_NODES = (1, 10, 100, 1_000)
MOST_PLACEMENT_GROUPS = 1_000
"""At once, in Ray's table of what it is tested with; each single trial has one, and so has each pack."""
MOST_PUTS_PER_S = 3_500.0
"""Of one prefix of S3, before it begins to refuse some."""


@dataclass(frozen=True)
class Costs:
    """CPU seconds, of the driver where nothing else is said."""

    sweep_s: float
    trial_s: float
    """Its start and its end."""
    report_s: float
    gcs_s: float
    """Of Ray's control process, for a trial."""
    requests: float
    """To the object store for a trial, by all processes."""


@dataclass(frozen=True)
class Load:
    """What runs on a cluster: trials of one length, on all cores, one after another."""

    num_at_once: int
    work_s: float
    """Of a trial."""
    reports: int
    """Of a trial."""


@dataclass(frozen=True)
class Outcome:
    """What the driver is used for, once as many trials run as can."""

    trials_per_s: float
    driver_share: float
    """Of one core."""
    speed: float
    """Trials a second, as a share of what they would be with a driver that takes no time."""


def fitted(measured: Sequence[Driven], *, requests: float) -> Costs:
    """Return the costs that fit the measured sweeps best, relative to each; none is below 0.

    Args:
        measured: Sweeps of single trials; they differ in the number of trials and in the number of reports.
        requests: To the object store for a trial.

    Raises:
        ValueError: There are fewer than three.
    """
    if len(measured) < 3:
        raise ValueError(f"{len(measured)} sweeps do not tell three costs apart; measure at least 3.")
    rows = np.array([[1.0, item.num_trials, item.num_reports] for item in measured])
    wanted = np.array([item.launch_cpu_s for item in measured])
    rows, wanted = rows / wanted[:, None], np.ones(len(measured))
    seen = [0, 1, 2]
    while True:
        found = np.linalg.lstsq(rows[:, seen], wanted, rcond=None)[0]
        if (found >= 0).all():
            break
        # One cost that is too small to be seen; the others are fitted without it.
        seen.pop(int(np.argmin(found)))
    costs = dict.fromkeys(range(3), 0.0) | dict(zip(seen, (float(value) for value in found), strict=True))
    gcs_s = sum(item.daemons_cpu_s.get("gcs_server", 0.0) for item in measured)
    return Costs(costs[0], costs[1], costs[2], gcs_s / sum(item.num_trials for item in measured), requests)


def predicted_cpu_s(costs: Costs, num_trials: int, num_reports: int) -> float:
    """Return the driver's CPU seconds for a sweep."""
    return costs.sweep_s + num_trials * costs.trial_s + num_reports * costs.report_s


def used(costs: Costs, load: Load) -> Outcome:
    """Return what the driver is used for, by exact mean value analysis of the closed queue.

    Its customers are the trials that run; the time between two reports, and what the driver takes for one, are
    exponentially distributed, which is the less kind assumption for those who wait.
    """
    piece_s = load.work_s / load.reports
    takes_s = costs.report_s + costs.trial_s / load.reports
    queue = reports_per_s = 0.0
    for number in range(1, load.num_at_once + 1):
        # Who comes finds the queue as it is without it.
        answered_s = takes_s * (1 + queue)
        reports_per_s = number / (piece_s + answered_s)
        queue = reports_per_s * answered_s
    return Outcome(reports_per_s / load.reports, reports_per_s * takes_s, reports_per_s * piece_s / load.num_at_once)


def limits(costs: Costs, load: Load, outcome: Outcome) -> list[str]:
    """Name what such a sweep is beyond, the worst first; empty: nothing."""
    shares = {
        "the driver": outcome.driver_share / 0.9,
        "Ray's placement groups": load.num_at_once / MOST_PLACEMENT_GROUPS,
        "Ray's control process": outcome.trials_per_s * costs.gcs_s,
        "requests to one prefix of S3": outcome.trials_per_s * costs.requests / MOST_PUTS_PER_S,
    }
    return [name for name, share in sorted(shares.items(), key=lambda item: -item[1]) if share > 1]


def table(costs: Costs, work_s: Sequence[float] = (3.0, 60.0, 600.0)) -> str:
    """Return the table in Markdown: single trials, one on each core, that report once a second at most."""
    lines = [
        "| nodes x 8 cores | a trial's work | trials/s | share of the driver | speed kept | beyond |",
        "|---|---|---|---|---|---|",
    ]
    for num_nodes in NUM_NODES:
        for seconds in work_s:
            load = Load(num_nodes * CORES_A_NODE, seconds, max(1, round(seconds)))
            outcome = used(costs, load)
            beyond = ", ".join(limits(costs, load, outcome)) or "-"
            lines.append(
                f"| {num_nodes:,} | {seconds:g} s | {outcome.trials_per_s:.1f} | {outcome.driver_share:.0%} | "
                f"{outcome.speed:.0%} | {beyond} |"
            )
    return "\n".join(lines)


def read(path: Path) -> Costs:
    """Return the costs that fit a file of measured sweeps."""
    items = json.loads(path.read_text(encoding="utf-8"))["sweeps"]
    found: dict[str, list[Driven]] = {}
    for item in items:
        found.setdefault(item["kind"], []).append(Driven(**item["driven"]))
    in_objects = found.get("objects", [])
    requests = max((sum(item.num_requests.values()) / item.num_trials for item in in_objects), default=0.0)
    return fitted(found["single"], requests=requests)


if __name__ == "__main__":
    measured_costs = read(Path(sys.argv[1]))
    print(measured_costs, file=sys.stderr)
    print(table(measured_costs))
