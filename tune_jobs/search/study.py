"""A sweep as a study of Optuna, for its importances, its plots and its dashboard."""

from __future__ import annotations

import importlib.util
import math
import sqlite3
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.exports.frames import SweepData
from analysis.objectives import score_of
from analysis.records import FINISHED, TrialRecord
from analysis.tables import cell_value
from policies.errors import CannotRunError, SpecError
from tune_jobs.search.parts import Parts
from tune_jobs.spec.domains import Listed, Range
from tune_jobs.spec.sweep_spec import SweepSpec

if TYPE_CHECKING:
    import optuna


def make_study(spec: SweepSpec, data: SweepData, name: str, path: Path | None = None) -> optuna.Study:
    """Return the ended trials of a sweep as an Optuna study.

    A trial's value is what settings are judged by, `objective` in the sweep file, and higher is better. Its evaluations
    are intermediate values, by env steps. One that the sweep's scheduler ended is pruned; one that failed, or showed
    nothing to be judged by, has failed. Lists, such as hidden sizes, are texts; layers that are searched one by one are
    a number and a size of each. A trial lacks what does not act in it, as Optuna has it. It began and ended when the
    sweep's did. Seeds, returns and the point that a trial shares with others are user attributes.

    Args:
        spec: The sweep.
        data: Its trials.
        name: The study's name.
        path: A SQLite file to keep the study in, which must not exist; None: it is kept in memory.

    Raises:
        CannotRunError: Optuna is not installed, or the file exists or cannot be written.
        SpecError: It is a sweep of population based training, or `steps_to_threshold` has no threshold.
    """
    if importlib.util.find_spec("optuna") is None:
        raise CannotRunError(
            "An Optuna study needs Optuna, and that is not installed.",
            "Install it with `pip install 'tune-jobs[tpe]'`.",
        )
    if spec.scheduler.is_population:
        raise SpecError(
            f"Sweep {name} is one of population based training, whose trials change their values while they train; a "
            "trial of Optuna has one value of each.",
            "Export it as csv or parquet, which have every change.",
        )
    if data.objective == "steps_to_threshold" and data.threshold is None:
        raise SpecError(
            f"Sweep {name} is judged by the env steps to a threshold, and its environment has none.",
            "Export it as csv or parquet.",
        )
    import optuna

    if path is not None:
        _make_file(path)
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        storage = None if path is None else _storage(path)
        study = optuna.create_study(study_name=name, direction="maximize", storage=storage)
        trials = [trial for trial in data.trials if trial.status in FINISHED and trial.has_point]
        parts = Parts(spec.space)
        points = [parts.known_values_of(trial.point) for trial in trials]
        distributions = {
            key: _distribution(domain, [point[key] for point in points if key in point])
            for key, domain in parts.space.items()
        }
        study.set_user_attr("objective", data.objective)
        for trial in sorted(trials, key=lambda item: item.index):
            study.add_trial(_as_optunas(spec, data, trial, distributions))
    except BaseException:
        # A part of it would be taken for the whole by whoever opens it.
        if path is not None:
            path.unlink(missing_ok=True)
        raise
    finally:
        optuna.logging.set_verbosity(verbosity)
    return study


def _make_file(path: Path) -> None:
    try:
        if path.exists():
            raise CannotRunError(
                f"{path} exists already.", "Remove it, or give another file with --out (in Python output=)."
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError as error:
        raise CannotRunError(
            f"{path} cannot be written: {error.strerror or error}.", "Give another file, or free space on its disk."
        ) from error


def _storage(path: Path) -> optuna.storages.RDBStorage:
    """Return the storage in a file of any name: in a URL `?`, `%` and braces would be more than letters of it."""
    import optuna

    def connect() -> sqlite3.Connection:
        # As SQLAlchemy connects to a file, whose pool may hand a connection to another thread.
        return sqlite3.connect(path, check_same_thread=False)

    return optuna.storages.RDBStorage("sqlite:///study.db", engine_kwargs={"creator": connect})


def _as_optunas(
    spec: SweepSpec,
    data: SweepData,
    trial: TrialRecord,
    distributions: dict[str, optuna.distributions.BaseDistribution],
) -> optuna.trial.FrozenTrial:
    import optuna

    iterations = data.results.get(trial.trial_id, ())
    score = None
    if trial.status != "failed":
        score = score_of(
            trial, iterations, data.objective, num_env_steps=data.num_env_steps, num_iterations=data.num_iterations,
            threshold=data.threshold, longest=data.longest,
        )  # fmt: skip
    told: dict[str, Any] = {"state": optuna.trial.TrialState.FAIL}
    if score is not None and math.isfinite(score):
        pruned = trial.status == "stopped"
        states = optuna.trial.TrialState
        told = {"state": states.PRUNED if pruned else states.COMPLETE, "value": score}
    parts = Parts(spec.space)
    values = parts.known_values_of(trial.point)
    made = optuna.trial.create_trial(
        params={key: _value(domain, values[key]) for key, domain in parts.space.items() if key in values},
        distributions={key: distributions[key] for key in values},
        intermediate_values={
            item.num_env_steps: item.evaluation_return for item in iterations if item.evaluation_return is not None
        },
        user_attrs=_attributes(trial),
        **told,
    )
    # Where it is not known, the moment of the export remains: Optuna has no finished trial without one.
    if (ended := _local_time(trial.ended_at)) is not None:
        made.datetime_start, made.datetime_complete = _local_time(trial.started_at) or ended, ended
    return made


def _local_time(unix_time: float | None) -> datetime | None:
    """Return a moment in Optuna's form, local time without its zone; None: it is not known, or not a valid time."""
    if unix_time is None:
        return None
    try:
        return datetime.fromtimestamp(unix_time, tz=UTC).astimezone().replace(tzinfo=None)
    except (ValueError, OverflowError, OSError):
        return None


def _attributes(trial: TrialRecord) -> dict[str, Any]:
    """Return what else is known of a trial; SQLite's JSON has no NaN, so that it is left out."""
    names = (
        "trial_id", "point_index", "seed_index", "seed", "engine", "status", "stop_reason", "num_env_steps",
        "num_episodes", "time_s", "training_return", "evaluation_return", "best_evaluation_return",
    )  # fmt: skip
    known = {name: getattr(trial, name) for name in names}
    return {
        name: value
        for name, value in known.items()
        if value is not None and not (isinstance(value, float) and not math.isfinite(value))
    }


def _distribution(domain: Any, values: Sequence[Any]) -> optuna.distributions.BaseDistribution:
    """Return a domain in Optuna's form, as wide as the values: a point that somebody chose may lie outside of it."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(domain, Listed):
        return CategoricalDistribution(tuple(dict.fromkeys(map(cell_value, [*domain.values, *values]))))
    assert isinstance(domain, Range)
    low, high = min([domain.bounds[0], *values]), max([domain.bounds[1], *values])
    is_log = domain.is_log and low > 0
    # A step and a logarithmic scale exclude each other in Optuna, and a step has to lead to each value.
    q = None if is_log or any(not domain.gives(value) for value in values) else domain.q
    if domain.is_whole:
        return IntDistribution(int(low), int(high), log=is_log, step=int(q or 1))
    return FloatDistribution(low, high, log=is_log, step=q)


def _value(domain: Any, value: Any) -> Any:
    return cell_value(value) if isinstance(domain, Listed) else value
