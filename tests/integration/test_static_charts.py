"""The charts as figures: every kind is drawn, and its axes reach as far as its data."""

import itertools

import numpy as np
import pytest
from synthetic_sweep import make_sweep

from analysis.charts import Chart, Subject, draw, make_charts
from analysis.charts.columns import column
from analysis.charts.model import Axis, Ending, Line, Panels, Plot, Plots, Trials
from analysis.importance import what_mattered


@pytest.fixture(scope="module")
def charts() -> dict[str, Chart]:
    points = [{"lr": lr, "activation": activation} for lr in (1e-4, 3e-3, 5e-3) for activation in ("relu", "$x$")]
    made = make_sweep(points=points, failed={2}, max_steps=20_000)
    times = {"started_at": 1e9, "ended_at": 1e9 + 9}
    made.trials = [
        trial.model_copy(update=times | ({"status": "stopped"} if trial.index == 1 else {})) for trial in made.trials
    ]
    importance = what_mattered(made.sweep, made.trials, made.results, threshold=195.0)
    return {chart.id: chart for chart in make_charts(Subject(made.sweep, made.trials, made.results, 195.0, importance))}


def test_every_chart_is_drawn(charts: dict[str, Chart]) -> None:
    assert len(charts) == 7
    for chart in charts.values():
        assert draw(chart).axes


@pytest.mark.parametrize("name", ["curves_of_settings", "best_so_far"])
def test_an_axis_that_begins_at_zero_reaches_as_far_as_the_data(charts: dict[str, Chart], name: str) -> None:
    low, high = draw(charts[name]).axes[0].get_xlim()
    data = charts[name].data
    assert isinstance(data, Plots)
    assert low == 0
    assert high >= max(x for line in data.plots[0].lines for x in line.x if x is not None)


@pytest.mark.parametrize(("num", "last"), [(6, "activation size 005"), (7, "1 other value"), (60, "54 other values")])
def test_panels_of_many_categories_keep_their_room(num: int, last: str) -> None:
    values = [f"size {i:03d}" for i in range(num)]
    endings: tuple[Ending, ...] = tuple("whole" for _ in values)
    trials = Trials(
        tuple(map(str, range(num))), Axis("score"), tuple(map(float, range(num))), endings,
        (column("activation", values, {}), column("lr", np.linspace(0.1, 0.2, num).tolist(), {})), tuple(range(num)),
    )  # fmt: skip
    figure = draw(Chart("hyperparameters", "mattered", "title", "caption", Panels(trials)))
    # Where nothing fits, matplotlib warns and leaves the axes as they were.
    figure.draw_without_rendering()
    (legend,) = figure.legends
    keys = [text.get_text() for text in legend.get_texts()]
    assert (len(keys), keys[-1]) == (min(num, 7), last)
    assert all(axes.get_position().height * figure.get_figheight() > 1.0 for axes in figure.axes)
    boxes = [label.get_window_extent() for label in figure.axes[0].get_xticklabels()]
    assert all(one.x1 <= two.x0 for one, two in itertools.pairwise(boxes))


def test_hollow_marks_are_trials_that_were_cut(charts: dict[str, Chart]) -> None:
    (dots,) = draw(charts["hyperparameters"]).axes[0].collections
    faces = dots.get_facecolors()  # type: ignore[attr-defined]
    assert [index for index, face in enumerate(faces) if face[3] == 0] == [1, 2]
    # The second of them failed: it has no score, and is a cross at the edge.
    assert np.isnan(np.ma.filled(dots.get_offsets(), np.nan)).any(axis=1).tolist() == [index == 2 for index in range(6)]


def test_a_chart_without_data_is_not_drawn() -> None:
    with pytest.raises(ValueError, match="no trials"):
        draw(Chart("id", "cost", "title", "caption", None, "no trials"))


def test_gaps_stay_gaps() -> None:
    line = Line("a", "series-0", (1, 2, None, 1, 2), (1, 2, None, 3, 4))
    figure = draw(Chart("id", "cost", "title", "caption", Plots((Plot(Axis("x"), Axis("y"), (line,)),))))
    assert figure.axes[0].lines[0].get_xydata().shape == (5, 2)  # type: ignore[union-attr]
