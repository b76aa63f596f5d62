"""Write the report of a sweep: one HTML file that needs no other; figures and tables are also files beside it.

    index.html   with its scripts, the data of its charts, figures and videos in it, so it can be mailed as it is
    trials.csv, iterations.csv, steps_to_solve.csv
    figures/     each figure of the page as SVG and PDF, some as PNG

What each section of the page shows is made in `analysis.page`. Everything in the page is escaped (error texts and env
ids come from elsewhere), and the page's own content security policy keeps it from running or loading anything but its
own scripts.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis import report_data, wording
from analysis.best_records import BestRecord, SettingsRecord
from analysis.iterations_csv import write_iterations
from analysis.page import all_trials, answer, cards, charts, cost, front, head, how_sure, mattered, next_steps, repeat
from analysis.page.bounded import bounded
from analysis.page.figures import draw_figures
from analysis.page.source import Source
from analysis.page_templates import make_environment, template_file
from analysis.plot_style import CSS_DARK, CSS_LIGHT
from analysis.records import IterationRecord, SweepRecord, TrialRecord
from analysis.tables import steps_to_solve_frame, trials_frame, write_csv
from policies.files import write_atomic

if TYPE_CHECKING:
    import jinja2

_STYLES = ("report.css", "charts.css")
_SCRIPTS = ("report.js", "vendor/echarts/echarts.min.js", "charts.js")
"""The scripts of the page, templates/*, run in this order at its end; no other may run."""


def build_report(
    place: str,
    *,
    target: Path,
    sweep: SweepRecord,
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    best: BestRecord | None,
    videos: Mapping[str, Path] | Callable[[], Mapping[str, Path]],
    why_no_best: tuple[str, str] | None = None,
    settings: SettingsRecord | None = None,
    before_each: Callable[[], None] = lambda: None,
) -> Path:
    """Write the report of a sweep.

    Args:
        place: The sweep's folder or URL, as the report names it.
        target: The folder that the report is written to.
        sweep: The sweep's record.
        trials: All trials, in any status.
        results: Iterations by trial id, oldest first; a trial may have none.
        best: The confirmed winner; None: the report says why there is none.
        videos: Files to embed, by "before", "after" or another name; those that do not exist are left out.
            A function returns them once all else is made, as they may not be there before.
        why_no_best: Why the winner could not be confirmed, and what to do; None: the reason is found in the trials.
        settings: The settings as they are judged now; None: those of the winner's record.
        before_each: Called before each figure is drawn; what it raises ends this.

    Returns:
        Path of index.html.

    Raises:
        CannotRunError: A file cannot be written.
    """
    goal = report_data.goal_of(sweep, best)
    write_csv(target / "trials.csv", trials_frame(trials, results, threshold=goal))
    write_iterations(target / "iterations.csv", results)
    write_csv(target / "steps_to_solve.csv", steps_to_solve_frame(trials, results, threshold=goal))
    if settings is None and best is not None:
        settings = best.settings
    results = bounded(results)
    source = Source(place, sweep, trials, results, best, goal, why_no_best, settings)
    page = _render(
        source=source,
        figures=draw_figures(source, target / "figures", before_each),
        charts=charts.make(source, target / "figures", before_each),
        head=head.section(source),
        answer=answer.section(source),
        how_sure=how_sure.section(source),
        front=front.section(source),
        mattered=mattered.section(source),
        cost=cost.section(source),
        next_steps=next_steps.section(source),
        trials=all_trials.section(source),
        repeat=repeat.section(source),
        cards=cards.section(source, videos() if callable(videos) else videos),
    )
    write_atomic(target / "index.html", page)
    return target / "index.html"


def _render(**sections: Any) -> str:
    from markupsafe import Markup

    scripts = [template_file(name) for name in _SCRIPTS]
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            **sections,
            css_light=CSS_LIGHT,
            css_dark=CSS_DARK,
            # Markup marks text as safe HTML: these are files of this package.
            styles=[Markup(template_file(name)) for name in _STYLES],  # noqa: S704
            scripts=[Markup(script) for script in scripts],  # noqa: S704
            script_hashes=[_hash(script) for script in scripts],
        )
    )


def _environment() -> jinja2.Environment:
    environment = make_environment()
    environment.globals |= {
        "interval_text": wording.interval_text,
        "difference_text": wording.difference_text,
        "number": wording.number,
        "return_text": wording.known_return_text,
    }
    return environment


def _hash(script: str) -> str:
    """Return a script's hash as the content security policy names it."""
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
