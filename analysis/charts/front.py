"""The chart of score against cost, with its Pareto front; only of a sweep that asks for it."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.charts.model import Axis, Chart, Line, Number, Plot, Plots, drawable
from analysis.charts.subject import Subject
from analysis.front import costs_lie_far_apart, front_of, other_settings, settings_on_front, untrained_return
from analysis.objectives import SettingScores

_FRONT = "the front"
_MAX_DRAWN = 2_000


def make_charts(subject: Subject) -> list[Chart]:
    """Return the chart, if the sweep sets scores against a cost and has settings to compare."""
    ranking = [] if subject.is_population or subject.cost is None else subject.settings
    front = front_of(ranking, untrained_return(subject.results))
    if front is None or len(ranking) < 2:
        return []
    by_point = {item.point_index: item for item in ranking}
    # All of it, where the record lists some: the line is said to have nothing above it.
    on_front = settings_on_front(ranking)
    may_be = [by_point[item.point_index] for item in front.undecided]
    others = other_settings(ranking, front, _MAX_DRAWN)
    num_others = len(ranking) - len(on_front) - len(may_be)
    notes = [f"{_MAX_DRAWN:,} of {num_others:,} other settings are drawn."] if num_others > _MAX_DRAWN else []
    lines = [_dots(subject, "other settings", "muted", others)]
    lines += [_dots(subject, "may be on the front", "series-1", may_be, look="hollow")]
    lines += [_dots(subject, _FRONT, "series-0", on_front), _front(subject, on_front, [item.cost for item in ranking])]
    near = by_point[front.cheapest_near.point_index]
    lines += [_dots(subject, "the best", "accent", [ranking[0]])]
    if near is not ranking[0]:
        lines += [_dots(subject, "the cheapest near it", "series-2", [near])]
    x = (
        Axis("env steps of a training, mean over seeds", "log")
        if costs_lie_far_apart(ranking)
        else Axis("env steps of a training, mean over seeds", low=0)
    )
    plot = Plot(x, Axis(subject.score_name), tuple(line for line in lines if line.x), goal=_goal(subject))
    title = "Score against cost, and the front"
    caption = "Each dot is a setting, by its expected mean over seeds; no setting that was scored lies above the line."
    return [Chart("score_against_cost", "front", title, caption, Plots((plot,)), notes=tuple(notes))]


def _goal(subject: Subject) -> Number:
    return drawable(subject.goal)


def _front(subject: Subject, on_front: Sequence[SettingScores], costs: Sequence[float]) -> Line:
    """Return what is to be had for each cost, as steps, drawn on to the greatest cost."""
    x: list[Number] = [item.cost for item in on_front]
    y: list[Number] = [drawable(item.expected) for item in on_front]
    texts = [_text(subject, item) for item in on_front]
    return Line(
        _FRONT, "series-0", (*x, max(costs)), (*y, y[-1]), is_stepped=True, texts=(*texts, "the dearest setting")
    )


def _dots(subject: Subject, name: str, color: str, settings: Sequence[SettingScores], look: str = "dots") -> Line:
    return Line(
        name, color,
        tuple(item.cost for item in settings), tuple(drawable(item.expected) for item in settings),
        look="hollow" if look == "hollow" else "dots", texts=tuple(_text(subject, item) for item in settings),
    )  # fmt: skip


def _text(subject: Subject, item: SettingScores) -> str:
    return subject.setting_name(item)
