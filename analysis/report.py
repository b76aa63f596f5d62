"""Write the report of a sweep: one HTML file that needs no other; figures and tables are also files beside it.

    index.html   with figures as inline SVG and videos as base64, so it can be mailed as it is
    trials.csv, iterations.csv, steps_to_solve.csv, figures/*.png

Everything in the page is escaped (error texts and env ids come from elsewhere), and the page's own content
security policy keeps it from running or loading anything but its one script.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis import plots, report_data, report_tables, wording
from analysis.plot_style import CSS_DARK, CSS_LIGHT, group_names, numeric_names, to_png, to_svg
from analysis.records import BestRecord, IterationRecord, SweepRecord, TrialRecord
from analysis.selection import score_trial
from analysis.tables import iterations_frame, steps_to_solve_frame, trials_frame, write_csv
from policies.files import write_atomic

if TYPE_CHECKING:
    import jinja2
    from matplotlib.figure import Figure

_WIDE = (9.0, 4.2)
_NARROW = (3.8, 4.8)
_MEDIA_TYPES = {".mp4": "video/mp4", ".webm": "video/webm", ".gif": "image/gif"}
_VIDEO_TITLES = {
    "before": "Before training: random actions",
    "after": "After training: the winner, greedy",
    "side_by_side": "Before and after, on the same seed",
}


@dataclass(frozen=True)
class _Sweep:
    """The data that a report is made from."""

    folder: Path
    sweep: SweepRecord
    trials: Sequence[TrialRecord]
    results: Mapping[str, Sequence[IterationRecord]]
    best: BestRecord | None
    goal: float | None
    why_no_best: tuple[str, str] | None = None
    """Why there is no winner, and what to do; None: the reason is found in the trials."""

    @property
    def axis(self) -> str | None:
        """The searched number on the horizontal axis."""
        return next(iter(numeric_names(self.trials)), None)

    @property
    def video_titles(self) -> Mapping[str, str]:
        """The titles of videos by name; a baseline has not been trained, so it has no before and after."""
        if report_data.is_trained(self.sweep):
            return _VIDEO_TITLES
        return {"before": "Random actions", "after": "The winner"}

    @property
    def winner(self) -> str | None:
        """Trial id of the confirmed winner."""
        return None if self.best is None else self.best.checkpoint.trial_id


@dataclass(frozen=True)
class _Picture:
    """A figure that can be drawn at two sizes."""

    stem: str
    title: str
    caption: str
    draw: Callable[[tuple[float, float]], Figure]


def build_report(
    folder: Path,
    *,
    target: Path,
    sweep: SweepRecord,
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    best: BestRecord | None,
    videos: Mapping[str, Path],
    why_no_best: tuple[str, str] | None = None,
) -> Path:
    """Write the report of a sweep.

    Args:
        folder: The sweep folder, as the report names it.
        target: The folder that the report is written to.
        sweep: The sweep's record.
        trials: All trials, in any status.
        results: Iterations by trial id, oldest first; a trial may have none.
        best: The confirmed winner; None: the report says why there is none.
        videos: Files to embed, by "before", "after" or another name; those that do not exist are left out.
        why_no_best: Why the winner could not be confirmed, and what to do; None: the reason is found in the trials.

    Returns:
        Path of index.html.

    Raises:
        CannotRunError: A file cannot be written.
    """
    goal = report_data.goal_of(sweep, best)
    write_csv(target / "trials.csv", trials_frame(trials, results, threshold=goal))
    write_csv(target / "iterations.csv", iterations_frame(results))
    write_csv(target / "steps_to_solve.csv", steps_to_solve_frame(trials, results, threshold=goal))
    source = _Sweep(folder, sweep, trials, results, best, goal, why_no_best)
    figures = []
    for picture in _pictures(source):
        write_atomic(target / "figures" / f"{picture.stem}.png", to_png(picture.draw(_WIDE)))
        sizes = {"wide": _WIDE, "narrow": _NARROW}
        drawings = {
            kind: to_svg(picture.draw(size), label=picture.title, prefix=f"{picture.stem}-{kind}")
            for kind, size in sizes.items()
        }
        figures.append({"title": picture.title, "caption": picture.caption} | drawings)
    page = _render(
        **_content(source),
        figures=figures,
        videos=[_embed(name, path, source.video_titles) for name, path in videos.items() if path.is_file()],
    )
    write_atomic(target / "index.html", page)
    return target / "index.html"


def _content(source: _Sweep) -> dict[str, Any]:
    """Return everything that the template shows except figures and videos."""
    import yaml

    sweep, trials, results, best, goal = source.sweep, source.trials, source.results, source.best, source.goal
    groups = group_names(trials, source.axis)
    return {
        "sweep": sweep,
        "env_id": report_data.env_of(sweep),
        "about": report_data.about_of(sweep),
        "algorithm": report_data.algorithm_of(sweep),
        "trained": report_data.is_trained(sweep),
        "goal": goal,
        "headline": report_data.headline(sweep, trials, results, goal),
        "winner": None if best is None else report_data.winner_card(best, trials, sweep, source.folder),
        "setting": None if best is None else report_data.setting_card(best, source.folder),
        "why_no_best": None
        if best is not None
        else source.why_no_best or report_data.why_no_best(trials, source.folder),
        "sweep_path": wording.shown_path(source.folder),
        "trial_table": report_tables.trial_table(trials, results, goal=goal, best=best),
        "group_table": report_tables.group_table(trials, results, groups, goal=goal),
        "steps_table": report_tables.steps_table(trials, results, goal=goal),
        "fewest_env_steps": report_data.fewest_env_steps(trials, results, goal),
        "point_table": report_tables.point_table(trials),
        "failures": report_data.failures(trials),
        "facts": report_data.facts(sweep),
        "spec_yaml": yaml.safe_dump(sweep.spec, sort_keys=False, allow_unicode=True, default_flow_style=None),
    }


def _pictures(source: _Sweep) -> list[_Picture]:
    """Return the figures for which there is data."""
    trials, results, goal, winner = source.trials, source.results, source.goal, source.winner
    pictures = []
    if any(item.training_return is not None for items in results.values() for item in items):
        pictures.append(
            _Picture(
                "learning_curves",
                "Learning curves",
                "Mean return of the last 100 whole training episodes, exploring. "
                "Circles: greedy evaluations of the winner.",
                lambda size: plots.learning_curves(trials, results, threshold=goal, winner=winner, size=size),
            )
        )
    # One dot would say less than the winner's card.
    if sum(score_trial(trial) is not None for trial in trials) > 1:
        pictures.append(
            _Picture(
                f"score_by_{_stem(source.axis)}",
                f"Score against {source.axis}" if source.axis is not None else "Score by trial",
                "Best greedy evaluation of each trial, on the sweep's evaluation seeds.",
                lambda size: plots.score_by_lr(trials, threshold=goal, winner=winner, size=size),
            )
        )
    episodes = [value for item in results.get(winner or "", ()) for value in item.episode_returns]
    returns = [value for value in episodes if math.isfinite(value)]
    if returns:
        pictures.append(
            _Picture(
                "score_per_episode",
                "The winner, episode by episode",
                "Every whole training episode of the winning trial with goal and linear trend, exploring; beside them "
                "how the last 50 spread.",
                lambda size: plots.score_per_episode(returns, goal=goal, title="score per episode", size=size),
            )
        )
    return pictures


def _stem(name: str | None) -> str:
    """Return a hyperparameter's name as part of a file name; records are not trusted to hold identifiers."""
    return "".join(letter if letter.isalnum() or letter == "_" else "_" for letter in name or "trial")


def _embed(name: str, path: Path, titles: Mapping[str, str]) -> dict[str, str]:
    media_type = _MEDIA_TYPES.get(path.suffix.lower(), "video/mp4")
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return {
        "title": titles.get(name, name),
        "kind": media_type.partition("/")[0],
        "source": f"data:{media_type};base64,{data}",
    }


def _render(**content: Any) -> str:
    from markupsafe import Markup

    environment = _environment()
    # Markup marks text as safe HTML. It gets only what this package makes: figures, its script, its style.
    figures = [
        figure | {"wide": Markup(figure["wide"]), "narrow": Markup(figure["narrow"])}  # noqa: S704
        for figure in content.pop("figures")
    ]
    script = _source(environment, "report.js")
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    return environment.get_template("report.html.j2").render(
        **content,
        figures=figures,
        css_light=CSS_LIGHT,
        css_dark=CSS_DARK,
        style=Markup(_source(environment, "report.css")),  # noqa: S704
        script=Markup(script),  # noqa: S704
        script_hash=f"sha256-{digest}",
        interval_text=wording.interval_text,
        difference_text=wording.difference_text,
        number=wording.number,
    )


def _environment() -> jinja2.Environment:
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("analysis", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _source(environment: jinja2.Environment, name: str) -> str:
    assert environment.loader is not None  # noqa: S101  (for the type checker: _environment sets it)
    return environment.loader.get_source(environment, name)[0]
