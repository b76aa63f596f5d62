"""The words for why a trial ended: what they compare holds as it is told."""

from __future__ import annotations

import math
from typing import Any

import pytest

from analysis.records import IterationRecord
from tests.narrowing import present
from tune_jobs.spec.sections import StopSpec
from tune_jobs.training.stop_rules import stop_reason

PAIRS = [
    (10_004, 10_004.2),
    (21_500, 21_503.0),
    (12_344.5, 12_344.9),
    (-1_234.6, -1_234.4),
    (1_234_567, 1_234_570.0),
    (195.0, 195.0),
    (0.1 + 0.2, 0.1 + 0.2),
    (4.75, math.nextafter(4.75, 5.0)),
    (1e-7, 2e-7),
    (-1.0, -1e-9),
    (1e300, 1.7e308),
]


def ended(stop: dict[str, Any], **record: Any) -> str:
    taken = IterationRecord(iteration=1, num_env_steps=10, num_episodes=1, **{"time_s": 1.0, **record})
    return present(stop_reason(StopSpec(**stop), taken, record.get("evaluation_return"), is_full=True))


@pytest.mark.parametrize("name", ["training_return", "evaluation_return", "time_s"])
@pytest.mark.parametrize(("target", "value"), PAIRS)
def test_the_value_that_is_told_is_not_less_than_the_target_that_is_told(
    name: str, target: float, value: float
) -> None:
    if name == "time_s" and target < 0:
        target, value = -value, -target
    told, left, is_at_least, right = ended({name: target}, **{name: value}).split()
    assert (told, is_at_least, float(right)) == (name, ">=", target)
    assert float(left) >= target
    assert float(left) == pytest.approx(value, abs=0.5 if name == "time_s" else 5e-5)


@pytest.mark.parametrize(
    ("target", "value", "said"),
    [
        (475.0, 480.123456789, "480.1235 >= 475"),
        (12_344.5, 12_344.9, "12344.9 >= 12344.5"),
        (-1.0, -1e-9, "0 >= -1"),
        (0.30004, 0.30004123, "0.30004123 >= 0.30004"),
    ],
)
def test_it_is_rounded_unless_that_would_be_less(target: float, value: float, said: str) -> None:
    assert ended({"evaluation_return": target}, evaluation_return=value) == f"evaluation_return {said}"


def test_seconds_are_whole_ones_unless_these_would_be_fewer() -> None:
    assert ended({"time_s": 45.0}, time_s=50.2) == "time_s 50 >= 45"
    assert ended({"time_s": 0.25}, time_s=0.375) == "time_s 0.375 >= 0.25"
