"""Number the trials of a sweep: which point and which seed a trial has, by its index.

Points come one after the other, each with its `seeds_per_point` seeds. A replication adds one more seed to each of some
points, behind all trials there are then; points that come later are numbered behind those. So a trial keeps its
index, and with it its id and its seeds, whatever is added to its sweep.

A point that somebody chose takes the next index, as any other. The points that are drawn are counted by themselves, so
that they are the same ones whatever was chosen among them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from analysis.records import ChosenPointRecord, ReplicationRecord


class Place(NamedTuple):
    """The place of a trial in its sweep."""

    point_index: int
    seed_index: int


def place_of(index: int, seeds_per_point: int, replications: Sequence[ReplicationRecord]) -> Place:
    """Return the place of one trial.

    Args:
        index: The index of the trial.
        seeds_per_point: The seeds of every point, at least 1.
        replications: What was added, oldest first.

    Raises:
        ValueError: A replication names a point that the sweep did not have then, or has fewer points than one before.
    """
    num_points = 0
    seeds: Counter[int] = Counter()
    for replication in replications:
        _check(replication, num_points)
        num_trials = (replication.num_points - num_points) * seeds_per_point
        if index < num_trials:
            break
        index -= num_trials
        num_points = replication.num_points
        earlier = replication.points[:index]
        if index < len(replication.points):
            point_index = replication.points[index]
            return Place(point_index, seeds_per_point + seeds[point_index] + earlier.count(point_index))
        index -= len(replication.points)
        seeds.update(replication.points)
    return Place(num_points + index // seeds_per_point, index % seeds_per_point)


def first_index(point_index: int, seeds_per_point: int, replications: Sequence[ReplicationRecord]) -> int:
    """Return the index of a point's first trial; the arguments are as for `place_of`."""
    before = (item for item in replications if item.num_points <= point_index)
    return point_index * seeds_per_point + sum(len(item.points) for item in before)


def planned_places(num_points: int, seeds_per_point: int, replications: Sequence[ReplicationRecord]) -> list[Place]:
    """Return the places of all trials of a sweep with this many points, by index; as for `place_of`.

    Raises:
        ValueError: In the cases of `place_of`, or if a replication had more points.
    """
    if replications and replications[-1].num_points > num_points:
        raise ValueError(f"a replication of {replications[-1].num_points} points is of a sweep with {num_points}")
    total = num_points * seeds_per_point + sum(len(item.points) for item in replications)
    return [place_of(index, seeds_per_point, replications) for index in range(total)]


def drawn_index(point_index: int, chosen_points: Sequence[ChosenPointRecord]) -> int:
    """Return which of the drawn points a point is that nobody chose, from 0."""
    return point_index - sum(item.num_points < point_index for item in chosen_points)


def with_chosen(
    drawn: Sequence[dict[str, Any] | None], chosen_points: Sequence[ChosenPointRecord]
) -> list[dict[str, Any] | None]:
    """Return all points of a sweep by index: those that are drawn, in order, and between them those that were chosen.

    Args:
        drawn: The drawn points; None: the search method finds it later.
        chosen_points: What somebody chose, oldest first.

    Raises:
        ValueError: A chosen point would have to come before an earlier one, or behind more points than there are.
    """
    points: list[dict[str, Any] | None] = list(drawn)
    before = -1
    for item in chosen_points:
        if item.num_points <= before:
            raise ValueError(f"a point chosen after {item.num_points} points follows one chosen after {before}")
        if item.num_points > len(points):
            raise ValueError(f"a point chosen after {item.num_points} points is of a sweep with {len(points)}")
        points.insert(item.num_points, dict(item.point))
        before = item.num_points
    return points


def _check(replication: ReplicationRecord, num_points_before: int) -> None:
    if replication.num_points < num_points_before:
        raise ValueError(f"a replication of {replication.num_points} points follows one of {num_points_before}")
    unknown = [index for index in replication.points if index >= replication.num_points]
    if unknown:
        raise ValueError(f"a replication of {replication.num_points} points names point {unknown[0]}")
