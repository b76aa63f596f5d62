"""Parts of what mattered, each by itself: tests together, joint effects, intervals, and which points are judged."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from known_scores import by_activation, draw, sweep_of

from analysis.importance import judge
from analysis.importance.chance import holm
from analysis.importance.joint import _product, find_interactions
from analysis.importance.model import Terms, fit, make_terms, ranks
from analysis.importance.scored import Scored
from analysis.importance.searched import Searched


def listed(name: str, values: list[Any]) -> Searched:
    return Searched(name, "choice", tuple(dict.fromkeys(values)), tuple(values))


def test_probabilities_of_several_tests_are_raised_step_by_step_and_stay_in_order() -> None:
    # By hand: 0.01 x 4; 0.02 x 3; 0.021 x 2 = 0.042, which may be no less than that of the smaller one; 0.9.
    assert holm([0.9, 0.02, 0.01, 0.021]) == pytest.approx([0.9, 0.06, 0.04, 0.06])
    assert holm([0.5, 0.4]) == pytest.approx([0.8, 0.8])
    assert holm([0.7, 0.6]) == pytest.approx([1.0, 1.0])


def balanced(num: int, names: str) -> tuple[Terms, list[np.ndarray]]:
    """Lists of two values in all combinations, each as often; and the signs of the values."""
    rows = [signs for _ in range(num) for signs in itertools.product((-1, 1), repeat=len(names))]
    signs = [np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)]
    terms = make_terms([listed(name, [str(s) for s in column]) for name, column in zip(names, signs, strict=True)])
    return terms, signs


def test_what_main_effects_explain_of_a_product_is_that_and_no_more() -> None:
    terms, (first, second) = balanced(3, "ab")
    found = _product(terms, 0, 1)
    # Each column is the contrast of both, which no sum of effects has any part in. Its columns depend on each other.
    contrast = first * second / np.sqrt(len(first))
    assert np.allclose(found - np.outer(contrast, contrast @ found), 0.0, atol=1e-9)
    before = (terms.of(0)[:, :, np.newaxis] * terms.of(1)[:, np.newaxis, :]).reshape(len(first), -1)
    assert (found**2).sum() == pytest.approx(((before - before.mean(axis=0)) ** 2).sum())


def test_no_more_than_five_pairs_are_named() -> None:
    terms, signs = balanced(8, "abcd")
    score = sum(one * other for one, other in itertools.combinations(signs, 2))
    noise = 0.3 * np.random.default_rng(0).standard_normal(len(signs[0]))
    outcome = ranks((score + noise).tolist())
    found = find_interactions(terms, fit(terms, outcome), outcome, np.random.default_rng(0), 0.05)
    assert len(found) == 5
    assert [item.share for item in found] == sorted((item.share for item in found), reverse=True)


@pytest.mark.parametrize(("num", "expected"), [(1, 0), (4, 1)])
def test_of_few_points_no_pair_is_named(num: int, expected: int) -> None:
    """Six points with four coefficients, of which nothing is left to be seen, and four times as many."""
    rows = [(a, b) for _ in range(num) for a in "xy" for b in "pqr"]
    terms = make_terms([listed("a", [a for a, _ in rows]), listed("b", [b for _, b in rows])])
    score = [float(("xy".index(a) + "pqr".index(b)) % 2) + 0.01 * place for place, (a, b) in enumerate(rows)]
    outcome = ranks(score)
    found = find_interactions(terms, fit(terms, outcome), outcome, np.random.default_rng(0), 1.0)
    assert len(found) == expected


@pytest.mark.parametrize("resampled", [0.0, 1.0])
def test_an_interval_holds_its_share_whatever_resamples_say(monkeypatch: pytest.MonkeyPatch, resampled: float) -> None:
    monkeypatch.setattr(judge, "resampled_shares", lambda terms, *_: np.full((10, len(terms.names)), resampled))
    items = sweep_of(draw(30), by_activation).mattered.hyperparams
    shares = [item.share for item in items]
    assert all(share is not None for share in shares)
    assert all(item.low <= item.share <= item.high for item in items)  # type: ignore[operator]


def test_points_of_all_of_a_large_sweep_are_judged_each_once() -> None:
    total = 2_000
    points = tuple({"x": index} for index in range(total))
    found = judge._sampled(Scored("final", points, tuple(map(float, range(total))), total))
    places = [point["x"] for point in found.points]
    assert len(places) == len(set(places)) == 500
    assert places == sorted(places)
    assert found.scores == tuple(map(float, places))
    # About a quarter of each part: the last ones are those that the search has chosen.
    assert all(80 < sum(low <= place < low + 500 for place in places) < 170 for low in range(0, total, 500))
    assert "drawn at random" in found.notes[-1]
