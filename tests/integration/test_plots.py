"""The figures hold the data, on any kind of sweep, and become safe, themeable SVG."""

from __future__ import annotations

import io
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from synthetic_sweep import Synthetic, make_points, make_sweep

from analysis.page.files import write_figure
from analysis.plot_style import (
    CSS_DARK,
    CSS_LIGHT,
    INK,
    PALETTE,
    group_names,
    group_styles,
    numeric_names,
    to_png,
    to_svg,
)
from analysis.plots import learning_curves, score_by_lr, score_per_episode
from tests.narrowing import present

if TYPE_CHECKING:
    from matplotlib.axes._axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


@pytest.fixture(scope="module")
def synthetic() -> Synthetic:
    return make_sweep(failed={3}, pending={5})


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def lines_longer_than(axes: Axes, length: int) -> list[Line2D]:
    return [
        line for line in axes.lines if len(cast("Any", line.get_xdata())) > length and line.get_linestyle() != "None"
    ]


def test_every_trial_with_results_has_its_curve(synthetic: Synthetic) -> None:
    winner = present(synthetic.best).checkpoint.trial_id
    axes = learning_curves(synthetic.trials, synthetic.results, threshold=195.0, winner=winner).axes[0]
    curves = lines_longer_than(axes, 2)
    assert len(curves) == 19
    expected = {tuple(row.training_return for row in rows) for rows in synthetic.results.values() if rows}
    assert {tuple(cast("Any", line.get_ydata())) for line in curves} == expected
    thick = [line for line in curves if line.get_linewidth() == 3.0]
    assert [tuple(cast("Any", line.get_ydata())) for line in thick] == [
        tuple(row.training_return for row in synthetic.results[winner])
    ]
    assert axes.get_xlabel() == "env steps"
    assert "training return" in axes.get_ylabel()


def test_legend_names_groups_goal_winner_and_failure(synthetic: Synthetic) -> None:
    figure = learning_curves(
        synthetic.trials, synthetic.results, threshold=195.0, winner=present(synthetic.best).checkpoint.trial_id
    )
    labels = legend_of(figure)
    assert {"32 · linear", "32 · relu", "64 · linear", "64 · relu", "failed", "goal 195"} <= set(labels)
    assert "winner: greedy evaluation" in labels
    assert len(labels) == len(set(labels))


def test_long_curves_are_thinned_but_keep_their_ends() -> None:
    long = make_sweep(points=[{"lr": 1e-6}], max_steps=1_000_000)
    axes = learning_curves(long.trials, long.results, threshold=None).axes[0]
    (line,) = lines_longer_than(axes, 2)
    rows = long.results["t0000"]
    assert len(cast("Any", line.get_xdata())) == 300
    assert (cast("Any", line.get_xdata())[0], cast("Any", line.get_xdata())[-1]) == (
        rows[0].num_env_steps,
        rows[-1].num_env_steps,
    )


def test_the_range_over_the_seeds_of_the_winning_point_is_drawn() -> None:
    several = make_sweep(points=make_points(1, np.random.default_rng(0)), seeds_per_point=3)
    winner = present(several.best).checkpoint.trial_id
    figure = learning_curves(several.trials, several.results, threshold=195.0, winner=winner)
    assert "winner: range of 3 seeds" in legend_of(figure)


def test_scores_stand_at_their_learning_rates(synthetic: Synthetic) -> None:
    figure = score_by_lr(synthetic.trials, threshold=195.0, winner=present(synthetic.best).checkpoint.trial_id)
    axes = figure.axes[0]
    groups = [c for c in axes.collections if c.get_label() in {"32 · linear", "32 · relu", "64 · linear", "64 · relu"}]
    drawn = {tuple(xy) for collection in groups for xy in np.asarray(collection.get_offsets())}
    assert drawn == {
        (trial.point["lr"], trial.best_evaluation_return) for trial in synthetic.trials if trial.status == "completed"
    }
    assert axes.get_xscale() == "log"
    assert axes.get_xlabel() == "lr"
    ring = next(c for c in axes.collections if c.get_label() == "winner")
    assert np.asarray(ring.get_offsets()).tolist() == [
        [present(synthetic.best).point["lr"], present(synthetic.best).selection_score]
    ]


def test_trials_that_cannot_win_are_marked_at_the_edge(synthetic: Synthetic) -> None:
    axes = score_by_lr(synthetic.trials).axes[0]
    lost = next(c for c in axes.collections if str(c.get_label()).startswith("no score"))
    assert [x for x, _ in np.asarray(lost.get_offsets())] == [synthetic.trials[3].point["lr"]]


@pytest.mark.parametrize(
    ("values", "scale"), [([1e-4, 2e-4, 9e-4], "linear"), ([1e-4, 2e-3], "log"), ([0.0, 1.0], "linear")]
)
def test_the_axis_is_logarithmic_beyond_a_decade(values: list[float], scale: str) -> None:
    sweep = make_sweep(points=[{"gamma": value} for value in values])
    axes = score_by_lr(sweep.trials).axes[0]
    assert (axes.get_xlabel(), axes.get_xscale()) == ("gamma", scale)


def test_without_a_searched_number_the_groups_stand_side_by_side() -> None:
    sweep = make_sweep(points=[{"activation": name} for name in ("relu", "relu", "tanh")])
    axes = score_by_lr(sweep.trials).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["relu", "tanh"]
    assert axes.get_xlabel() == "activation"


def test_lr_is_the_axis_where_there_are_several_numbers() -> None:
    points = [{"gamma": 0.9 + i / 100, "lr": 10.0**-i, "use": bool(i % 2), "fixed": 1} for i in range(1, 4)]
    trials = make_sweep(points=points).trials
    assert numeric_names(trials) == ["lr", "gamma"]
    assert group_names(trials, "lr") == ["gamma", "use"]


@pytest.mark.parametrize("values", [(None, 0.5, 10.0), ([64, 64], 64, 32), (math.nan, 0.1, 0.5), ("auto", 0.1, 0.5)])
def test_what_is_no_number_in_some_trials_is_no_axis_of_numbers(values: tuple[Any, ...]) -> None:
    sweep = make_sweep(points=[{"x": value} for value in values])
    assert numeric_names(sweep.trials) == []

    def places(name: str | None) -> list[float]:
        axes = score_by_lr(sweep.trials, name=name).axes[0]
        return [float(x) for each in axes.collections for x in np.asarray(each.get_offsets())[:, 0]]

    # Beside each other, by the value.
    assert sorted(round(place) for place in places(None)) == [0, 1, 2]
    # On an axis that is asked for the first one has no place.
    assert sorted(places("x")) == sorted(float(value) for value in values[1:])


def test_trials_whose_points_are_not_chosen_yet_keep_an_axis() -> None:
    trials = make_sweep(points=[{"lr": 1e-3}, {"lr": 2e-3}, {}], pending={2}).trials
    assert numeric_names(trials) == ["lr"]


def test_a_hyperparameter_of_many_values_makes_no_groups() -> None:
    trials = make_sweep(points=[{"lr": 1e-3, "num_epochs": i} for i in range(1, 9)]).trials
    assert group_names(trials, None) == []


def test_groups_differ_in_colour_and_marker(synthetic: Synthetic) -> None:
    styles = set(group_styles(synthetic.trials, ["hidden_sizes", "activation"]).values())
    assert len({style.color for style in styles}) == 4
    assert {(style.label.split(" · ")[0], style.marker) for style in styles} == {("32", "o"), ("64", "s")}
    assert {(style.label.split(" · ")[1], style.line) for style in styles} == {("linear", "-"), ("relu", "--")}


def test_score_per_episode_has_goal_trend_and_histogram_of_the_last_fifty() -> None:
    scores = np.concatenate([np.arange(150.0), np.full(50, 199.0)])
    figure = score_per_episode(scores, goal=195.0, title="trial t0001")
    left, right = figure.axes
    dots = next(line for line in left.lines if line.get_label() == "score")
    assert cast("Any", dots.get_ydata()).tolist() == scores.tolist()
    assert cast("Any", dots.get_xdata())[0] == 1
    trend = next(line for line in left.lines if line.get_label() == "linear trend")
    slope = (cast("Any", trend.get_ydata())[1] - cast("Any", trend.get_ydata())[0]) / 199
    assert slope == pytest.approx(np.polyfit(np.arange(1, 201), scores, 1)[0])
    mean = next(line for line in left.lines if line.get_label() == "mean of last 100")
    assert cast("Any", mean.get_ydata())[-1] == pytest.approx(scores[-100:].mean())
    assert sum(cast("Any", patch).get_height() for patch in right.patches) == 50
    assert max(cast("Any", patch).get_height() for patch in right.patches) == 50
    assert right.get_title(loc="left") == "last 50 episodes"
    assert left.get_title(loc="left") == "trial t0001"
    assert "goal 195" in legend_of(figure)


@pytest.mark.parametrize("returns", [[7.0], [0.0, 0.0], [-200.0, -180.0, -90.5]])
@pytest.mark.parametrize("goal", [None, 0.0])
def test_few_or_negative_scores_still_draw(returns: list[float], goal: float | None) -> None:
    figure = score_per_episode(returns, goal=goal)
    assert sum(cast("Any", patch).get_height() for patch in figure.axes[1].patches) == len(returns)
    assert ("goal 0" in legend_of(figure)) == (goal is not None)
    if goal is not None:
        assert figure.axes[0].get_ylim()[1] > goal
    assert to_png(figure, dpi=40).startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("returns", "goal"), [([0.0, 1e-3], None), ([0.0, 1e-3], 2e-3), ([-1e-3, -5e-4], None), ([3e-3, 3e-3], None)]
)
def test_small_scores_fill_their_plot(returns: list[float], goal: float | None) -> None:
    low, high = score_per_episode(returns, goal=goal).axes[0].get_ylim()
    shown = [0.0 if min(returns) > 0 else min(returns), max(*returns, goal or max(returns))]
    assert high - low == pytest.approx(1.06 * (shown[1] - shown[0]))


def test_no_episode_is_an_error() -> None:
    with pytest.raises(ValueError, match="at least one episode"):
        score_per_episode([], goal=1.0)


@pytest.mark.parametrize("kind", ["none usable", "one trial", "no results"])
def test_poor_sweeps_still_draw(kind: str) -> None:
    sweep = {
        "none usable": lambda: make_sweep(failed=range(20)),
        "one trial": lambda: make_sweep(points=[{}]),
        "no results": lambda: make_sweep(pending=range(20)),
    }[kind]()
    for figure in (learning_curves(sweep.trials, sweep.results, threshold=195.0), score_by_lr(sweep.trials)):
        assert to_svg(figure, label="x", prefix="x").startswith("<svg")


def test_svg_follows_the_theme_and_keeps_its_ids_apart() -> None:
    figure = score_per_episode([1.0, 2.0, 3.0], goal=2.0)
    svg = to_svg(figure, label='a "label"', prefix="one")
    assert f"var(--ink, {INK})" in svg
    assert f": {INK}" not in svg
    assert all(f": {color}" not in svg for color in PALETTE)
    assert set(re.findall(r"var\((--[\w-]+)", svg)) <= set(CSS_LIGHT) == set(CSS_DARK)
    assert all(name.startswith("one-") for name in re.findall(r'\bid="([^"]+)"', svg))
    targets = re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', svg)
    assert targets
    assert {first or second for first, second in targets} <= set(re.findall(r'\bid="([^"]+)"', svg))
    assert 'aria-label="a &quot;label&quot;"' in svg
    assert svg == to_svg(score_per_episode([1.0, 2.0, 3.0], goal=2.0), label='a "label"', prefix="one")


def test_a_figure_is_laid_out_once_and_drawn_once_a_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    def made() -> Figure:
        return score_per_episode([1.0, 20.0, 300.0], goal=200.0, size=(3.8, 4.8))

    expected = made()
    expected.savefig(io.StringIO(), format="svg")
    calls: list[str] = []
    for owner, name in ((Figure, "draw"), (ConstrainedLayoutEngine, "execute")):
        original = getattr(owner, name)

        def counted(*args: Any, call: Any = original, told: str = name) -> Any:
            calls.append(told)
            return call(*args)

        monkeypatch.setattr(owner, name, counted)
    figure = made()
    write_figure(figure, tmp_path / "figure", png=True)
    assert calls == ["execute", "draw", "draw", "draw"]
    positions = [[axes.get_position().bounds for axes in one.axes] for one in (figure, expected)]
    assert np.allclose(positions[0], positions[1], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("text", ["$x^$", "$\\frac{1}$", "<script>alert(1)</script>", "--><img src=x>", "& < >"])
def test_hostile_labels_are_only_text(text: str) -> None:
    sweep = make_sweep(points=[{"activation": text, "lr": 1e-3}, {"activation": "relu", "lr": 2e-3}])
    figures = [
        learning_curves(sweep.trials, sweep.results, threshold=None),
        score_by_lr(sweep.trials),
        score_per_episode([1.0, 2.0], goal=None, title=text),
    ]
    for figure in figures:
        svg = to_svg(figure, label=text, prefix="x")
        assert "<script" not in svg
        assert "<img" not in svg
        assert "<!--" not in svg


def test_no_screen_and_no_pyplot_are_needed() -> None:
    code = (
        "import sys; sys.modules['matplotlib.pyplot'] = None\n"
        "from analysis.plots import score_per_episode\n"
        "from analysis.plot_style import to_png, to_svg\n"
        "assert 'matplotlib' not in sys.modules\n"
        "figure = score_per_episode([1.0, 2.0], goal=1.0)\n"
        "assert to_png(figure) and to_svg(figure, label='a', prefix='a')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)
