"""Values that move linearly, to the bit as each user of the formula had it."""

import dataclasses

import numpy as np
import pytest

from policies.hyperparams import DQNHyperparams
from policies.networks.epsilon import EpsilonSchedule
from policies.schedules import linear


def test_schedules() -> None:
    assert linear(0.3, None, None, 50) == 0.3
    assert linear(0.3, 0.1, 100, 50) == pytest.approx(0.2)
    assert linear(0.3, 0.0, 100, 0) == 0.3
    assert linear(0.3, 0.0, 100, 500) == 0.0


def test_a_schedule_to_nothing_or_in_no_steps_stays() -> None:
    assert linear(0.3, 0.0, None, 7) == linear(0.3, None, 100, 7) == 0.3


def test_epsilon_has_the_bits_of_its_own_formula() -> None:
    """Shares are rounded once, then the product, then the sum; another order gives other last bits."""
    rng = np.random.default_rng(0)
    base = EpsilonSchedule.of(DQNHyperparams())
    for _ in range(300):
        start, decay = int(rng.integers(0, 50)), float(rng.uniform(1.0, 5000.0))
        initial, final = float(rng.random()), float(rng.random())
        schedule = dataclasses.replace(base, kind="linear", initial=initial, final=final, decay=decay, start=start)
        for now in (0, start, start + 1, int(rng.integers(0, 6000)), 10_000):
            share = max(0.0, now - start) / decay
            assert schedule.at(now) == initial + (final - initial) * min(1.0, share)
