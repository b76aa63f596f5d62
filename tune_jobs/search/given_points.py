"""The points of a sweep file: what its author wants to be tried first."""

from __future__ import annotations

from typing import Any

from analysis.records import ChosenPointRecord
from policies.errors import SpecError
from tune_jobs.search.chosen_point import checked_point, domains_text, same_point
from tune_jobs.spec.rules import check_takes_points
from tune_jobs.spec.sweep_spec import SweepSpec


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
    for index, given in enumerate(spec.points):
        try:
            point = checked_point(spec, given, place=f"points[{index}]")
        except SpecError as error:
            problems.append(error.message)
            continue
        twice = next((place for place, known in points if same_point(spec, known, point)), None)
        if twice is not None:
            problems.append(
                f"points[{index}]: it has the values of points[{twice}]: list it once (seeds_per_point repeats points "
                "with other seeds)"
            )
        points.append((index, point))
    if problems:
        raise SpecError("\n  ".join(problems), f"The sweep searches {domains_text(spec.space)}.")
    return tuple(ChosenPointRecord(num_points=index, point=point) for index, point in points)
