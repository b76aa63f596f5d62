"""The searched hyperparameters as axes: which scale each has, and where on it each trial lies."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from analysis.charts.model import Axis, Column, Number, Trials
from analysis.charts.subject import Subject
from analysis.domains import LISTED_KINDS, NEAR_ONE, arguments_of, is_log_kind, kind_of
from analysis.points import IDLE, value_of
from analysis.wording import is_number, setting_text

MAX_SHOWN = 500
"""How many trials are drawn one by one."""
_NUM_BEST_SHOWN = 100
_MAX_LISTED = 12
_NOT_SET = "not set"


def trials_table(subject: Subject, names: Sequence[str]) -> Trials:
    """Return the trials of a sweep that have begun, with their values of some hyperparameters, in that order."""
    trials = sorted(subject.begun, key=lambda trial: trial.index)
    scores = tuple(subject.scores[trial.trial_id] for trial in trials)
    return Trials(
        ids=tuple(trial.trial_id for trial in trials),
        score=Axis(subject.score_name),
        scores=scores,
        endings=tuple(subject.ending(trial) for trial in trials),
        columns=tuple(column(name, [value_of(trial.point, name) for trial in trials], subject.space) for name in names),
        shown=_shown(scores),
    )


def column(name: str, values: Sequence[Any], space: Mapping[str, Any]) -> Column:
    """Return one hyperparameter: a list of values as categories, a range on the scale that it was searched on.

    Args:
        name: The hyperparameter.
        values: Its value in each trial; None: it has none; `IDLE`: it does not act, and has no place on the axis.
        space: The space of the sweep file; what it lacks is seen from the values.
    """
    acting = [value for value in values if value is not IDLE]
    if len(acting) < len(values):
        found = column(name, acting, space) if acting else Column(Axis(name), ())
        places = iter(found.values)
        return Column(found.axis, tuple(None if value is IDLE else next(places) for value in values))
    kind = kind_of(space.get(name))
    numbers = [float(value) for value in values if is_number(value) and math.isfinite(value)]
    is_numeric = len(numbers) == len([value for value in values if value is not None]) > 0
    is_listed = kind in ("", *LISTED_KINDS)
    is_short = kind in (*LISTED_KINDS, "power_of_two") and len(set(numbers)) <= _MAX_LISTED
    if not is_numeric or is_short or (is_listed and None in values):
        return _categories(name, values, space)
    if kind == NEAR_ONE and max(numbers) < 1:
        return Column(
            Axis(f"1 - {name}", "log"), tuple(None if value is None else round(1.0 - value, 15) for value in values)
        )
    is_wide = min(numbers) > 0 and max(numbers) > 10 * min(numbers)
    is_log = min(numbers) > 0 and (is_log_kind(kind) or (is_listed and is_wide))
    return Column(Axis(name, "log" if is_log else "value"), tuple(values))


def place(column: Column, value: Number) -> float:
    """Return how far along its axis a value lies, from 0 to 1."""
    low, high = column.ends
    if value is None or high <= low:
        return 0.5
    if column.axis.kind == "log":
        return (math.log(value) - math.log(low)) / (math.log(high) - math.log(low))
    return (value - low) / (high - low)


def _categories(name: str, values: Sequence[Any], space: Mapping[str, Any]) -> Column:
    tried = {_label(value): value for value in values}
    listed = [_label(value) for value in _listed(space.get(name))]
    order = list(dict.fromkeys([*(label for label in listed if label in tried), *tried]))
    if all(is_number(value) for value in tried.values()):
        order.sort(key=lambda label: float(tried[label]))
    elif kind_of(space.get(name)) == "layers" and all(isinstance(value, list | tuple) for value in tried.values()):
        order.sort(key=lambda label: (len(tried[label]), list(map(str, tried[label]))))
    places = {label: index for index, label in enumerate(order)}
    return Column(Axis(name, "category", tuple(order)), tuple(places[_label(value)] for value in values))


def _listed(domain: Any) -> Sequence[Any]:
    values = arguments_of(domain) if kind_of(domain) in LISTED_KINDS else ()
    return values if isinstance(values, list | tuple) else ()


def _label(value: Any) -> str:
    return _NOT_SET if value is None else setting_text(value)


def _shown(scores: Sequence[Number]) -> tuple[int, ...]:
    """Return the indices of the trials that are drawn: all, or the best and every n-th of the others."""
    if len(scores) <= MAX_SHOWN:
        return tuple(range(len(scores)))
    order = sorted(range(len(scores)), key=lambda index: (scores[index] is None, -(scores[index] or 0.0), index))
    rest = sorted(order[_NUM_BEST_SHOWN:])
    picks = np.linspace(0, len(rest) - 1, MAX_SHOWN - _NUM_BEST_SHOWN).round().astype(int)
    return tuple(sorted([*order[:_NUM_BEST_SHOWN], *(rest[pick] for pick in picks)]))


def shown_note(trials: Trials) -> tuple[str, ...]:
    """Say how many trials are drawn, if not all are."""
    if len(trials.shown) == len(trials.ids):
        return ()
    num = f"{len(trials.shown):,} of {len(trials.ids):,}"
    return (f"{num} trials are drawn: the {_NUM_BEST_SHOWN} best, and others that are spread evenly.",)
