"""Tie groups and the probability of being best, in simulated sweeps where the best is known."""

import itertools
import math
from functools import partial

import numpy as np
import pytest
from simulated_sweeps import RANKED, WORLDS, Simulated, World, best_probabilities, normal

from analysis.statistics import probability_of_being_best, seed_intervals, tie_groups
from analysis.statistics.ranking import _largest_pairs, _one_with_all, _overlapping

CLEAR = [[0.0, 1.0, 2.0], [100.0, 101.0, 102.0], [100.5, 101.5, 102.5], [50.0, 51.0, 52.0]]


def test_what_is_clear_is_ordered() -> None:
    ties = tie_groups(CLEAR, rng=np.random.default_rng(0))
    assert ties.groups == ((2, 1), (3,), (0,))
    assert ties.with_leader == (2, 1)
    probabilities = probability_of_being_best(CLEAR, rng=np.random.default_rng(0))
    assert probabilities.sum() == pytest.approx(1.0)
    assert probabilities[[0, 3]] == pytest.approx(0.0, abs=1e-3)
    assert probabilities[2] > probabilities[1] > 0.1


def test_a_setting_may_tie_with_two_that_differ() -> None:
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((3, 20))
    ties = tie_groups(list(noise - noise.mean(axis=1, keepdims=True) + [[0.0], [0.75], [1.5]]), rng=rng)
    assert ties.groups == ((2, 1), (1, 0))
    assert ties.with_leader == (2,)


def test_groups_are_the_largest_sets_that_overlap() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        middles, halves = rng.uniform(0.0, 10.0, size=8), rng.uniform(0.1, 3.0, size=8)
        lower, upper = middles - halves, middles + halves
        meet = {pair for pair in itertools.combinations(range(8), 2) if max(lower[[*pair]]) <= min(upper[[*pair]])}
        choices = [choice for size in range(1, 9) for choice in itertools.combinations(range(8), size)]
        sets = [set(choice) for choice in choices if meet >= set(itertools.combinations(choice, 2))]
        largest = sorted(sorted(s) for s in sets if not any(s < other for other in sets))
        assert sorted(sorted(group) for group in _overlapping(lower, upper, np.arange(8))) == largest


def test_the_largest_pair_is_found_without_looking_at_all() -> None:
    rng = np.random.default_rng(0)
    draws, scales = rng.standard_normal((300, 6)), np.exp(rng.standard_normal(6))
    pairs = list(itertools.combinations(range(6), 2))
    by_hand = [max(abs(row[i] - row[j]) / (scales[i] + scales[j]) for i, j in pairs) for row in draws]
    assert _largest_pairs(draws, scales) == pytest.approx(by_hand)


def test_the_comparison_with_all_others_is_of_each_setting() -> None:
    rng = np.random.default_rng(0)
    draws, scales = rng.standard_normal((2_000, 6)), np.exp(rng.standard_normal(6))
    ratio = (draws[:, np.newaxis, :] - draws[:, :, np.newaxis]) / (scales + scales[:, np.newaxis])
    by_hand = np.quantile(ratio.max(axis=2), 0.95, axis=0).max()
    assert _one_with_all(draws, scales, 0.95, limit=10.0) == pytest.approx(by_hand, rel=0.01)


def test_the_generator_given_is_the_one_used() -> None:
    scores = list(np.random.default_rng(0).standard_normal((6, 3)))
    first, again, other = (probability_of_being_best(scores, rng=np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.tolist() == again.tolist() != other.tolist()
    widths = [tie_groups(scores, rng=np.random.default_rng(seed)).half_widths.tolist() for seed in (1, 1, 2)]
    assert widths[0] == widths[1] != widths[2]


def test_settings_that_nothing_tells_apart() -> None:
    rng = np.random.default_rng(0)
    assert probability_of_being_best([[1.0, 2.0]], rng=rng).tolist() == [1.0]
    assert probability_of_being_best([[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]], rng=rng) == pytest.approx([1 / 3] * 3)
    assert probability_of_being_best([[5.0, 5.0], [7.0, 7.0], [7.0, 7.0]], rng=rng).tolist() == [0.0, 0.5, 0.5]
    alone = tie_groups([[1.0, 2.0]], rng=rng)
    assert (alone.groups, alone.with_leader) == (((0,),), (0,))
    constant = tie_groups([[5.0, 5.0], [7.0, 7.0], [7.0, 7.0]], rng=rng)
    assert (constant.groups, constant.with_leader) == (((1, 2), (0,)), (1, 2))


def test_seeds_that_all_solve_are_no_proof() -> None:
    scores = [[500.0] * 3, [500.0, 500.0, 480.0], [500.0, 20.0, 100.0], [500.0, 500.0, 60.0]]
    assert tie_groups(scores, rng=np.random.default_rng(0)).with_leader[:2] == (0, 1)
    assert 0.3 < probability_of_being_best(scores, rng=np.random.default_rng(0))[0] < 0.6


def test_bad_values_of_settings() -> None:
    for bad, message in (([], "empty"), ([[1.0], [2.0]], "two seeds"), ([[1.0, math.nan]], r"settings\[0\].*finite")):
        with pytest.raises(ValueError, match=message):
            tie_groups(bad, rng=np.random.default_rng(0))
        with pytest.raises(ValueError, match=message):
            probability_of_being_best(bad, rng=np.random.default_rng(0))
    with pytest.raises(ValueError, match="num_draws 0 is less than 1"):
        probability_of_being_best([[1.0, 2.0]], rng=np.random.default_rng(0), num_draws=0)
    with pytest.raises(ValueError, match="level"):
        tie_groups([[1.0, 2.0]], rng=np.random.default_rng(0), level=95.0)


def test_thousands_of_settings() -> None:
    rng = np.random.default_rng(0)
    scores = list(rng.standard_normal((5_000, 3)) + np.linspace(0.0, 40.0, 5_000)[:, np.newaxis])
    probabilities = probability_of_being_best(scores, rng=rng, num_draws=50)
    assert probabilities.sum() == pytest.approx(1.0)
    ties = tie_groups(scores, rng=rng, num_draws=100)
    assert {setting for group in ties.groups for setting in group} == set(range(5_000))
    assert ties.with_leader[0] == int(np.argmax([estimate.mean for estimate in seed_intervals(scores)]))


def _sweeps(world: str, count: int) -> list[Simulated]:
    return [RANKED[world](np.random.default_rng(seed), 10, 5) for seed in range(count)]


@pytest.mark.parametrize(
    ("world", "edges"),
    [
        ("settings differ as much as seeds", (0.0, 0.1, 0.25, 0.45, 1.01)),
        ("solves in 0 to 100 %", (0.0, 0.1, 0.25, 1.01)),
    ],
)
def test_probabilities_of_being_best_are_calibrated(world: str, edges: tuple[float, ...]) -> None:
    """Of the settings that are given a probability, that share is the best, within 5 points, in bins.

    It can't be reached in the next test's world: a normal distribution of settings takes the leader of a crowd for one
    that stands out. Decision 28 has the figures of more worlds.
    """
    given, best = best_probabilities(_sweeps(world, 400), np.random.default_rng(1), 300)
    for low, high in itertools.pairwise(edges):
        chosen = (given >= low) & (given < high)
        assert best[chosen].mean() == pytest.approx(given[chosen].mean(), abs=0.05)


def test_below_a_ceiling_the_leader_is_believed_too_much() -> None:
    given, best = best_probabilities(_sweeps("best settings crowd below a ceiling", 200), np.random.default_rng(1), 300)
    assert 0.1 < (given - best)[given > 0.5].mean() < 0.35
    assert best[given < 0.25].mean() == pytest.approx(given[given < 0.25].mean(), abs=0.03)


TIED: dict[str, World] = {"all equal": partial(normal, spread=0.0)} | WORLDS


@pytest.mark.parametrize("world", ["all equal", "solves in 70 %", "30 % always, 20 % never, others any"])
def test_no_two_settings_are_said_to_differ_that_dont(world: str) -> None:
    """In at most 5 % of sweeps; 9 of 100 are let through, for the luck of 100 sweeps (two standard errors)."""
    rng = np.random.default_rng(11)
    wrong = lost = 0
    for _ in range(100):
        sweep = TIED[world](rng, 6, 5)
        ties = tie_groups(list(sweep.scores), rng=rng, num_draws=300)
        low, high = ties.means - ties.half_widths, ties.means + ties.half_widths
        not_better = sweep.truth[:, np.newaxis] <= sweep.truth + 1e-9
        wrong += bool(((low[:, np.newaxis] > high) & not_better).any())
        lost += int(sweep.truth.argmax()) not in ties.with_leader
    assert wrong <= 9
    assert lost <= 9
