"""What the training of each trial cost, in core-seconds: a trial of a pack shares its process with others.

The members of a pack are trained together, so the time that a member was in training, its `time_s`, is that of the
whole pack meanwhile. What it cost by itself isn't measured. It is estimated: at any moment a process' cores are shared
by the trials that it trains, in proportion to their env steps per second. Networks of different sizes differ more than
that, and processes that step environments for a pack are not counted.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence

from analysis.records import TrialRecord

_MAX_SECONDS = 1e12
"""A time that is longer is none: it was written by something else than a clock."""


def core_seconds(trials: Sequence[TrialRecord], cores: float = 1.0) -> dict[str, float]:
    """Estimate the core-seconds of each trial, by its id; a trial of which that is not known is left out.

    Args:
        trials: The trials of one sweep.
        cores: How many cores a process has that trains a trial or a pack.
    """
    known: dict[str, float] = {}
    together: defaultdict[tuple[str, int], list[TrialRecord]] = defaultdict(list)
    for trial in trials:
        if not 0 < trial.time_s < _MAX_SECONDS:
            continue
        if trial.node is not None and trial.pid is not None and _span(trial) is not None:
            together[trial.node, trial.pid].append(trial)
        elif trial.engine != "packed":
            known[trial.trial_id] = trial.time_s * cores
    for members in together.values():
        shares = _shares(members)
        known |= {trial.trial_id: trial.time_s * cores * shares[trial.trial_id] for trial in members}
    return known


def busy_seconds(trials: Sequence[TrialRecord]) -> float | None:
    """Return for how many seconds any of the trials was in training; None: it is not known."""
    spans = sorted(span for span in map(_span, trials) if span is not None)
    if not spans:
        return None
    total, end = 0.0, -math.inf
    for start, stop in spans:
        total += max(0.0, stop - max(start, end))
        end = max(end, stop)
    return total


def busy_cores(trials: Sequence[TrialRecord], costs: Mapping[str, float]) -> float | None:
    """Return how many cores were busy in the mean while any of the trials was in training; None: it is not known.

    It is known of latest attempts alone: `started_at` is of these, and what a trial cost is of all, so as much of that
    is counted as the share of its time that the latest one has.

    Args:
        trials: The trials of one sweep.
        costs: Their core-seconds, see `core_seconds`.
    """
    busy = busy_seconds(trials)
    if busy is None or not costs:
        return None
    latest = 0.0
    for trial in trials:
        cost, span = costs.get(trial.trial_id), _span(trial)
        if cost is not None:
            latest += cost if span is None else cost * min(1.0, (span[1] - span[0]) / trial.time_s)
    return latest / busy


def _span(trial: TrialRecord) -> tuple[float, float] | None:
    """Return when the trial was trained, in its latest attempt; of a running one, so far."""
    if trial.started_at is None or not math.isfinite(trial.started_at):
        return None
    end = trial.started_at + trial.time_s if trial.ended_at is None else trial.ended_at
    return (trial.started_at, end) if math.isfinite(end) and end > trial.started_at else None


def _shares(members: Sequence[TrialRecord]) -> Mapping[str, float]:
    """Return each trial's share of its process, its mean over the time that it was in training."""
    spans = {trial.trial_id: span for trial in members if (span := _span(trial)) is not None}
    # A trial without any env step yet is built meanwhile; it counts with the least weight there is.
    weights = {trial.trial_id: max(trial.num_env_steps, 1) / trial.time_s for trial in members}
    events = [(span[not begins], begins, name) for name, span in spans.items() for begins in (True, False)]
    had: defaultdict[str, float] = defaultdict(float)
    running: set[str] = set()
    total, before = 0.0, -math.inf
    for moment, begins, name in sorted(events):
        if running and moment > before:
            for other in running:
                had[other] += (moment - before) * weights[other] / total
        before = moment
        if begins:
            running.add(name)
        else:
            running.discard(name)
        # Summed anew, as adding and taking away would leave rounding errors behind.
        total = math.fsum(weights[other] for other in running)
    return {name: had[name] / (stop - start) for name, (start, stop) in spans.items()}
