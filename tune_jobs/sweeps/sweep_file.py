"""A sweep as one file to send to somebody, who drops it on the page of any service: compressed JSON, without policies.

It is made to leave this machine. Absolute paths keep their last part alone, wherever a text has one; nodes are
numbered; what trials printed, policies, films and the report stay behind. The guide on exports says what it holds.
"""

from __future__ import annotations

import gzip
import json
import math
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from analysis.best_records import BestRecord
from analysis.front_view import front_view
from analysis.importance import what_mattered
from analysis.records import IterationRecord, SweepRecord, TrialRecord
from analysis.selection import score_trial
from policies.errors import NotFoundError, SpecError
from tune_jobs.store.candidates import readable_trials
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import is_url
from tune_jobs.sweeps.current_best import has_best_to_show
from tune_jobs.sweeps.curves import Columns, Curve
from tune_jobs.sweeps.gathered import spec_of, sweep_data
from tune_jobs.sweeps.numbered_nodes import NumberedNodes
from tune_jobs.sweeps.plain import score_point, to_json
from tune_jobs.sweeps.shortened_paths import Shortener
from tune_jobs.sweeps.status import SweepStatus, as_left, status_of, was_killed
from tune_jobs.sweeps.storage import folder_at

FORMAT = "tune-jobs sweep"
FORMAT_VERSION = 1
"""Readers refuse a higher one: it is raised where they would show something wrong."""
MAX_BYTES = 256 * 2**20
"""The most bytes of JSON; the page inflates no more, as its sweep_file.js says."""

_MAX_POINTS = 200_000
"""Points of all curves together."""
_MOST_OF_ONE, _LEAST_OF_ONE = 1_000, 20
# Where it ran, and what it needs of its machine, concerns nobody elsewhere.
_NOT_OF_SWEEPS = ("format_version", "address", "job", "allowed_modules", "waiting", "state")
_NOT_OF_TRIALS = ("ran_with",)


def sweep_file(store: Sweep) -> bytes:
    """Return a sweep as one file; of a sweep that no process runs it is the same each time.

    Raises:
        CheckpointError: The record of the sweep or of a trial is damaged.
        SpecError: There is more of it than a reader takes.
    """
    shorten = Shortener([] if is_url(store.place) else [folder_at(store.place)])
    text = json.dumps(shorten(_document(store)), separators=(",", ":"), allow_nan=False)
    if len(text) > MAX_BYTES:
        raise SpecError(
            f"Sweep {store.name} has {len(text):,} bytes as one file, and readers take no more than {MAX_BYTES:,}.",
            "Export it as csv or parquet.",
        )
    # ASCII, as JSON escapes what is not; without the time, which would make each file another one.
    return gzip.compress(text.encode("ascii"), compresslevel=6, mtime=0)


def _document(store: Sweep) -> dict[str, Any]:
    data, record = sweep_data(store), store.read_record()
    # As status and page have them.
    trials = sorted(readable_trials(store), key=lambda trial: trial.index)
    status = status_of(store, record, trials)
    if was_killed(record, alive=status.alive):
        trials = as_left(trials)
    mattered = what_mattered(record, data.trials, data.results, threshold=data.threshold)
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "made_by": version("tune-jobs"),
        "as_of": _as_of(status, trials),
        "sweep": _without(record, _NOT_OF_SWEEPS),
        "status": _told(status),
        "trials": _rows(trials),
        "curves": _curves(data.results),
        "importance": to_json(mattered),
        "front": to_json(front_view(data, spec_of(store).objective.cost)),
        "best": to_json(_best(store, record, trials)),
    }


def _as_of(status: SweepStatus, trials: Sequence[TrialRecord]) -> float:
    """Return when it was as the file has it: now if it runs, else when something was last known to happen."""
    if status.alive:
        return time.time()
    record = status.sweep
    known = [record.created_at, record.started_at, record.ended_at]
    known += [moment for trial in trials for moment in (trial.started_at, trial.ended_at)]
    return max((moment for moment in known if moment is not None and math.isfinite(moment)), default=0.0)


def _told(status: SweepStatus) -> dict[str, Any]:
    fields = ("counts", "num_env_steps", "max_env_steps", "env_steps_per_s", "time_left_s", "best")
    return {"state": status.state, **{name: to_json(getattr(status, name)) for name in fields}}


def _without(record: SweepRecord | TrialRecord, names: Sequence[str]) -> dict[str, Any]:
    return {name: item for name, item in to_json(record).items() if name not in names}


def _rows(trials: Sequence[TrialRecord]) -> list[dict[str, Any]]:
    nodes = NumberedNodes(trials)
    rows = []
    for trial in trials:
        scored = score_trial(trial)
        more = {
            "node": None if trial.node is None else nodes.named(trial.node),
            "notes": [nodes.in_text(note) for note in trial.notes],
            "error": None if trial.error is None else nodes.in_text(trial.error),
            "score": None if scored is None else to_json(scored.score),
            "score_point": score_point(trial),
        }
        rows.append(_without(trial, _NOT_OF_TRIALS) | more)
    return rows


def _curves(results: Mapping[str, Sequence[IterationRecord]]) -> dict[str, Columns]:
    most = min(_MOST_OF_ONE, max(_LEAST_OF_ONE, _MAX_POINTS // max(1, len(results))))
    found = {}
    for trial_id, rows in sorted(results.items()):
        curve = Curve()
        curve.append(rows)
        if rows:
            found[trial_id] = curve.columns(most)
    return found


def _best(store: Sweep, record: SweepRecord, trials: Sequence[TrialRecord]) -> BestRecord | None:
    try:
        return store.read_best() if has_best_to_show(store, record, trials) else None
    except NotFoundError:
        # It can't be read.
        return None
