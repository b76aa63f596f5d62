"""Tables of trials and iterations, as pandas DataFrames and CSV files.

One row is one trial or one iteration of a trial. Column names include units; returns are undiscounted and in reward
units. A value that is not known is missing (NaN, an empty CSV cell), never 0.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.collapse import collapsed_trials
from analysis.points import lacks, searched_names
from analysis.records import FINISHED, ChangeRecord, IterationRecord, TrialRecord
from analysis.selection import error_summary, score_trial
from analysis.statistics import median_steps
from analysis.wording import listed
from policies.files import write_atomic

if TYPE_CHECKING:
    import pandas as pd

SOLVED_OVER_NUM_EPISODES = 100
"""Gymnasium's reward thresholds are means over this many consecutive episodes."""


_AFTER_POINT = [
    "seed",
    "point_index",
    "seed_index",
    "score",
    "score_num_env_steps",
    "training_return",
    "evaluation_return",
    "collapsed",
    "num_env_steps_to_solve",
    "num_env_steps_to_threshold",
    "num_iterations",
    "num_env_steps",
    "num_episodes",
    "time_s",
    "stop_reason",
    "num_failures",
    "error",
]

OF_ITERATIONS = ("iteration", "num_env_steps", "num_episodes", "time_s", "training_return", "evaluation_return")
"""The numbers of an iteration that are columns, besides those that the learner measured."""


def cell_value(value: Any) -> Any:
    """Return a sampled value as a table cell: hidden sizes `[64, 64]` as "64x64", other containers as text.

    Lists in a list, as of convolutions, have a space between them: "16x8x4 32x4x2".
    """
    if isinstance(value, list | tuple):
        return listed([str(cell_value(item)) for item in value], value)
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def describe_changes(trial: TrialRecord) -> str | None:
    """Describe what population based training changed: "at 4,096 env steps from t0003: lr 0.01"; None: nothing."""
    texts = [
        f"at {change.num_env_steps:,} env steps from {change.source_trial_id}{_values_of(change)}: "
        + ", ".join(f"{name} {cell_value(value)}" for name, value in change.after.items())
        for change in trial.changes
    ]
    return "; ".join(texts) or None


def _values_of(change: ChangeRecord) -> str:
    return "" if change.values_trial_id in (None, change.source_trial_id) else f", values of {change.values_trial_id}"


def point_names(trials: Sequence[TrialRecord]) -> list[str]:
    """Return the names of the searched hyperparameters, in the order of the sweep file.

    In a population also of those that act in no trial any more.
    """
    return searched_names(point for trial in trials for point in points_of(trial))


def points_of(trial: TrialRecord) -> list[dict[str, Any]]:
    """Return all points that a trial has had; they are several only in a population."""
    return [*(point for change in trial.changes for point in (change.before, change.after)), trial.point]


def shown_point(trial: TrialRecord) -> dict[str, Any]:
    """Return the searched values that a trial's score was reached with, to stand beside it; its newest without one."""
    best = score_trial(trial) if trial.changes else None
    return trial.point if best is None else trial.point_at(best.checkpoint.iteration)


def types_with_gaps(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> dict[str, str]:
    """Return the types of those columns of whole numbers in which some rows have none.

    Pandas would make them floats, which CSV has as 32.0.

    Args:
        rows: The rows of a table.
        names: The columns to look at.
    """
    found = {}
    for name in names:
        kinds = {type(row[name]) for row in rows}
        if kinds == {int, type(None)}:
            found[name] = "Int64"
    return found


def env_steps_to(
    threshold: float | None,
    iterations: Sequence[IterationRecord],
    num_episodes: int = SOLVED_OVER_NUM_EPISODES,
    *,
    changed_at: Collection[int] = (),
) -> int | None:
    """Return the env steps until the training return first reached a threshold; None if it never did.

    Args:
        threshold: Mean episode return to reach; None: there is nothing to reach.
        iterations: The iterations of one trial, oldest first.
        num_episodes: How many whole episodes the mean must be over.
        changed_at: The iterations after which a trial of a population went on from another's copy: the mean is of the
            episodes since then.
    """
    found = _first_to(threshold, iterations, num_episodes, changed_at)
    return None if found is None else found.num_env_steps


def _first_to(
    threshold: float | None, iterations: Sequence[IterationRecord], num_episodes: int, changed_at: Collection[int]
) -> IterationRecord | None:
    """Return the iteration whose training return first reached a threshold, as `env_steps_to` has it."""
    if threshold is None:
        return None
    to_come = deque(sorted(changed_at))
    num_since: int | None = None
    for item in iterations:
        while to_come and to_come[0] < item.iteration:
            to_come.popleft()
            num_since = 0
        if num_since is not None:
            num_since += len(item.episode_returns)
        value, num_played = item.training_return, item.num_episodes if num_since is None else num_since
        if num_played >= num_episodes and value is not None and value >= threshold:
            return item
    return None


def _env_steps_to_solve(
    trial: TrialRecord, threshold: float | None, iterations: Sequence[IterationRecord]
) -> int | None:
    return env_steps_to(threshold, iterations, changed_at=[change.iteration for change in trial.changes])


def solving_point(trial: TrialRecord, threshold: float | None, iterations: Sequence[IterationRecord]) -> dict[str, Any]:
    """Return the searched values that a trial reached a threshold with, to stand beside its env steps to it.

    Of a trial that never did, they are those of `shown_point`.
    """
    if not trial.changes:
        return trial.point
    changed_at = [change.iteration for change in trial.changes]
    found = _first_to(threshold, iterations, SOLVED_OVER_NUM_EPISODES, changed_at)
    return shown_point(trial) if found is None else trial.point_at(found.iteration)


def env_steps_to_evaluation(threshold: float | None, iterations: Sequence[IterationRecord]) -> int | None:
    """Return the env steps until an evaluation first reached a threshold; None if none did.

    An evaluation is of few episodes, so a lucky one may reach it: `env_steps_to` asks for more.

    Args:
        threshold: Mean evaluation return to reach; None: there is nothing to reach.
        iterations: The iterations of one trial, oldest first.
    """
    if threshold is None:
        return None
    reached = (
        item.num_env_steps
        for item in iterations
        if item.evaluation_return is not None and item.evaluation_return >= threshold
    )
    return next(reached, None)


def trials_frame(
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]] | None = None,
    *,
    threshold: float | None = None,
) -> pd.DataFrame:
    """Return a table with one row per trial, in order of index.

    Columns: trial_id, status, one for each searched hyperparameter, seed, point_index, seed_index (trials of one
    point differ in their seeds alone), score (which the selection compares; missing if the trial cannot win),
    score_num_env_steps (when it was reached), training_return, evaluation_return (the newest), collapsed (see
    `collapse.collapsed_trials`; missing without results), num_env_steps_to_solve (see `env_steps_to`; all missing
    without results and a threshold), num_env_steps_to_threshold (see `env_steps_to_evaluation`; filled also where
    trials end before their training return reaches it, as with `stop.evaluation_return`), num_iterations,
    num_env_steps, num_episodes, time_s, stop_reason, num_failures, error (its first line). In a population, the
    searched values are those that the score was reached with, and the last column is changes (see `describe_changes`).
    """
    import pandas as pd

    def rows_of(trial: TrialRecord) -> Sequence[IterationRecord]:
        return (results or {}).get(trial.trial_id, ())

    names, collapsed = point_names(trials), collapsed_trials(trials, results or {})
    rows = []
    for trial in sorted(trials, key=lambda item: item.index):
        best = score_trial(trial)
        point = shown_point(trial)
        rows.append(
            {
                "trial_id": trial.trial_id,
                "status": trial.status,
                **{name: cell_value(point.get(name)) for name in names},
                "seed": trial.seed,
                "point_index": trial.point_index,
                "seed_index": trial.seed_index,
                "score": best.score if best is not None else None,
                "score_num_env_steps": best.checkpoint.num_env_steps if best is not None else None,
                "training_return": trial.training_return,
                "evaluation_return": trial.evaluation_return,
                "collapsed": collapsed[trial.trial_id],
                "num_env_steps_to_solve": _env_steps_to_solve(trial, threshold, rows_of(trial)),
                "num_env_steps_to_threshold": env_steps_to_evaluation(threshold, rows_of(trial)),
                "num_iterations": trial.num_iterations,
                "num_env_steps": trial.num_env_steps,
                "num_episodes": trial.num_episodes,
                "time_s": trial.time_s,
                "stop_reason": trial.stop_reason,
                "num_failures": trial.num_failures,
                "error": error_summary(trial.error) if trial.error is not None else None,
                "changes": describe_changes(trial),
            }
        )
    changes = ["changes"] if any(trial.changes for trial in trials) else []
    frame = pd.DataFrame(rows, columns=["trial_id", "status", *names, *_AFTER_POINT, *changes])
    floats = ["score", "training_return", "evaluation_return", "time_s"]
    # Int64 (capital I) is pandas' integer that can be missing: env steps stay whole numbers in the CSV.
    counts = ["score_num_env_steps", "num_env_steps_to_solve", "num_env_steps_to_threshold"]
    types = {**dict.fromkeys(floats, "float64"), **dict.fromkeys(counts, "Int64"), "collapsed": "boolean"}
    return frame.astype(types | types_with_gaps(rows, names))


def iterations_frame(results: Mapping[str, Sequence[IterationRecord]]) -> pd.DataFrame:
    """Return a table with one row per iteration: trial_id, its numbers, and `learner/<name>` for each metric."""
    import pandas as pd

    learner = sorted({name for items in results.values() for item in items for name in item.learner})
    rows = [
        {
            "trial_id": trial_id,
            **{name: getattr(item, name) for name in OF_ITERATIONS},
            **{f"learner/{name}": value for name, value in item.learner.items()},
        }
        for trial_id, items in results.items()
        for item in items
    ]
    metrics = [f"learner/{name}" for name in learner]
    frame = pd.DataFrame(rows, columns=["trial_id", *OF_ITERATIONS, *metrics])
    floats = ["time_s", "training_return", "evaluation_return", *metrics]
    return frame.astype(dict.fromkeys(floats, "float64"))


def idle_column(name: str) -> str:
    """Return the column of `groups_frame` that says whether a hyperparameter does not act in a group."""
    return f"{name} does not act"


def groups_frame(
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    names: Sequence[str],
    *,
    threshold: float | None,
) -> pd.DataFrame:
    """Return a table with one row per combination of some searched hyperparameters: which solve, and how fast.

    Args:
        trials: The trials of one sweep.
        results: Iterations by trial id, oldest first.
        names: Hyperparameters to group by; the others vary within a group.
        threshold: Training return that counts as solved; None: none does.

    Returns:
        The columns `names`, the `idle_column` of each of them, num_trials, num_failed, num_solved,
        min_num_env_steps_to_solve, best_score, mean_score; those that solved in the fewest env steps first, then by
        best score.
    """
    frame = trials_frame(trials, results, threshold=threshold)
    # A cell is missing of a searched null and of a value that does not act: they are not one group.
    points = {trial.trial_id: shown_point(trial) for trial in trials}
    for name in names:
        frame[idle_column(name)] = [lacks(points[trial_id], name) for trial_id in frame["trial_id"]]
    groups = frame.groupby([*names, *map(idle_column, names)], sort=False, dropna=False)
    table = groups.agg(
        num_trials=("trial_id", "size"),
        num_failed=("status", lambda status: int((status == "failed").sum())),
        num_solved=("num_env_steps_to_solve", "count"),
        min_num_env_steps_to_solve=("num_env_steps_to_solve", "min"),
        best_score=("score", "max"),
        mean_score=("score", "mean"),
    )
    order = ["min_num_env_steps_to_solve", "best_score"]
    return table.reset_index().sort_values(order, ascending=[True, False], na_position="last", ignore_index=True)


def steps_to_solve_frame(
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    *,
    threshold: float | None,
) -> pd.DataFrame:
    """Return a table with one row per point: its env steps to solve the env, seed by seed (see `env_steps_to`).

    Args:
        trials: The trials of one sweep.
        results: Iterations by trial id, oldest first.
        threshold: Training return that counts as solved; None: none does.

    Returns:
        The columns point_index, one for each searched hyperparameter, num_seeds (those that have ended or solved),
        num_solved, median_num_env_steps (missing if that is "never": a seed that ended unsolved counts as later than
        any other) and num_env_steps_seed_<i>, which is missing where seed i did not solve, or was not trained. Fewest
        median env steps first, then those that more seeds solved. In a population, the searched values are those that
        the env was solved with (see `solving_point`).
    """
    import pandas as pd

    names = point_names(trials)
    num_seeds = max((trial.seed_index for trial in trials), default=-1) + 1
    columns = [f"num_env_steps_seed_{index}" for index in range(num_seeds)]
    points: dict[int, list[TrialRecord]] = {}
    for trial in trials:
        points.setdefault(trial.point_index, []).append(trial)
    rows = []
    for index, members in sorted(points.items()):
        steps = {
            trial.seed_index: _env_steps_to_solve(trial, threshold, results.get(trial.trial_id, ()))
            for trial in members
        }
        # A seed that still runs may yet solve it.
        known = [steps[t.seed_index] for t in members if t.status in FINISHED or steps[t.seed_index] is not None]
        solved = [value for value in known if value is not None]
        # Seeds of one point have the same values; a population, whose trials change theirs, has one seed a point.
        point = solving_point(members[0], threshold, results.get(members[0].trial_id, ()))
        rows.append(
            {
                "point_index": index,
                **{name: cell_value(point.get(name)) for name in names},
                "num_seeds": len(known),
                "num_solved": len(solved),
                "median_num_env_steps": median_steps(known) if known else None,
                **{column: steps.get(seed_index) for seed_index, column in enumerate(columns)},
            }
        )
    before = ["point_index", *names, "num_seeds", "num_solved", "median_num_env_steps"]
    frame = pd.DataFrame(rows, columns=[*before, *columns])
    types = {"median_num_env_steps": "float64", **dict.fromkeys(columns, "Int64")}
    frame = frame.astype(types | types_with_gaps(rows, names))
    order = ["median_num_env_steps", "num_solved", "point_index"]
    return frame.sort_values(order, ascending=[True, False, True], na_position="last", ignore_index=True)


def write_csv(path: Path, frame: pd.DataFrame) -> None:
    """Write a frame atomically as CSV, as `csv_text` has it.

    Raises:
        CannotRunError: The file cannot be written.
    """
    write_atomic(path, csv_text(frame))


# The wide forms of the signs, too, which spreadsheets for Chinese, Japanese and Korean take as the signs.
_FORMULAS = frozenset("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")


def csv_text(frame: pd.DataFrame) -> str:
    """Return a frame as CSV, without its index.

    Text that a spreadsheet would run as a formula gets a leading apostrophe, because error texts are not trusted.
    """
    safe = frame.copy()
    for name in safe.columns:
        safe[name] = safe[name].map(_defuse) if safe[name].dtype.kind in "OTU" else safe[name]
    text: str = safe.to_csv(index=False, lineterminator="\n")
    return text


def _defuse(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and value[:1] in _FORMULAS else value
