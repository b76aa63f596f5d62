"""Core-seconds of trials: those of a pack share their process."""

from typing import Any

import pytest

from analysis.core_seconds import busy_cores, busy_seconds, core_seconds
from analysis.records import TrialRecord


def trial(index: int, start: float | None, end: float | None, **fields: Any) -> TrialRecord:
    known = {
        "trial_id": f"t{index:04d}", "index": index, "point_index": index, "seed": index, "point": {},
        "engine": "packed", "status": "completed", "node": "here", "pid": 1, "num_env_steps": 1000,
        "started_at": start, "ended_at": end, "time_s": 0.0 if start is None or end is None else end - start,
    }  # fmt: skip
    return TrialRecord.model_validate(known | fields)


def test_members_of_a_pack_share_its_time() -> None:
    trials = [trial(0, 0.0, 10.0), trial(1, 0.0, 10.0), trial(2, 0.0, 10.0, pid=2)]
    assert core_seconds(trials) == pytest.approx({"t0000": 5.0, "t0001": 5.0, "t0002": 10.0})
    assert core_seconds(trials, cores=2.0)["t0002"] == pytest.approx(20.0)


def test_who_stays_alone_has_the_process_to_itself() -> None:
    # The first ends after 4 s with as many env steps a second as the other: 2 s of it, and 2 + 6 s.
    trials = [trial(0, 0.0, 4.0, num_env_steps=400), trial(1, 0.0, 10.0, num_env_steps=1000)]
    assert core_seconds(trials) == pytest.approx({"t0000": 2.0, "t0001": 8.0})


def test_shares_are_by_env_steps_a_second() -> None:
    trials = [trial(0, 0.0, 10.0, num_env_steps=3000), trial(1, 0.0, 10.0, num_env_steps=1000)]
    assert core_seconds(trials) == pytest.approx({"t0000": 7.5, "t0001": 2.5})


def test_no_time_is_counted_twice_or_lost() -> None:
    trials = [trial(i, 0.7 * i, 5.0 + 1.3 * i, num_env_steps=100 * (i % 3 + 1)) for i in range(20)]
    assert sum(core_seconds(trials).values()) == pytest.approx(busy_seconds(trials))


def test_a_resumed_trial_has_the_time_of_its_first_attempt_too() -> None:
    trials = [trial(0, 100.0, 110.0, time_s=30.0), trial(1, 100.0, 110.0, time_s=10.0, num_env_steps=333.0)]
    shares = core_seconds(trials)
    assert shares["t0000"] == pytest.approx(3.0 * shares["t0001"], rel=1e-2)


def test_what_is_not_known_is_left_out() -> None:
    trials = [
        trial(0, None, None, time_s=5.0),
        trial(1, None, None, time_s=5.0, engine="rllib", pid=None),
        trial(2, 0.0, 0.0),
        trial(3, 0.0, None, time_s=4.0, pid=3, status="running"),
        trial(4, 0.0, 5.0, time_s=float("nan"), pid=4),
    ]
    assert core_seconds(trials) == pytest.approx({"t0001": 5.0, "t0003": 4.0})
    assert core_seconds([]) == {}
    assert busy_seconds([]) is None
    assert busy_seconds([trial(0, 0.0, 2.0), trial(1, 1.0, 3.0), trial(2, 7.0, 8.0)]) == pytest.approx(4.0)


def test_a_resumed_trial_keeps_no_more_cores_busy_than_it_has() -> None:
    """It trained for 1,000 s in all, and 100 s of them in the attempt that its times are of."""
    alone = [trial(0, 1000.0, 1100.0, time_s=1000.0)]
    assert busy_cores(alone, core_seconds(alone)) == pytest.approx(1.0)
    two = [*alone, trial(1, 1000.0, 1100.0, pid=2)]
    assert busy_cores(two, core_seconds(two)) == pytest.approx(2.0)
    assert busy_cores([], {}) is None
    assert busy_cores([trial(0, None, None, time_s=5.0)], {}) is None
