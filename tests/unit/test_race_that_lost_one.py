"""A race one of whose settings is no more, as the records of its trials are damaged."""

from analysis.racing import Race
from tune_jobs.sweeps.races import NamedRace


def test_a_race_that_lost_one_that_raced_is_over() -> None:
    assert NamedRace("race-0", Race((0, 1), 2)).next_points([]) == ()
