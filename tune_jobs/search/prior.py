"""What a search begins with: the points of earlier sweeps, made comparable by their ranks within their own.

Returns of other environments, budgets and stop rules are of other scales. So a point of an earlier sweep is kept as the
share of that sweep's points that it is better than, and counts like the new sweep's own point of the same rank. With it
is kept what a training took: where the new sweep asks for score and cost, the ranks are by both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import ValidationError

from analysis.records import TRAINING_LENGTH, PriorPointRecord, PriorRecord, TrialRecord, whole_length
from analysis.wording import counted, is_number
from policies.errors import SpecError, shortened
from policies.hyperparams import make_hyperparams
from tune_jobs.search.chosen_point import as_written, outside
from tune_jobs.search.history import TOLD, History, KnownPoint, tell_scores
from tune_jobs.search.two_objectives import weighed
from tune_jobs.search.warped import rank_of, shares_of
from tune_jobs.spec.conditions import Conditions
from tune_jobs.spec.domains import Range
from tune_jobs.spec.hyperparam_problems import as_taken
from tune_jobs.spec.sweep_spec import SweepSpec

_ENOUGH = 10
"""How many own scores tell what their scale is."""


def prior_record(spec: SweepSpec, name: str, earlier: SweepSpec, trials: Sequence[TrialRecord]) -> PriorRecord:
    """Return what an earlier sweep tells the model of a new one.

    Args:
        spec: The new sweep.
        name: The name of the earlier one.
        earlier: Its spec.
        trials: Its trials, with their scores by its objective where a search learns of these, if they are known; those
            that have not ended tell nothing.

    Raises:
        SpecError: It is of another algorithm or another space, its trials changed their values, or none of its points
            could be one of the new sweep.
    """
    _check_the_same(spec, name, earlier)
    # What its own search could not have given may lie in this space.
    ended = [point for point in History(earlier, with_outside=True).known_points(trials) if not point.is_running]
    kept = []
    for known, share in zip(ended, shares_of(ended), strict=True):
        point = _seen_by(spec, earlier, known)
        if point is not None:
            kept.append(
                PriorPointRecord(
                    point=point,
                    share=None if known.score is None else float(share),
                    env_steps=_mean_cost(known, earlier),
                    trained=known.trained,
                )
            )
    if not kept:
        why = f"none of its {counted(len(ended), 'ended point')} lies in this space" if ended else "no point has ended"
        raise SpecError(f"prior: sweep {name} tells nothing, as {why}.", "Widen the space, or leave it out.")
    by_best = earlier.objective.type in TOLD and tell_scores(trials) is False
    return PriorRecord(
        sweep=name, env_id=earlier.env.id, points=tuple(kept), num_ended=len(ended), by_best_evaluation=by_best
    )


def _check_the_same(spec: SweepSpec, sweep: str, earlier: SweepSpec) -> None:
    different = []
    if earlier.algorithm != spec.algorithm:
        different.append(f"its algorithm is {earlier.algorithm}, and not {spec.algorithm}")
    different += [
        f"{name} is searched here, and neither searched nor fixed there"
        for name in spec.space
        if name not in earlier.space and name not in _fixed_in(earlier)
    ]
    different += [f"{name} is searched there, and not here" for name in earlier.space if name not in spec.space]
    if earlier.scheduler.is_population:
        different.append("it is a population, whose trials change their values while they train")
    if different:
        raise SpecError(
            f"prior: sweep {sweep} is none that this search could begin with: {'; '.join(different)}.",
            "Leave it out, or search what it searched.",
        )


def _mean_cost(known: KnownPoint, earlier: SweepSpec) -> int | None:
    """Return the mean env steps that a training of a point takes, without what its last iteration has beyond its end.

    Trainings of one length cost the same: what they have beyond it would decide where nothing else differs.
    """
    if not known.env_steps:
        return None
    values = {**vars(make_hyperparams(earlier.algorithm, {})), **earlier.hyperparams, **known.point}
    stop = earlier.stop
    length = whole_length(known.point, values, num_env_steps=stop.num_env_steps, num_iterations=stop.num_iterations)
    return round(sum(min(steps, length) for steps in known.env_steps) / len(known.env_steps))


def _fixed_in(earlier: SweepSpec) -> dict[str, Any]:
    """Return what trials of an earlier sweep have where nothing is searched, or where that does not act."""
    return {**earlier.hyperparams, TRAINING_LENGTH: earlier.stop.num_env_steps}


def _seen_by(spec: SweepSpec, earlier: SweepSpec, known: KnownPoint) -> dict[str, Any] | None:
    """Return a point with the names of the new sweep; None: it could not have that point."""
    values = {name: value for name, value in _fixed_in(earlier).items() if name in spec.space} | dict(known.point)
    try:
        # The other sweep may have listed or fixed the same value in another form, as 64 for [64].
        values = {name: _in_form_of(spec, name, value) for name, value in values.items()}
    except ValidationError:
        return None
    acting = Conditions(spec.space).acting(values)
    if not acting <= values.keys():
        return None
    point = {name: values[name] for name in spec.space if name in acting}
    return None if outside(spec.space, point) else point


def _in_form_of(spec: SweepSpec, name: str, value: Any) -> Any:
    """Return a value in the form of its domain; `ValidationError`: the hyperparameter does not take it."""
    as_taken(spec.algorithm, name, value)
    domain = spec.space[name]
    is_outside = isinstance(domain, Range) and not is_number(value)
    return value if is_outside else as_written(spec, name, domain, value)


def weighed_prior(prior: PriorRecord, index: int, seed: int) -> PriorRecord:
    """Return an earlier sweep with its points in the order of score and cost as one number, as the own points are.

    They keep the shares that they have together: who is best so has the largest.

    Args:
        prior: The earlier sweep. One of a former record, which tells no costs, stays as it is.
        index: The index of the point that is asked for.
        seed: The new sweep's seed.
    """
    scored = [
        (place, item.share, item.env_steps)
        for place, item in enumerate(prior.points)
        if item.share is not None and item.env_steps is not None
    ]
    if len(scored) < sum(item.share is not None for item in prior.points):
        return prior
    points = list(prior.points)
    told = weighed([KnownPoint(points[place].point, (share,), (cost,)) for place, share, cost in scored], index, seed)
    numbers = np.array([each.score for each in told], dtype=np.float64)
    # Equal ones share what they have.
    _, ranks, counts = np.unique(numbers, return_inverse=True, return_counts=True)
    shares = np.bincount(np.sort(ranks), np.sort([share for _, share, _ in scored])) / counts
    for (place, _, _), rank in zip(scored, ranks, strict=True):
        points[place] = points[place].model_copy(update={"share": float(shares[rank])})
    return prior.model_copy(update={"points": tuple(points)})


def with_prior(known: Sequence[KnownPoint], prior: Sequence[PriorRecord]) -> list[KnownPoint]:
    """Return points as a model is told them, those of earlier sweeps first, on one scale.

    While few of the sweep's own points are known, which tell nothing of their scale, they too count by their ranks
    among themselves. Later an earlier sweep's point has the score of the own point of the same rank, and counts as one
    that the scheduler ended where that one does.

    Args:
        known: The sweep's own points.
        prior: What its search began with.
    """
    if not prior:
        return list(known)
    earlier = [item for each in prior for item in each.points]
    ended = [point for point in known if not point.is_running]
    if sum(point.level is None and point.score is not None for point in ended) >= _ENOUGH:
        ordered = sorted(ended, key=rank_of)
        num_failed = sum(point.score is None for point in ended)
        return [*(_like_own(item, ordered, num_failed) for item in earlier), *known]
    shares = iter(map(float, shares_of(ended)))
    own = [
        point if point.is_running else KnownPoint(point.point, (_share_of(point, next(shares)),), trained=point.trained)
        for point in known
    ]
    told = (KnownPoint(item.point, (item.share,), trained=item.trained, is_own=False) for item in earlier)
    return [*told, *own]


def _like_own(item: PriorPointRecord, ordered: Sequence[KnownPoint], num_failed: int) -> KnownPoint:
    """Return an earlier sweep's point with what the own point of its rank reached; if that failed, the worst's score.

    Args:
        item: The point.
        ordered: The own points that ended, the worst first: those that failed, and some that have a score. What failed
            counts here as it did for the share.
        num_failed: How many of them failed.
    """
    if item.share is None:
        return KnownPoint(item.point, (None,), trained=item.trained, is_own=False)
    place = max(item.share * (len(ordered) - 1), num_failed)
    worse, better = ordered[math.floor(place)], ordered[math.ceil(place)]
    part = place - math.floor(place)
    nearest = better if part >= 0.5 else worse
    score = nearest.score
    if worse.level == better.level and worse.score is not None and better.score is not None:
        score = worse.score * (1.0 - part) + better.score * part
    # A score of a rung is one after as much training as there, however long the point itself was trained.
    return KnownPoint(
        item.point, (score,), level=nearest.level, trained=item.trained, length=nearest.trained, is_own=False
    )


def _share_of(point: KnownPoint, share: float) -> float | None:
    return None if point.score is None else share


def prior_notes(spec: SweepSpec, prior: Sequence[PriorRecord], env_id: str = "") -> tuple[str, ...]:
    """Return the plan's notes on what a search begins with.

    Args:
        spec: The sweep.
        prior: What its search begins with.
        env_id: Its env's id with the version, as records have it; the sweep file may leave that out.
    """
    notes = []
    for each in prior:
        other = "" if each.env_id in (spec.env.id, env_id) else f", of {shortened(each.env_id)}, by their ranks there"
        number, all_ended = len(each.points), each.num_ended
        what = counted(number, "point")
        if all_ended is not None and all_ended > number:
            # The others are of values that this space doesn't have.
            what = f"{number:,} of the {all_ended:,} ended points"
        notes.append(f"The model begins with {what} of sweep {each.sweep}{other}.")
        if each.by_best_evaluation:
            why = "scores by its objective are not known of all its trials"
            notes.append(f"Sweep {each.sweep} is ranked by its trials' best evaluations, as {why}.")
    wanted = spec.search.num_startup_trials
    most = sum(len(each.points) for each in prior) + len(spec.points) + spec.num_samples - 1
    if prior and most < wanted:
        notes.append(
            f"All points will be random: with these, fewer than search.num_startup_trials ({wanted}) points will have "
            "ended before the last begins; lower it, or raise num_samples."
        )
    return tuple(notes)
