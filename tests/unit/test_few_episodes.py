"""Few episodes of a policy have an interval that covers the truth, and one has none."""

from typing import Any

import numpy as np
import pytest
from fake_sweeps import evaluation
from store_parts import make_best
from synthetic_sweep import make_sweep_record

from analysis.answers import compared_with_random
from analysis.choice_words import _confirmed
from analysis.page.answer import _confirmed as answered
from analysis.page.cards import winner_card
from analysis.statistics import episodes_interval, mean_with_ci, t_interval


@pytest.mark.parametrize("num_episodes", [2, 3, 5, 10, 19])
def test_the_interval_of_few_covers_the_truth(num_episodes: int) -> None:
    """By the percentile bootstrap 51, 75, 83 and 89 % would."""
    rng = np.random.default_rng(0)
    found = [episodes_interval(rng.normal(size=num_episodes), rng=rng) for _ in range(2_000)]
    # Four standard errors of 2,000 draws at 95 %.
    assert np.mean([each.lower <= 0 <= each.upper for each in found]) == pytest.approx(0.95, abs=0.02)


def test_many_are_resampled() -> None:
    returns = np.random.default_rng(1).exponential(size=20)
    found = episodes_interval(returns, rng=np.random.default_rng(0))
    assert found == mean_with_ci(returns, rng=np.random.default_rng(0))
    assert episodes_interval(returns[:19], rng=np.random.default_rng(0)) == t_interval(returns[:19])


def test_one_episode_has_no_interval() -> None:
    with pytest.raises(ValueError, match="one value has no interval"):
        episodes_interval([1.0], rng=np.random.default_rng(0))
    assert _confirmed(evaluation("p", 10.0), "-") == "10.0"
    assert answered(evaluation("p", 10.0, threshold=None)) == "10.0 over 1 fresh episode."
    card = shown([10.0], [5.0])
    assert (card["interval"], card["gain"]) == (None, None)


def test_several_equal_ones_are_told_as_such() -> None:
    assert _confirmed(evaluation("p", 10.0, 10.0), "-") == "10.0 (all 2 equal)"


def test_two_episodes_have_an_interval_beyond_them() -> None:
    # 15 -+ 12.706 x 7.071 / sqrt(2).
    assert _confirmed(evaluation("p", 10.0, 20.0), "-") == "15.0 (-48.5 to 78.5)"
    assert "-48.5 to 78.5 with 95 %" in answered(evaluation("p", 10.0, 20.0))
    interval = shown([10.0, 20.0], [0.0, 0.0])["interval"]
    assert (interval.lower, interval.upper) == pytest.approx((-48.531, 78.531), abs=1e-3)


@pytest.mark.parametrize("num_episodes", [3, 30])
def test_the_gain_on_random_play_says_what_the_verdict_says(num_episodes: int) -> None:
    rng, verdicts = np.random.default_rng(0), set()
    for _ in range(50):
        ours, random = rng.normal(0.8, 1.0, num_episodes), rng.normal(0.0, 1.0, num_episodes)
        card = shown(ours.tolist(), random.tolist())
        best = make_best(confirmation=evaluation("p", *ours), random=evaluation("r", *random))
        is_better = card["gain"].lower > 0
        assert (compared_with_random(best) == "better") == is_better
        verdicts.add(is_better)
    assert verdicts == {True, False}


def shown(ours: list[float], random: list[float]) -> dict[str, Any]:
    best = make_best(confirmation=evaluation("p", *ours), random=evaluation("r", *random))
    return winner_card(best, [], make_sweep_record("mine", "ppo", "CartPole-v0", [], 1), "sweeps/mine")
