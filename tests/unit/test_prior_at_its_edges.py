"""What an earlier sweep's points count as between two own ones that ended otherwise, and while few are whole."""

import pytest

from analysis.records import PriorPointRecord, PriorRecord
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.prior import with_prior


def prior_of(*shares: float) -> PriorRecord:
    points = tuple(PriorPointRecord(point={"lr": 1e-3}, share=share) for share in shares)
    return PriorRecord(sweep="first", env_id="Acrobot-v1", points=points)


def test_between_one_that_was_ended_and_one_that_was_not_the_nearer_one_tells() -> None:
    ended = KnownPoint({"lr": 1e-2}, (99.0,), level=0)
    whole = [KnownPoint({"lr": 1e-2}, (float(score),)) for score in range(10)]
    # Of eleven the place is ten times the share: 0.4 and 0.6 of the way from the ended one to the worst whole one.
    told = with_prior([*whole, ended], [prior_of(0.04, 0.06)])[:2]
    assert [(item.level, item.score) for item in told] == [(0, 99.0), (None, 0.0)]


def test_those_that_were_ended_early_do_not_tell_the_scale_of_those_that_were_not() -> None:
    ended = [KnownPoint({"lr": 1e-2}, (float(score),), level=0) for score in range(9)]
    whole = [KnownPoint({"lr": 1e-2}, (-100.0 + score,)) for score in range(9)]
    (told, *own) = with_prior([*ended, *whole], [prior_of(0.3)])
    # Nine whole ones are too few: all count by their ranks.
    assert (told.score, told.level) == (0.3, None)
    assert [item.score for item in own] == [pytest.approx((place + 0.5) / 18) for place in range(18)]
    (told, *own) = with_prior([*ended, *whole, KnownPoint({"lr": 1e-2}, (50.0,))], [prior_of(1.0)])
    assert (told.score, told.level) == (50.0, None)
    assert [item.score for item in own[:2]] == [0.0, 1.0]


def test_own_failures_count_for_the_rank_as_the_earlier_sweeps_did_for_the_share() -> None:
    """Half of both sweeps failed: the worst of the earlier one's others were told as what the middle here reached."""
    scored = [KnownPoint({"lr": 1e-2}, (float(score),)) for score in range(11)]
    failed = [KnownPoint({"lr": 1e-2}, (None,)) for _ in range(10)]
    # Places of 21: the 11th, the 16th and the last one; 0.3 is a failed one's, and no score is below the worst.
    told = with_prior([*scored, *failed], [prior_of(0.5, 0.75, 1.0, 0.3)])[:4]
    assert [item.score for item in told] == [0.0, 5.0, 10.0, 0.0]
