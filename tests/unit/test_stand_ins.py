"""Stand-ins for the benchmark's tasks: what they give follows from the point and the rung, with the noise of a task."""

import importlib.util
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.benchmarks.search.stand_ins import Rung, StandIn, StandInTrainer

pytestmark = pytest.mark.skipif(importlib.util.find_spec("sklearn") is None, reason="needs scikit-learn")


def made(slope: float) -> Rung:
    """A rung whose scores rise along the first of two columns, with a deviation of 1."""
    rng = np.random.default_rng(0)
    columns = rng.random((300, 2))
    return Rung(columns, slope * columns[:, 0] + rng.normal(size=300))


def at(*firsts: float) -> Any:
    return np.array([[first, 0.5] for first in firsts])


def test_a_rung_knows_what_follows_from_a_point_and_what_does_not() -> None:
    steep, flat = made(10.0), made(0.0)
    assert steep.explained > 0.8
    assert flat.explained < 0.1
    low, high = steep.expects(at(0.2, 0.8))
    assert high - low == pytest.approx(6.0, abs=1.0)
    scores = [steep.score(at(0.5), share) for share in np.linspace(0.0, 0.999, 200)]
    assert scores == sorted(scores)
    assert np.std(scores) == pytest.approx(1.0, abs=0.35)
    assert float(np.mean(scores)) == pytest.approx(float(steep.expects(at(0.5))[0]), abs=0.4)


def test_scores_are_as_far_off_as_those_of_points_of_which_as_much_is_expected() -> None:
    rng = np.random.default_rng(1)
    columns = rng.random((400, 2))
    rung = Rung(columns, 10.0 * columns[:, 0] + np.where(columns[:, 0] > 0.5, 2.0, 0.1) * rng.normal(size=400))
    firsts = (0.1, 0.2, 0.4, 0.6, 0.8, 0.9)
    off = [np.std([rung.score(at(first), share) for share in np.linspace(0.0, 0.999, 100)]) for first in firsts]
    assert max(off[:3]) < 0.5
    assert min(off[3:]) > 1.2


def test_a_trainer_gives_the_scores_of_the_rung_that_was_reached_and_the_same_again() -> None:
    rungs = {1_000: made(0.0), 3_000: made(10.0), 9_000: made(100.0)}

    def columns(points: Sequence[dict[str, float]]) -> Any:
        return at(*(point["lr"] for point in points))

    def played(apart: float = 0.5) -> list[list[float]]:
        stand_in = cast("StandIn", SimpleNamespace(rungs=rungs, columns=columns, apart=apart))
        trainer = StandInTrainer(stand_in, 3)
        trainer.add("t0000", {"lr": 0.9}, (0, 1, 2))
        trainer.add("t0001", {"lr": 0.1}, (0, 1, 2))
        found = []
        for iteration in range(1, 10):
            assert trainer.train(["t0000"]) == {"t0000": 1_000 * iteration}
            found.append(list(trainer.returns(["t0000"])["t0000"]))
        trainer.remove("t0000")
        assert trainer.train(["t0001"]) == {"t0001": 1_000}
        return cast("list[list[float]]", found)

    found = played()
    means = [float(np.mean(seeds)) for seeds in found]
    assert means == pytest.approx([means[0]] * 2 + [means[2]] * 6 + [means[8]])
    assert abs(means[0]) < 4.0
    assert means[2] == pytest.approx(9.0, abs=4.0)
    assert means[8] == pytest.approx(90.0, abs=8.0)
    assert all(len(set(seeds)) == 3 for seeds in found)
    assert played() == found
    # The seeds are apart, and their mean is the point's score.
    assert [seeds[0] for seeds in played(apart=0.0)] == pytest.approx(means)
