"""Members of packs that wait for each other at HyperBand's milestones, where one of them has no score or is gone."""

from __future__ import annotations

import pytest

from tune_jobs.ray_tune.hyperband import HyperBand
from tune_jobs.ray_tune.meetings import HyperBandMeeting
from tune_jobs.ray_tune.scheduling import WORST_SCORE, Decision, Standing

pytestmark = pytest.mark.ray

NAMES = [f"t{index:04d}" for index in range(9)]


def begun() -> HyperBandMeeting:
    """A bracket of nine, of which three go on at 100 env steps."""
    meeting = HyperBandMeeting(HyperBand(100, 900, 3))
    for name in NAMES:
        meeting.begins(name)
    assert {meeting.due_at(name) for name in NAMES} == {100}
    return meeting


def at(name: str, score: float) -> Standing:
    return Standing(name, 100, score, evaluated=True)


def test_nobody_waits_for_one_that_was_ended_as_it_has_no_score() -> None:
    meeting = begun()
    meeting.arrives(at(NAMES[0], WORST_SCORE))
    assert meeting.take_outcomes() == {NAMES[0]: Decision.STOP}
    for score, name in enumerate(NAMES[1:]):
        assert meeting.take_outcomes() == {}
        meeting.arrives(at(name, float(score)))
    outcomes = meeting.take_outcomes()
    assert {name for name, outcome in outcomes.items() if outcome is Decision.GO_ON} == set(NAMES[-3:])
    assert {name for name, outcome in outcomes.items() if outcome is Decision.STOP} == set(NAMES[1:-3])


def test_of_one_that_is_gone_nothing_is_decided_any_more() -> None:
    meeting = begun()
    meeting.arrives(at(NAMES[0], WORST_SCORE))
    meeting.gone(NAMES[0])  # it failed in the same moment
    assert meeting.take_outcomes() == {}
    for score, name in enumerate(NAMES[1:]):
        meeting.arrives(at(name, float(score)))
    assert set(meeting.take_outcomes()) == set(NAMES[1:])
