"""Which point and which seed a trial has."""

import pytest

from analysis.numbering import Place, first_index, place_of, planned_places
from analysis.records import ReplicationRecord


def added(num_points: int, *points: int) -> ReplicationRecord:
    return ReplicationRecord(num_points=num_points, points=points)


def test_without_replications_the_seeds_of_a_point_follow_each_other() -> None:
    assert planned_places(2, 3, []) == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]
    assert place_of(1_000_007, 2, []) == Place(500_003, 1)


def test_replications_come_behind_the_trials_there_are() -> None:
    once = [added(3, 2, 0, 2)]
    assert planned_places(3, 1, once) == [(0, 0), (1, 0), (2, 0), (2, 1), (0, 1), (2, 2)]
    twice = [*once, added(3, 2)]
    assert planned_places(3, 1, twice) == [*planned_places(3, 1, once), (2, 3)]


def test_points_that_come_later_are_numbered_behind_replications() -> None:
    before = planned_places(2, 2, [added(2, 1)])
    after = planned_places(4, 2, [added(2, 1)])
    assert after == [*before, (2, 0), (2, 1), (3, 0), (3, 1)]
    # And what is added to those comes behind them.
    assert planned_places(4, 2, [added(2, 1), added(4, 3, 1)]) == [*after, (3, 2), (1, 3)]


def test_each_place_is_there_once_and_found_by_its_index() -> None:
    replications = [added(5, 0, 4, 0), added(5, 0), added(7, 6, 0, 4)]
    found = planned_places(9, 2, replications)
    assert len(set(found)) == len(found) == 9 * 2 + 7
    assert [place_of(index, 2, replications) for index in range(len(found))] == found
    for point_index in range(9):
        assert first_index(point_index, 2, replications) == found.index(Place(point_index, 0))


@pytest.mark.parametrize(
    ("replications", "words"),
    [
        ([added(2, 2)], "of 2 points names point 2"),
        ([added(3, 0), added(2, 0)], "of 2 points follows one of 3"),
        ([added(5, 0)], "of 5 points is of a sweep with 4"),
    ],
)
def test_what_cannot_be_is_refused(replications: list[ReplicationRecord], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        planned_places(4, 1, replications)
