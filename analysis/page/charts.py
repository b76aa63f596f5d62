"""The charts of the page: their data for its script, and each as files and, without scripts, as a picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.charts import Chart, Subject, draw, make_charts, to_json
from analysis.charts.model import Section
from analysis.page.files import write_figure
from analysis.page.source import Source
from analysis.plot_style import CSS_DARK, CSS_LIGHT, own_style, page_svg

if TYPE_CHECKING:
    from markupsafe import Markup


@dataclass(frozen=True)
class PageChart:
    """A chart as the page shows it."""

    chart: Chart
    picture: Markup | None
    """What a page without scripts shows; None: the chart has no data."""


@dataclass(frozen=True)
class Charts:
    """The charts of the page."""

    by_section: Mapping[Section, list[PageChart]]
    data: Markup
    """JSON, for the page's script."""


@own_style()
def make(source: Source, folder: Path, before_each: Callable[[], None] = lambda: None) -> Charts:
    """Make the charts of a sweep, and write each that has data as SVG and PDF.

    Args:
        source: The sweep.
        folder: The folder that the files are written to.
        before_each: Called before each chart is drawn; what it raises ends this.

    Raises:
        CannotRunError: A file cannot be written.
    """
    from markupsafe import Markup

    subject = Subject(source.sweep, source.trials, source.results, source.goal, source.importance)
    charts = make_charts(subject)
    by_section: dict[Section, list[PageChart]] = {"front": [], "mattered": [], "learning": [], "cost": []}
    for chart in charts:
        picture = None
        if chart.data is not None:
            before_each()
            svg = write_figure(draw(chart), folder / chart.id)
            # Markup marks text as safe HTML: `page_svg` escapes all that is not its own, as `to_json` does.
            picture = Markup(page_svg(svg, label=chart.title, prefix=chart.id))  # noqa: S704
        by_section[chart.section].append(PageChart(chart, picture))
    return Charts(by_section, Markup(to_json(charts, {"light": CSS_LIGHT, "dark": CSS_DARK})))  # noqa: S704
