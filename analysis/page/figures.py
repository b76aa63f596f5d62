"""The figures of the page, by the section that each stands in."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from analysis import plots
from analysis.page import how_sure
from analysis.page.files import write_figure
from analysis.page.scores import score_means
from analysis.page.source import Source
from analysis.plot_style import own_style, page_svg, to_svg_file
from analysis.points import searched_names
from analysis.selection import score_trial
from analysis.strip_plot import seed_strips

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure

Section = Literal["how_sure", "mattered", "learning", "cost"]
"""The sections that have figures."""
_WIDE = (9.0, 4.2)
_NARROW = (3.8, 4.8)


@dataclass(frozen=True)
class Picture:
    """A figure that can be drawn at two sizes."""

    section: Section
    stem: str
    """Its file's name without the suffix."""
    title: str
    caption: str
    draw: Callable[[tuple[float, float]], Figure]
    is_on_page: bool = True
    """False: it is a file alone, as one of the page's charts says the same."""


@dataclass(frozen=True)
class DrawnFigure:
    """A figure as the page shows it."""

    title: str
    caption: str
    wide: Markup
    narrow: Markup


@own_style()
def draw_figures(
    source: Source, folder: Path, before_each: Callable[[], None] = lambda: None
) -> Mapping[Section, list[DrawnFigure]]:
    """Draw all figures for which there is data, for the page, and write each as PNG, SVG and PDF.

    Args:
        source: The sweep.
        folder: The folder that the files are written to.
        before_each: Called before each figure is drawn; what it raises ends this.

    Raises:
        CannotRunError: A file cannot be written.
    """
    drawn: dict[Section, list[DrawnFigure]] = {"how_sure": [], "mattered": [], "learning": [], "cost": []}
    for picture in pictures(source):
        before_each()
        wide = write_figure(picture.draw(_WIDE), folder / picture.stem, png=True)
        if picture.is_on_page:
            narrow = to_svg_file(picture.draw(_NARROW))
            pictures_of_sizes = _for_page(picture, wide, "wide"), _for_page(picture, narrow, "narrow")
            drawn[picture.section].append(DrawnFigure(picture.title, picture.caption, *pictures_of_sizes))
    return drawn


def _for_page(picture: Picture, svg: str, kind: Literal["wide", "narrow"]) -> Markup:
    from markupsafe import Markup

    # Markup marks text as safe HTML: `page_svg` escapes all that is not its own.
    return Markup(page_svg(svg, label=picture.title, prefix=f"{picture.stem}-{kind}"))  # noqa: S704


def pictures(source: Source) -> list[Picture]:
    """Return the figures for which there is data, in the order of the page."""
    trials, results, goal, winner = source.trials, source.results, source.goal, source.winner
    found = _of_seeds(source)
    # One dot would say less than the winner's card.
    if sum(score_trial(trial) is not None for trial in trials) > 1:
        found.append(
            Picture(
                "mattered",
                f"score_by_{_stem(source.axis)}",
                f"Score against {source.axis}" if source.axis is not None else "Score by trial",
                "Best greedy evaluation of each trial, on the sweep's evaluation seeds.",
                lambda size: plots.score_by_lr(trials, threshold=goal, winner=winner, size=size),
                is_on_page=False,
            )
        )
    if any(item.training_return is not None for items in results.values() for item in items):
        found.append(
            Picture(
                "learning",
                "learning_curves",
                "Learning curves",
                "Mean return of the last 100 whole training episodes, exploring. "
                "Circles: greedy evaluations of the winner.",
                lambda size: plots.learning_curves(trials, results, threshold=goal, winner=winner, size=size),
                is_on_page=False,
            )
        )
    episodes = [value for item in results.get(winner or "", ()) for value in item.episode_returns]
    returns = [value for value in episodes if math.isfinite(value)]
    if returns:
        found.append(
            Picture(
                "learning",
                "score_per_episode",
                "The winner, episode by episode",
                "Every whole training episode of the winning trial with goal and linear trend, exploring; beside them "
                "how the last 50 spread.",
                lambda size: plots.score_per_episode(returns, goal=goal, title="score per episode", size=size),
            )
        )
    return found


def _of_seeds(source: Source) -> list[Picture]:
    strips, settings = how_sure.strips(source), source.settings
    if not strips or settings is None:
        return []
    is_return = settings.objective != "steps_to_threshold"
    names = " · ".join(searched_names(item.point for item in settings.ranking))
    return [
        Picture(
            "how_sure",
            "settings_by_seed",
            "The leading settings, seed by seed",
            "One dot a training seed, and the mean with its interval over training seeds where there are several; best "
            f"setting first: {names}.",
            lambda size: seed_strips(
                strips,
                xlabel=f"{'score ' if is_return else ''}{score_means(settings)}",
                threshold=settings.threshold if is_return else None,
                counts_env_steps=not is_return,
                # A row has the same height however many there are.
                size=(size[0], 1.5 + 0.34 * len(strips)),
            ),
        )
    ]


def _stem(name: str | None) -> str:
    """Return a hyperparameter's name as part of a file name; records are not trusted to hold identifiers."""
    return "".join(letter if letter.isalnum() or letter == "_" else "_" for letter in name or "trial")
