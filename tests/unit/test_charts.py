"""The data of the report's charts: what is shown, what is marked, and what is said where nothing can be shown."""

import json
import math
from collections.abc import Sequence
from typing import Any

import pytest
from synthetic_sweep import Synthetic, make_sweep

from analysis.charts import Chart, Subject, make_charts, to_json
from analysis.charts.columns import MAX_SHOWN, column
from analysis.charts.model import Axis, HeatMap, Line, Panels, Parallel, Plot, Plots, Timeline, Trials
from analysis.charts.population import schedule
from analysis.importance import what_mattered
from analysis.records import ChangeRecord, TrialRecord

COLORS = {"light": {"--ink": "#000000"}, "dark": {"--ink": "#ffffff"}}
POINTS = [{"lr": lr, "activation": activation} for lr in (1e-4, 3e-3, 5e-3) for activation in ("relu", "linear")]


def charts_of(made: Synthetic, goal: float | None = 195.0) -> dict[str, Chart]:
    importance = what_mattered(made.sweep, made.trials, made.results, threshold=goal)
    subject = Subject(made.sweep, made.trials, made.results, goal, importance)
    return {chart.id: chart for chart in make_charts(subject)}


def trials_of(chart: Chart) -> Trials:
    assert isinstance(chart.data, Panels | Parallel)
    return chart.data.trials


def plots_of(chart: Chart) -> Plots:
    assert isinstance(chart.data, Plots)
    return chart.data


def changed(made: Synthetic, index: int, **changes: Any) -> None:
    made.trials[index] = made.trials[index].model_copy(update=changes)


@pytest.fixture
def made() -> Synthetic:
    return make_sweep(points=POINTS, seeds_per_point=2)


def test_every_varied_hyperparameter_has_a_panel_and_the_most_important_is_first() -> None:
    points = [
        {"noise": i % 2, "fixed": 1, "lr": lr, "activation": activation}
        for lr in (1e-7, 3e-3)
        for activation in ("relu", "linear")
        for i in range(4)
    ]
    trials = trials_of(charts_of(make_sweep(points=points, seeds_per_point=2))["hyperparameters"])
    names = [column.axis.name for column in trials.columns]
    assert sorted(names) == ["activation", "lr", "noise"]
    assert names[0] == "lr"


@pytest.mark.parametrize(
    ("values", "domain", "kind", "labels", "places"),
    [
        ([1e-3, 1e-2], {"loguniform": [1e-5, 1e-1]}, "log", (), (1e-3, 1e-2)),
        ([1e-3, 0.5], {"uniform": [0, 1]}, "value", (), (1e-3, 0.5)),
        ([4, 1], {"choice": [1, 4]}, "category", ("1", "4"), (1, 0)),
        ([[64], [32, 32]], {"choice": [[32, 32], [64]]}, "category", ("32x32", "64"), (1, 0)),
        (["b", "a"], {}, "category", ("b", "a"), (0, 1)),
        ([True, None], {"choice": [True, None]}, "category", ("True", "not set"), (0, 1)),
        ([1e-4, 1e-2], {}, "log", (), (1e-4, 1e-2)),
        ([-1.0, 100.0], {}, "value", (), (-1.0, 100.0)),
        ([1, "x"], {"choice": [1, "x"]}, "category", ("1", "x"), (0, 1)),
        (list(range(1, 41)), {"choice": list(range(1, 41))}, "log", (), tuple(range(1, 41))),
    ],
)
def test_a_hyperparameter_has_the_axis_that_it_was_searched_on(
    values: Sequence[Any], domain: dict[str, Any], kind: str, labels: tuple[str, ...], places: tuple[float, ...]
) -> None:
    found = column("name", values, {"name": domain} if domain else {})
    assert (found.axis.kind, found.axis.labels, found.values) == (kind, labels, places)


def test_trials_that_were_cut_or_failed_are_marked_wherever_they_are(made: Synthetic) -> None:
    changed(made, 1, status="stopped")
    changed(made, 3, status="failed", error="x")
    changed(made, 5, status="running")
    charts = charts_of(made)
    for name in ("hyperparameters", "parallel_coordinates"):
        trials = trials_of(charts[name])
        marked = {trials.ids[i]: ending for i, ending in enumerate(trials.endings) if ending != "whole"}
        assert marked == {"t0001": "cut", "t0003": "failed", "t0005": "unfinished"}
        assert trials.scores[3] is None
        assert any(
            "1 trial that a scheduler cut early and 1 trial that did not end" in note for note in charts[name].notes
        )
    heat_map = charts["heat_map"]
    assert isinstance(heat_map.data, HeatMap)
    assert sum(cell.count for cell in heat_map.data.cells) == len(made.trials) - 3
    assert heat_map.notes == ("2 trials that did not train to the end left out.",)
    hollow = [line for line in plots_of(charts["curves_of_settings"]).plots[0].lines if line.look == "hollow"]
    assert len(hollow) == 1
    assert "Settings with trials that did not train to the end are left out." in charts["performance_profile"].notes


def test_trials_that_were_cut_are_marked_where_all_are_of_leading_settings() -> None:
    made = make_sweep(points=POINTS[:3])
    for index in (1, 2):
        changed(made, index, status="stopped")
    lines = plots_of(charts_of(made)["curves_of_settings"]).plots[0].lines
    (hollow,) = [line for line in lines if line.look == "hollow"]
    ends = [made.results[trial_id][-1] for trial_id in ("t0001", "t0002")]
    assert hollow.x == tuple(item.num_env_steps for item in ends)
    assert "other trials" not in [line.name for line in lines]


def test_a_band_is_the_range_of_the_seeds_where_all_of_them_have_values(made: Synthetic) -> None:
    lines = plots_of(charts_of(made)["curves_of_settings"]).plots[0].lines
    bands = [line for line in lines if line.lower]
    assert bands
    for band in bands:
        assert all(low <= mid <= high for low, mid, high in zip(band.lower, band.y, band.upper, strict=True))  # type: ignore[operator]
        assert "(2 seeds)" in band.name
    shortest = min(items[-1].num_env_steps for items in made.results.values())
    assert min(float(band.x[-1] or 0) for band in bands) >= shortest


def test_one_seed_a_setting_has_no_band_and_no_profile_of_its_own() -> None:
    charts = charts_of(make_sweep(points=POINTS))
    assert not any(line.lower for line in plots_of(charts["curves_of_settings"]).plots[0].lines)
    assert [line.name for line in plots_of(charts["performance_profile"]).plots[0].lines] == ["all settings"]
    assert "One seed a setting" in charts["performance_profile"].notes[-1]


def test_best_so_far_is_over_the_env_steps_of_all_trials_in_the_order_of_time(made: Synthetic) -> None:
    for index in range(len(made.trials)):
        changed(made, index, started_at=1e9 - 100.0 * index, ended_at=1e9)
    (line,) = plots_of(charts_of(made)["best_so_far"]).plots[0].lines
    assert line.x[-1] == sum(items[-1].num_env_steps for items in made.results.values())
    assert list(line.y[:-1]) == sorted(set(line.y[:-1]), key=lambda value: value or 0.0)
    # The last trial began first.
    assert line.texts[0].startswith(made.trials[-1].trial_id)
    changed(made, 0, started_at=None)
    chart = charts_of(made)["best_so_far"]
    assert plots_of(chart).plots[0].lines[0].texts[0].startswith("t0000")
    assert "The records lack when trials began" in chart.notes[0]


def test_a_timeline_has_as_many_rows_a_node_as_trials_ran_there_at_once(made: Synthetic) -> None:
    for index in range(len(made.trials)):
        start = 1000.0 + 10 * (index // 4)
        node = f"192.0.2.{index % 2}/abc"
        changed(made, index, started_at=start, ended_at=start + 9, node=node, pid=7)
    timeline = charts_of(made)["timeline"].data
    assert isinstance(timeline, Timeline)
    assert timeline.y.labels == ("192.0.2.0, 1", "192.0.2.0, 2", "192.0.2.1, 1", "192.0.2.1, 2")
    assert [bar.row for bar in timeline.bars[:8]] == [0, 2, 1, 3] * 2
    assert timeline.x.name == "seconds since the first trial began"
    assert (timeline.bars[4].start, timeline.bars[4].end) == (10.0, 19.0)
    assert "not its core" in charts_of(made)["timeline"].notes[0]


def test_a_timeline_of_too_many_trials_draws_some_in_the_rows_of_all() -> None:
    made = make_sweep(points=[{"lr": 1e-5 * (i + 1)} for i in range(2_400)], max_steps=1024, with_best=False)
    for index in range(2_400):
        changed(made, index, started_at=1000.0 + index // 6, ended_at=1000.9 + index // 6)
    chart = charts_of(made)["timeline"]
    assert isinstance(chart.data, Timeline)
    assert (len(chart.data.bars), len(chart.data.y.labels)) == (2_000, 6)
    assert "2,000 of 2,400 trials are drawn, spread evenly." in chart.notes


def test_a_timeline_leaves_out_long_pauses_and_says_so(made: Synthetic) -> None:
    for index in range(len(made.trials)):
        start = 1000.0 + 10 * index + (86_400.0 if index > 4 else 0.0)
        changed(made, index, started_at=start, ended_at=start + 9)
    chart = charts_of(made)["timeline"]
    assert isinstance(chart.data, Timeline)
    assert [bar.start for bar in chart.data.bars[:4]] == [0.0, 10.0, 20.0, 30.0]
    # The pause of a second between trials went with the long one.
    assert [bar.start for bar in chart.data.bars[5:7]] == [49.0, 59.0]
    assert "1 pause in which no trial ran left out: 24 h 0 min." in chart.notes


def test_a_population_shows_what_each_trial_had_when(made: Synthetic) -> None:
    assert "schedules" not in charts_of(made)
    before = made.trials[0].point
    change = ChangeRecord(
        iteration=3, num_env_steps=3072, source_trial_id="t0004", source_iteration=2,
        before=before, after=before | {"lr": 2e-3}, time=0.0,
    )  # fmt: skip
    changed(made, 0, changes=(change,), point=before | {"lr": 2e-3})
    assert schedule(made.trials[0], "lr") == ([0, 3072, made.trials[0].num_env_steps], [1e-4, 2e-3, 2e-3])
    (shown,) = [plot for plot in plots_of(charts_of(made)["schedules"]).plots if plot.y.name == "lr"]
    assert shown.y.kind == "value"
    assert 2e-3 in [value for line in shown.lines for value in line.y]
    assert "ended with" in charts_of(made)["hyperparameters"].caption
    # A population has no setting to replicate.
    assert not any("replicate" in note for note in charts_of(made)["performance_profile"].notes)


def _with_scores(made: Synthetic, value: float) -> Synthetic:
    made.results = {
        trial_id: [
            item.model_copy(update={"training_return": value, "evaluation_return": value, "episode_returns": (value,)})
            for item in items
        ]
        for trial_id, items in made.results.items()
    }
    return made


def _pending(trials: Sequence[TrialRecord]) -> list[TrialRecord]:
    return [trial.model_copy(update={"status": "pending"}) for trial in trials]


@pytest.mark.parametrize(
    ("sweep", "said"),
    [
        (make_sweep(points=POINTS[:1]), {"hyperparameters": "One trial alone", "performance_profile": "at least two"}),
        (make_sweep(points=POINTS[:1] * 3), {"hyperparameters": "All trials have the same values"}),
        (make_sweep(points=[{"lr": 1e-3}, {"lr": 2e-3}]), {"heat_map": "two", "parallel_coordinates": "alone"}),
        (make_sweep(points=POINTS, failed=range(6)), {"hyperparameters": "No trial has a score"}),
        (_with_scores(make_sweep(points=POINTS), 200.0), {"hyperparameters": "6 scores are 200.0", "heat_map": "6"}),
        (_with_scores(make_sweep(points=POINTS), math.nan), {"hyperparameters": "No trial has a score"}),
        (make_sweep(points=POINTS, pending=range(6)), {"hyperparameters": "No trial has begun"}),
        (make_sweep(points=POINTS), {"timeline": "no times"}),
    ],
)  # fmt: skip
def test_a_chart_that_cannot_be_given_says_why(sweep: Synthetic, said: dict[str, str]) -> None:
    charts = charts_of(sweep)
    for name, words in said.items():
        assert charts[name].data is None
        assert words in charts[name].missing
    assert all((chart.data is None) == bool(chart.missing) for chart in charts.values())
    json.loads(to_json(list(charts.values()), COLORS))


def test_of_many_trials_the_best_and_an_even_choice_are_drawn_and_all_are_in_the_data() -> None:
    made = make_sweep(points=[{"lr": 1e-5 * (i + 1)} for i in range(700)], max_steps=2048, with_best=False)
    chart = charts_of(made)["hyperparameters"]
    trials = trials_of(chart)
    assert (len(trials.ids), len(trials.shown)) == (700, MAX_SHOWN)
    assert len(set(trials.shown)) == MAX_SHOWN
    best = sorted(range(700), key=lambda index: -(trials.scores[index] or 0.0))[:100]
    assert set(best) <= set(trials.shown)
    assert any("500 of 700 trials are drawn" in note for note in chart.notes)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1_234_567.0, "1234567"), (123_456_789_012.0, "123456789012"), (0.0, "0"), (1_000_000.25, "1000000.25"),
        (0.1 + 0.2, "0.3"), (1e15, "1000000000000000.0"), (math.nan, "null"), (math.inf, "null"), (1e300, "1e+100"),
    ],
)  # fmt: skip
def test_whole_numbers_keep_their_digits_in_the_data(value: float, text: str) -> None:
    plot = Plot(Axis("x"), Axis("y"), (Line("line", "muted", (1,), (value,)),))
    assert f'"y":[{text}]' in to_json([Chart("id", "cost", "title", "caption", Plots((plot,)))], COLORS)


def test_the_data_can_stand_in_a_page_whatever_texts_they_hold() -> None:
    hostile = "</script><!--<script>\u2028"
    made = make_sweep(points=[{"activation": hostile, "lr": 1e-3}, {"activation": "relu", "lr": 4e-3}])
    charts = charts_of(made)
    text = to_json(list(charts.values()), COLORS)
    assert "<" not in text
    assert "\u2028" not in text
    document = json.loads(text)
    assert any(hostile in item["axis"].get("labels", ()) for item in document["trials"]["columns"])
    assert [chart["id"] for chart in document["charts"]] == [name for name, chart in charts.items() if chart.data]
