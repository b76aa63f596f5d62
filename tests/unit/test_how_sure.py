"""How sure a ranking of settings is, as the report shows it."""

from typing import Any

import numpy as np
import pytest
from report_sources import setting, settings_of, source_of
from synthetic_sweep import make_points, make_sweep

from analysis.page import how_sure
from analysis.page.scores import interval_of, score_text
from analysis.report_tables import steps_table


def test_settings_that_share_a_letter_are_not_told_apart() -> None:
    synthetic = make_sweep(points=[{"lr": 3e-3}, {"lr": 3.1e-3}, {"lr": 1e-7}], seeds_per_point=4)
    table = how_sure.settings_table(source_of(synthetic))
    letters = [row[-1].text for row in table.rows]
    assert table.headings[-1] == "tie group"
    assert letters[0] == letters[1] == "a"
    assert letters[2] == "b"
    assert [row[0].text for row in table.rows] == ["1", "2", "3"]


def test_env_steps_to_the_threshold_are_shown_as_such() -> None:
    scores = {"scores": (-9000.0, -11000.0), "score": -10000.0, "lower": -14000.0, "upper": -6000.0}
    settings = settings_of(
        setting(1, ["t0000", "t0001"], 2, probability_best=0.5, **scores),
        setting(2, ["t0002", "t0003"], 2, probability_best=0.5, **scores | {"upper": 2000.0}),
        objective="steps_to_threshold",
    )
    first, second = settings.ranking
    assert score_text(settings, first.score) == "10,000"
    assert interval_of(settings, first) == "6,000 to 14,000"
    assert interval_of(settings, second) == "0 to 14,000"
    source = source_of(make_sweep(points=make_points(1, np.random.default_rng(0)), seeds_per_point=2), settings)
    one, two = how_sure.strips(source)
    assert one.scores == (9000.0, 11000.0)
    assert one.interval == (6000.0, 14000.0)
    assert two.interval == (0.0, 14000.0)


def test_labels_that_are_too_long_are_left_to_the_table() -> None:
    def labels(point: dict[str, Any]) -> list[str]:
        synthetic = make_sweep(points=[{"lr": 3e-3} | point, {"lr": 1e-3} | point])
        return [strip.label for strip in how_sure.strips(source_of(synthetic))]

    assert labels({"activation": "relu"}) == ["1.  0.001 · relu", "2.  0.003 · relu"]
    assert labels({f"name{index}": "a long value" for index in range(4)}) == ["1.", "2."]


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([{"double_q": True, "lr": 3e-3}, {"double_q": False, "n_step": 2, "tau": 0.5, "lr": 3e-6}], "double_q True, "),
        ([{"grad_clip": None, "lr": 3e-3}, {"grad_clip": 0.5, "lr": 3e-6}], "grad_clip –, "),  # noqa: RUF001
        ([{"hidden_sizes": [64, 64], "lr": 3e-3}, {"n_step": 2, "lr": 3e-6}], "hidden_sizes 64x64, "),
    ],
)
def test_what_solves_first_is_told_by_what_acts_in_it(points: list[dict[str, Any]], said: str) -> None:
    synthetic = make_sweep(points=points, threshold=195.0)
    text = how_sure.fewest_env_steps(synthetic.trials, synthetic.results, 195.0)
    assert text.startswith(f"{said}lr 0.003 reaches a mean training return of 195 ")


def test_a_seed_that_was_not_trained_or_still_trains_is_not_called_unsolved() -> None:
    """Points have different numbers of seeds once some were given more, as by `confirm`."""
    made = make_sweep(points=[{"lr": 3e-3}, {"lr": 2.5e-3}], with_best=False)
    first, second = made.trials
    rows = made.results["t0000"]

    def told(**of_third: Any) -> list[str]:
        more = [first.model_copy(update={"trial_id": f"t000{k + 1}", "index": k + 1, "seed_index": k}) for k in (1, 2)]
        trials = [first, second, more[0], more[1].model_copy(update=of_third)]
        results = made.results | {"t0002": rows, "t0003": rows[:3]}
        return [row[-1].text for row in steps_table(trials, results, goal=195.0).rows]

    one, other = (f"{made.results[trial_id][-1].num_env_steps:,}" for trial_id in ("t0000", "t0001"))
    assert told() == [f"{one}, {one}, not solved", other]
    assert told(status="failed") == [f"{one}, {one}, not solved", other]
    assert told(status="running") == [f"{one}, {one}, not ended yet", other]
    assert told(status="pending") == [f"{one}, {one}, not ended yet", other]


def test_nothing_is_compared_where_there_is_one_setting() -> None:
    source = source_of(make_sweep(points=[{"lr": 3e-3}], seeds_per_point=3))
    assert how_sure.strips(source) == []
    assert how_sure.settings_table(source).rows == []
