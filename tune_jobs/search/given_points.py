"""The points of a sweep file: what its author wants to be tried first."""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

from analysis.records import ChosenPointRecord
from analysis.wording import counted
from policies.errors import SpecError
from tune_jobs.search.chosen_point import checked_point, domains_text, keys_of
from tune_jobs.spec.rules import check_takes_points
from tune_jobs.spec.sweep_spec import SweepSpec

_MOST_NOTES = 5


def given_points(spec: SweepSpec) -> tuple[ChosenPointRecord, ...]:
    """Return the points of a sweep file, checked, as chosen points that come before all others.

    Raises:
        SpecError: The sweep takes no points, one is wrong, or two are the same; the message lists every problem.
    """
    if not spec.points:
        return ()
    check_takes_points(spec)
    points: list[tuple[int, dict[str, Any]]] = []
    problems: list[str] = []
    first: dict[Hashable, int] = {}
    for index, given in enumerate(spec.points):
        try:
            point = checked_point(spec, given, place=f"points[{index}]")
        except SpecError as error:
            problems.append(error.message)
            continue
        keys = keys_of(spec, point)
        twice = min((first[key] for key in keys if key in first), default=None)
        if twice is not None:
            problems.append(
                f"points[{index}]: it has the values of points[{twice}]: list it once (seeds_per_point repeats points "
                "with other seeds)"
            )
        points.append((index, point))
        for key in keys:
            first.setdefault(key, index)
    if problems:
        raise SpecError("\n  ".join(problems), f"The sweep searches {domains_text(spec.space)}.")
    return tuple(ChosenPointRecord(num_points=index, point=point) for index, point in points)


def repeated_notes(
    chosen_points: Sequence[ChosenPointRecord], points: Sequence[Mapping[str, Any] | None]
) -> tuple[str, ...]:
    """Return the plan's notes on chosen points that are drawn too, which count as settings of their own.

    Args:
        chosen_points: The points that somebody chose, oldest first.
        points: All points of the sweep by index; None: not known yet.
    """
    chosen = {item.num_points for item in chosen_points}
    drawn: dict[str, int] = {}
    for index, point in enumerate(points if chosen else ()):
        if point is not None and index not in chosen:
            drawn.setdefault(json.dumps(point), index)
    # A chosen point is written as the space has it, so that the texts of equal ones are equal.
    places = {item.num_points: drawn.get(json.dumps(item.point)) for item in chosen_points}
    same = {index: other for index, other in places.items() if other is not None}
    notes = [
        f"Point {index} was chosen, and point {other} has the same values: each counts as a setting of its own. Leave "
        "it out of points (seeds_per_point trains points again, and averages over the seeds)."
        for index, other in same.items()
    ]
    more = len(notes) - _MOST_NOTES
    return (*notes[:_MOST_NOTES], *([f"So it is with {counted(more, 'more chosen point')}."] if more > 0 else []))
