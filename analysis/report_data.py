"""The texts and numbers of the report, taken from the records; `report.py` draws and writes it."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from analysis.answers import certainty, setting_score
from analysis.records import BestRecord, IterationRecord, SweepRecord, TrialRecord, finite_or_none
from analysis.selection import NoUsableTrialError, error_summary, select_best
from analysis.statistics import mean_with_ci, paired_difference
from analysis.tables import (
    SOLVED_OVER_NUM_EPISODES,
    cell_value,
    point_names,
    steps_to_solve_frame,
    trials_frame,
)
from analysis.wording import NONE, duration, moment, number, return_text, seed_range, shown_path
from policies import random_streams
from policies.portable.file import BASELINE_KINDS

_MAX_AVERAGED = 1e150
_MAX_ERROR_CHARS = 4_000


def goal_of(sweep: SweepRecord, best: BestRecord | None) -> float | None:
    """Return the return that counts as solved: the env's threshold, else the stop rule's; None without both."""
    if best is not None and best.confirmation.threshold is not None:
        return best.confirmation.threshold
    import gymnasium

    # gymnasium.spec() would import the module that an id such as "module:Env-v0" names, so the registry is read.
    env_spec = gymnasium.registry.get(env_of(sweep))
    if env_spec is not None and env_spec.reward_threshold is not None:
        return float(env_spec.reward_threshold)
    stop = sweep.spec.get("stop") or {}
    wanted = [finite_or_none(stop.get(name)) for name in ("evaluation_return", "training_return")]
    return next((value for value in wanted if value is not None), None)


def env_of(sweep: SweepRecord) -> str:
    """Return the env id of a sweep, from its resolved spec."""
    env = sweep.spec.get("env")
    return str(env.get("id", "?")) if isinstance(env, Mapping) else str(env)


def algorithm_of(sweep: SweepRecord) -> str:
    """Return the sweep's algorithm as a heading names it: "PPO", "Random play"."""
    name = str(sweep.spec.get("algorithm", "?"))
    return {"random": "Random play", "constant": "A constant action"}.get(name, name.upper())


def about_of(sweep: SweepRecord) -> dict[str, str]:
    """Look up what the sweep file says of the sweep, for the head of the page: title, description, expected."""
    told = sweep.spec.get("about")
    told = told if isinstance(told, Mapping) else {}
    return {name: str(told.get(name) or "") for name in ("title", "description", "expected")}


def is_trained(sweep: SweepRecord) -> bool:
    """Whether a sweep's policies learn, which those of baselines don't."""
    return sweep.spec.get("algorithm") not in BASELINE_KINDS


def headline(
    sweep: SweepRecord,
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    goal: float | None,
) -> list[tuple[str, str]]:
    """Return the sweep's main numbers as pairs of label and value."""
    frame = trials_frame(trials, results, threshold=goal)
    statuses = Counter(trial.status for trial in trials)
    facts = [
        ("trials", ", ".join(f"{count} {status}" for status, count in statuses.most_common()) or "none"),
        ("env steps", number(sum(trial.num_env_steps for trial in trials))),
        ("wall time", duration(sweep.run_time_s)),
    ]
    if goal is not None:
        solved = frame["num_env_steps_to_solve"].dropna()
        facts.append(("solved in training", f"{len(solved)} of {len(trials)}"))
        if len(solved):
            facts.append(("fewest env steps to solve", number(int(solved.min()))))
    return facts


def winner_card(best: BestRecord, trials: Sequence[TrialRecord], sweep: SweepRecord, folder: Path) -> dict[str, Any]:
    """Return the winner's data: its point, both scores, the random baseline, and how to load it."""
    confirmation, random = best.confirmation, best.random
    rng = random_streams.fixed()
    interval = gain = None
    if _have_mean(confirmation.returns):
        interval = mean_with_ci(confirmation.returns, rng=rng)
        if _have_mean(random.returns) and random.seeds == confirmation.seeds:
            gain = paired_difference(confirmation.returns, random.returns, rng=rng)
    policy = shown_path(folder / "best" / "policy.json")
    return {
        "trial_id": best.checkpoint.trial_id,
        "iteration": best.checkpoint.iteration,
        "num_env_steps": best.checkpoint.num_env_steps,
        "seed": best.seed,
        "point": [(name, number(cell_value(value))) for name, value in best.point.items()],
        "selection_score": best.selection_score,
        "num_selection_episodes": len(sweep.evaluation_seeds),
        "confirmation": confirmation,
        "interval": interval,
        "gain": gain,
        "random": random,
        "optimism_gap": best.optimism_gap,
        "evaluate_command": f"tune-jobs evaluate {shlex.quote(policy)}",
        "policy_path": repr(policy),
        "stale": _is_stale(best, trials),
    }


def setting_card(best: BestRecord, folder: Path) -> dict[str, Any] | None:
    """Return the data of the setting to train with; None if the sweep has one setting, or an older version wrote it."""
    settings = best.settings
    if settings is None or settings.num_settings < 2:
        return None
    return {
        "point": [(name, number(cell_value(value))) for name, value in settings.best.point.items()],
        "score": setting_score(settings),
        "certainty": "" if settings.best.probability_best is None else certainty(settings),
        "trial_ids": ", ".join(settings.best.trial_ids),
        "is_the_winners": best.checkpoint.trial_id in settings.best.trial_ids,
        "replicate_command": f"tune-jobs replicate {shlex.quote(shown_path(folder))}",
    }


def why_no_best(trials: Sequence[TrialRecord], folder: Path) -> tuple[str, str]:
    """Return message and hint for a sweep that has no confirmed winner."""
    try:
        selection = select_best(trials)
    except NoUsableTrialError as error:
        return error.message, error.hint
    return (
        f"{selection.trial.trial_id} leads with {return_text(selection.score)}, not confirmed on fresh seeds yet.",
        f"Run: tune-jobs best {shlex.quote(shown_path(folder))}",
    )


def fewest_env_steps(
    trials: Sequence[TrialRecord], results: Mapping[str, Sequence[IterationRecord]], goal: float | None
) -> str:
    """Say which hyperparameters solve the env in the fewest env steps; empty without a goal or trials."""
    if goal is None or not trials:
        return ""
    frame = steps_to_solve_frame(trials, results, threshold=goal)
    solving = frame[frame["num_solved"] > 0]
    over = f"a mean training return of {number(goal)} over {SOLVED_OVER_NUM_EPISODES} episodes"
    if solving.empty:
        return f"No trial reached {over}."
    first = solving.iloc[0]
    values = ", ".join(f"{name} {number(first[name])}" for name in point_names(trials))
    who = f"{values} reaches" if values else "The sweep's one point reaches"
    median, num_seeds = finite_or_none(float(first["median_num_env_steps"])), int(first["num_seeds"])
    if median is None:
        return (
            f"{who} {over} with only {int(first['num_solved'])} of {num_seeds} seeds, and no point with more than half."
        )
    seeds = "one seed" if num_seeds == 1 else f"the median of {num_seeds} seeds"
    return f"{who} {over} in the fewest env steps: {number(median)} ({seeds})."


def failures(trials: Sequence[TrialRecord]) -> list[dict[str, str]]:
    """Return the failed trials, each with the line that names the error and the end of the whole text."""
    return [
        {
            "trial_id": trial.trial_id,
            "summary": error_summary(trial.error),
            "text": (trial.error or "")[-_MAX_ERROR_CHARS:],
            "point": ", ".join(f"{name} {number(cell_value(value))}" for name, value in trial.point.items()),
            "num_failures": str(trial.num_failures),
        }
        for trial in sorted(trials, key=lambda item: item.index)
        if trial.status == "failed"
    ]


def facts(sweep: SweepRecord) -> list[tuple[str, str]]:
    """Return when, with what and on which seeds the sweep ran."""
    rows = [
        ("started", moment(sweep.started_at)),
        ("ended", moment(sweep.ended_at)),
        ("time in all", duration(sweep.run_time_s)),
        ("sweep seed", str(sweep.spec.get("seed", NONE))),
        ("evaluation seeds", seed_range(sweep.evaluation_seeds)),
        ("confirmation seeds", seed_range(sweep.confirmation_seeds)),
        ("address", sweep.address or "this machine"),
        ("git commit", sweep.git_commit or NONE),
    ]
    return rows + sorted(sweep.versions.items())


def _is_stale(best: BestRecord, trials: Sequence[TrialRecord]) -> bool:
    """Whether another checkpoint leads by now, for example because the sweep was extended."""
    try:
        return select_best(trials).checkpoint.path != best.checkpoint.path
    except NoUsableTrialError:
        return False


def _have_mean(values: Sequence[float]) -> bool:
    """Whether there are values, all finite, whose sums and squares are finite too."""
    return len(values) > 0 and all(abs(value) < _MAX_AVERAGED for value in values)
