"""A comparison as one HTML file that needs no other, in the style of the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.comparison.compare import Comparison
from analysis.comparison.entries import Entry, Wanted, judged_alike
from analysis.comparison.wording import fact_rows, pair_lines
from analysis.exports.frames import ranked_settings
from analysis.exports.paper import Returns, curves_of
from analysis.first_seeds import first_seeds
from analysis.objectives import SettingScores
from analysis.page_templates import make_environment, template_file
from analysis.plot_style import (
    CSS_DARK,
    CSS_LIGHT,
    LINES,
    PALETTE,
    add_legend,
    drawable,
    escape,
    goal_line,
    new_figure,
    own_style,
    steps_axis,
    style_axes,
    to_svg,
)
from analysis.statistics import performance_profile
from policies.files import write_atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIZES = {"wide": (9.0, 4.2), "narrow": (3.8, 4.8)}
_NUM_THRESHOLDS = 200
_MAX_BANDS = 3
"""More bands than these hide each other."""
_PROFILE = (
    "The share of trainings that score more than a return. Of a sweep all settings are counted with as many seeds as "
    "each of them has, the first ones, so that a race, which gives the leading ones more, makes none count more often; "
    "of a setting all of its seeds. Bands, of up to three: pointwise 95 % intervals (Wilson)."
)
_CURVES = (
    "Mean greedy evaluation over training seeds; a seed that ended early is held at its last value, and one that "
    "failed before its first evaluation is left out. Bands, of up to three: 95 % intervals over seeds, within what any "
    "seed had."
)

Size = tuple[float, float]


def write_page(path: Path, comparison: Comparison, wanted: Mapping[str, Wanted]) -> Path:
    """Write the page of a comparison.

    Args:
        path: The file.
        comparison: What it says.
        wanted: What the comparison was made of, by letter.

    Raises:
        CannotRunError: The file cannot be written.
    """
    from markupsafe import Markup

    ready = {
        entry.letter: judged_alike(
            wanted[entry.letter],
            comparison.objective,
            entry.threshold,
            comparison.failed_score,
            longest=comparison.longest_env_steps,
        )
        for entry in comparison.entries
    }
    page = (
        make_environment()
        .get_template("comparison.html.j2")
        .render(
            entries=comparison.entries,
            rows=fact_rows(comparison),
            pairs=pair_lines(comparison),
            not_comparable=comparison.not_comparable,
            notes=comparison.notes,
            figures=_figures(comparison, ready),
            css_light=CSS_LIGHT,
            css_dark=CSS_DARK,
            # Markup marks text as safe HTML: this is a file of this package.
            style=Markup(template_file("report.css")),  # noqa: S704
        )
    )
    write_atomic(path, page)
    return path


def profile_figure(comparison: Comparison, wanted: Mapping[str, Wanted], size: Size) -> Figure | None:
    """Draw the share of trainings that score more than each return, a performance profile; None: there is none.

    A sweep's are those of `first_seeds`, over all of its settings; a setting's are its seeds.

    Source:
        Agarwal et al. 2021, see `statistics.performance_profile`.
    """
    runs = [(entry, scores) for entry in comparison.entries if (scores := _runs(entry, wanted[entry.letter]))]
    if not runs:
        return None
    everything = drawable([score for _, scores in runs for score in scores])
    low, high = float(everything.min()), float(everything.max())
    margin = 0.03 * (high - low) or 1.0
    places = np.linspace(low - margin, high + margin, _NUM_THRESHOLDS)
    figure = new_figure(size)
    axes = figure.subplots()
    for entry, scores in runs:
        profile = performance_profile([drawable(scores)], places)
        color, line = _look(comparison, entry)
        label = f"{entry.letter}: {entry.name} ({len(scores)})"
        axes.step(places, profile.shares, where="post", color=color, linestyle=line, linewidth=2.0, label=escape(label))
        if len(runs) <= _MAX_BANDS:
            axes.fill_between(places, profile.lower, profile.upper, step="post", color=color, alpha=0.15, linewidth=0)
    in_steps = comparison.objective == "steps_to_threshold"
    xlabel = "minus the env steps to the threshold" if in_steps else f"score ({comparison.objective})"
    style_axes(axes, xlabel=xlabel, ylabel="share of trainings above it")
    axes.set_ylim(0.0, 1.02)
    add_legend(figure, axes, [], size)
    return figure


def curves_figure(
    comparison: Comparison, wanted: Mapping[str, Wanted], size: Size, returns: Returns = "evaluation"
) -> Figure | None:
    """Draw how the settings compared learn, with bands over training seeds; None: nothing of them is known."""
    figure = new_figure(size)
    axes = figure.subplots()
    drawn = 0
    for entry in comparison.entries:
        item = _setting(entry, wanted[entry.letter])
        for curve in [] if item is None else curves_of(wanted[entry.letter].data, [item], returns=returns):
            color, line = _look(comparison, entry)
            label = f"{entry.letter}: {entry.name}"
            axes.plot(
                curve.num_env_steps, drawable(curve.mean), color=color, linestyle=line, linewidth=2.0,
                label=escape(label), marker="o" if curve.num_env_steps.size == 1 else "",
            )  # fmt: skip
            if curve.lower is not None and curve.upper is not None and len(comparison.entries) <= _MAX_BANDS:
                # A band of few seeds goes beyond any return there can be.
                low, high = np.clip([curve.lower, curve.upper], curve.least, curve.most)
                axes.fill_between(curve.num_env_steps, low, high, color=color, alpha=0.15, linewidth=0)
            drawn += 1
    if not drawn:
        return None
    style_axes(axes, xlabel="env steps", ylabel=f"{returns} return")
    steps_axis(axes)
    goal_line(axes, comparison.entries[0].threshold)
    add_legend(figure, axes, [], size)
    return figure


def _figures(comparison: Comparison, wanted: Mapping[str, Wanted]) -> list[dict[str, Any]]:
    """Return the figures as SVG, at two sizes; none of what is on no common scale."""
    if comparison.not_comparable:
        return []
    drawers: list[tuple[str, str, str, Callable[[Size], Figure | None]]] = [
        ("profile", "Performance profile", _PROFILE, lambda size: profile_figure(comparison, wanted, size)),
        ("curves", "How the settings learn", _CURVES, lambda size: curves_figure(comparison, wanted, size)),
    ]
    return [
        {"title": title, "caption": caption, **svgs}
        for stem, title, caption, draw in drawers
        if (svgs := _svgs(stem, title, draw))
    ]


@own_style()
def _svgs(stem: str, title: str, draw: Callable[[Size], Figure | None]) -> dict[str, Any]:
    from markupsafe import Markup

    found: dict[str, Any] = {}
    for kind, size in _SIZES.items():
        figure = draw(size)
        if figure is not None:
            svg = to_svg(figure, label=title, prefix=f"{stem}-{kind}")
            found[kind] = Markup(svg)  # noqa: S704  (a figure of this package)
    return found


def _setting(entry: Entry, wanted: Wanted) -> SettingScores | None:
    return next((item for item in ranked_settings(wanted.data) if item.point_index == entry.point_index), None)


def _runs(entry: Entry, wanted: Wanted) -> Sequence[float]:
    """Return the scores of the first seeds of a sweep's settings, or of all seeds of a setting."""
    if not entry.is_sweep:
        return entry.scores
    return [score for scores in first_seeds(ranked_settings(wanted.data), wanted.sweep) for score in scores]


def _look(comparison: Comparison, entry: Entry) -> tuple[str, str]:
    number = [each.letter for each in comparison.entries].index(entry.letter)
    return PALETTE[number % len(PALETTE)], LINES[number // len(PALETTE) % len(LINES)]
