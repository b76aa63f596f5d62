"""What a sweep cost: env steps, core-seconds, wall time, and what early stopping saved."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from analysis.core_seconds import busy_cores, busy_seconds
from analysis.objectives import reached_goal
from analysis.page.source import Source
from analysis.records import TrialRecord, whole_length
from analysis.report_data import run_time_of
from analysis.wording import counted, duration, number

_ESTIMATED = (
    "Trials of a pack are trained by one process at once, so their own core-seconds are estimated: at any moment they "
    "share its cores by their env steps per second. Processes that step environments for a pack are not counted."
)
_FEW_STEPS = 100
"""Env steps a second below which their fractions are told."""


@dataclass(frozen=True)
class Cost:
    """What the section shows."""

    facts: list[tuple[str, str]]
    notes: list[str]


def section(source: Source) -> Cost:
    """Return what the section shows."""
    trials = [trial for trial in source.trials if trial.num_env_steps > 0]
    if not trials:
        return Cost([], [])
    total = sum(trial.num_env_steps for trial in trials)
    facts = [("env steps", f"{total:,} in {counted(len(trials), 'trial')}{_spread([t.num_env_steps for t in trials])}")]
    facts += _core_seconds(source, total)
    facts += _wall_time(source)
    facts += [("early stopping", text) for text in [_saved(source)] if text]
    return Cost(facts, _notes(source, trials))


def _core_seconds(source: Source, num_env_steps: int) -> list[tuple[str, str]]:
    costs = source.core_seconds
    if not costs:
        return [("core-seconds", "not known: the trials' records don't say when and where they ran")]
    total = sum(costs.values())
    text = f"{number(round(total))} in training{_spread([round(cost, 1) for cost in costs.values()])}"
    rows = [("core-seconds", text)]
    # Where some trials are not known, a rate would mix the one's env steps with the other's seconds.
    if total > 0 and len(costs) == sum(trial.num_env_steps > 0 for trial in source.trials):
        rate = num_env_steps / total
        text = number(rate if rate < _FEW_STEPS else round(rate))
        rows += [("speed", f"{text} env steps a core-second, evaluations included")]
    return rows


def _wall_time(source: Source) -> list[tuple[str, str]]:
    busy, total = busy_seconds(source.trials), source.sweep.run_time_s
    if not total > 0:
        return []
    if source.sweep.state == "running":
        # Its trials trained in this run too.
        return [("wall time", run_time_of(source.sweep))]
    text, cores = duration(total), busy_cores(source.trials, source.core_seconds)
    if cores:
        # Of all attempts, of which the records say when the latest ones were.
        busy = sum(source.core_seconds.values()) / cores
    if busy is not None and busy <= total:
        text += f", of which {duration(busy)} in training"
        if cores:
            text += f" with {cores:.1f} cores busy in the mean"
    return [("wall time", text)]


def _saved(source: Source) -> str:
    """Say what ending trials before their cap saved; empty: there is no cap, or no trial has ended."""
    cap = source.sweep.section("stop").get("num_env_steps")
    ended = [trial for trial in source.trials if trial.status in ("completed", "stopped")]
    if not isinstance(cap, int) or not ended:
        return ""
    most = source.sweep.max_iterations
    caps = {
        trial.trial_id: whole_length(trial.point, trial.hyperparams, num_env_steps=cap, num_iterations=most)
        for trial in ended
    }
    whole = sum(max(caps[trial.trial_id], trial.num_env_steps) for trial in ended)
    length = f"{cap:,} env steps" if set(caps.values()) == {cap} else "the env steps that they were to have"
    by_scheduler = [trial for trial in ended if trial.status == "stopped"]
    by_goal = [trial for trial in ended if trial.status == "completed" and reached_goal(trial)]
    parts = [
        f"{who} ended {counted(len(members), 'trial')} before {length}, which saved "
        f"{_percent(sum(max(0, caps[trial.trial_id] - trial.num_env_steps) for trial in members) / whole)}"
        for who, members in (("the scheduler", by_scheduler), ("reaching the goal", by_goal))
        if members
    ]
    return "; ".join(parts) + " of the env steps of all" if parts else "no trial was ended before its last env step"


def _notes(source: Source, trials: Sequence[TrialRecord]) -> list[str]:
    notes = []
    if source.core_seconds and any(trial.engine == "packed" for trial in trials):
        notes += [_ESTIMATED]
    if any(trial.num_failures for trial in trials):
        notes += ["What failed attempts took before the checkpoint that a trial went on from is not counted."]
    return notes


def _spread(values: Sequence[float]) -> str:
    if len(values) < 2:
        return ""
    low, high = min(values), max(values)
    if low == high:
        return f", {number(low)} each"
    return f"; a trial {number(low)} to {number(high)}, median {number(statistics.median(values))}"


def _percent(share: float) -> str:
    return "under 1 %" if 0 < share < 0.01 else f"{100 * share:.0f} %"
