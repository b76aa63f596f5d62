"""A race gives the leading settings more seeds, and changes nothing of what is said of all settings together."""

from itertools import pairwise

import numpy as np
import pytest
from compared_sweeps import the_pair, wanted
from synthetic_sweep import make_sweep, make_sweep_record
from test_charts import POINTS, charts_of, plots_of

from analysis.comparison.compare import compare
from analysis.comparison.page import profile_figure
from analysis.first_seeds import first_seeds
from analysis.objectives import SettingScores
from tests.narrowing import present

RACED = [9.0, 5.0, 5.0, 5.0], [1.0]
"""The first setting led by a lucky seed; the unlucky one of the other stays its only one."""


def test_of_each_setting_as_many_count_as_all_have() -> None:
    settings = [
        SettingScores(index, {}, scores, tuple("abc")[: len(scores)], 0, 0.0, ())
        for index, scores in enumerate([(1.0, 2.0, 3.0), (4.0,)])
    ]
    (one, three) = (make_sweep_record("a", "ppo", "CartPole-v0", [], number) for number in (1, 3))
    assert first_seeds(settings, one) == [(1.0,), (4.0,)]
    # It runs, and two of the other's three seeds have not ended.
    assert first_seeds(settings, three) == [(1.0, 2.0, 3.0), (4.0,)]
    assert first_seeds(settings[:1], one) == [(1.0, 2.0, 3.0)]
    assert first_seeds([], one) == []


@pytest.mark.parametrize("num_seeds", [1, 3, 4])
def test_a_sweep_that_raced_is_not_the_worse_in_the_settings_that_both_have(num_seeds: int) -> None:
    plain = [[7.0] * num_seeds, [3.0] * num_seeds]
    for sweeps in ([wanted("a", *RACED), wanted("b", *plain)], [wanted("b", *plain), wanted("a", *RACED)]):
        shared = present(the_pair(compare(sweeps)).shared)
        assert shared.probability.mean == 0.5
        assert (shared.left_iqm.mean, shared.right_iqm.mean) == (5.0, 5.0)


def test_a_sweep_that_raced_has_the_profile_of_its_first_seeds() -> None:
    both = [wanted("a", *RACED), wanted("b", [9.0], [1.0])]
    figure = present(profile_figure(compare(both), dict(zip("AB", both, strict=True)), (9.0, 4.2)))
    ours, theirs = figure.axes[0].lines
    np.testing.assert_array_equal(ours.get_ydata(), theirs.get_ydata())
    assert (ours.get_label(), theirs.get_label()) == ("A: a (2)", "B: b (2)")
    # All of a setting's own.
    alone = [wanted("a", *RACED, point_index=index) for index in (0, 1)]
    figure = present(profile_figure(compare(alone), dict(zip("AB", alone, strict=True)), (9.0, 4.2)))
    assert [line.get_label() for line in figure.axes[0].lines] == ["A: a/p0 (4)", "B: a/p1 (1)"]


def test_the_reports_profile_of_all_settings_is_of_their_first_seeds() -> None:
    made = make_sweep(points=POINTS)
    before = charts_of(made)["performance_profile"]
    assert not any("first" in note for note in before.notes)
    # A race's seeds come to the same as the first.
    for index, (trial_id, seed_index) in enumerate([("t0003", 1), ("t0005", 1), ("t0003", 2)], start=6):
        first = next(trial for trial in made.trials if trial.trial_id == trial_id)
        named = {"trial_id": f"t{index:04d}", "index": index, "seed_index": seed_index, "seed": 1000 + index}
        made.trials.append(first.model_copy(update=named))
        made.results[f"t{index:04d}"] = made.results[trial_id]
    after = charts_of(made)["performance_profile"]
    lines = [plots_of(chart).plots[0].lines for chart in (before, after)]
    for one, other in pairwise(found[0] for found in lines):
        assert (one.name, one.x, one.y, one.lower) == (other.name, other.x, other.y, other.lower)
    # Each setting has its own seeds.
    assert any("(3 seeds)" in line.name for line in lines[1])
    assert any("as many seeds of each as every one has" in note for note in after.notes)
