"""How sure it is which setting is best: the leading ones seed by seed, what can't be told apart, and env steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analysis.answers import why_unsure
from analysis.best_records import SettingRecord, SettingsRecord
from analysis.page.scores import counts_env_steps, interval_of, score_means, score_text
from analysis.page.source import Source, point_text
from analysis.points import searched_names, setting_labels, value_text
from analysis.records import IterationRecord, TrialRecord, finite_or_none
from analysis.report_tables import Cell, Table, steps_table
from analysis.statistics import tie_groups
from analysis.strip_plot import Strip
from analysis.tables import SOLVED_OVER_NUM_EPISODES, cell_value, solving_point, steps_to_solve_frame
from analysis.wording import NONE, number
from policies import random_streams

_WORST = "the worst score of the sweep"
_ONE_SEED = (
    "Each was trained with one seed: how much seeds differ is not known, so there are no intervals, and nothing says "
    "that the first is the best."
)
_SEVERAL_SEEDS = (
    "Intervals are over training seeds, and learn from all settings how much seeds differ. P(best) is the probability "
    "that no other setting is better. Settings that share a letter can't be told apart."
)
_LEADS_BY_THEM = "The first leads by the seeds that its score is of: fresh ones would likely score less."
_MAX_LABEL = 26
"""A longer text of a setting is not written beside its dots; the table has it."""


@dataclass(frozen=True)
class HowSure:
    """What the section shows."""

    about: list[str]
    """What the table is about, and what it can't say."""
    settings_table: Table
    fewest_env_steps: str
    """Which hyperparameters solve the env in the fewest env steps; empty without a goal or trials."""
    steps_table: Table


def section(source: Source) -> HowSure:
    """Return what the section shows."""
    return HowSure(
        about=_about(source),
        settings_table=settings_table(source),
        fewest_env_steps=fewest_env_steps(source.trials, source.results, source.goal),
        steps_table=steps_table(source.trials, source.results, goal=source.goal),
    )


def strips(source: Source) -> list[Strip]:
    """Return the leading settings for the figure; none where there is nothing to compare."""
    settings = source.settings
    if settings is None or settings.num_settings < 2:
        return []
    sign = -1.0 if counts_env_steps(settings) else 1.0
    labels = setting_labels([item.point for item in settings.ranking])
    fit = max(map(len, labels)) <= _MAX_LABEL
    found = []
    for rank, (item, label) in enumerate(zip(settings.ranking, labels, strict=True), start=1):
        interval = None
        if item.lower is not None and item.upper is not None:
            low, high = sorted((sign * item.lower, sign * item.upper))
            interval = (max(0.0, low) if sign < 0 else low, high)
        scores = tuple(sign * score for score in item.scores)
        name = f"{rank}.  {label}" if fit else f"{rank}."
        found.append(Strip(name, scores, sign * item.score, interval, item.may_be_best))
    return found


def settings_table(source: Source) -> Table:
    """Return the leading settings, best first; empty where there are not two, or none can be judged."""
    settings = source.settings
    if settings is None or settings.num_settings < 2:
        return Table([], [])
    names, letters = searched_names(item.point for item in settings.ranking), _letters(source, settings)
    several = settings.best.probability_best is not None
    headings = ["rank", *names, "seeds"]
    headings += ["solved"] if settings.threshold is not None else []
    headings += [f"score {score_means(settings)}"]
    headings += ["95 % interval over training seeds", "P(best)"] if several else []
    headings += ["tie group"] if letters else []
    rows = []
    for rank, item in enumerate(settings.ranking, start=1):
        cells = [Cell(rank, str(rank)), *(_value(item, name) for name in names)]
        failed = f", {item.num_failed} failed" if item.num_failed else ""
        cells += [Cell(len(item.scores), f"{len(item.scores)}{failed}")]
        if settings.threshold is not None:
            cells += [Cell(item.num_solved, NONE if item.num_solved is None else str(item.num_solved))]
        cells += [Cell(item.score, score_text(settings, item.score))]
        if several:
            interval = interval_of(settings, item)
            chance = item.probability_best
            cells += [
                Cell(interval, interval or NONE),
                Cell(chance, NONE if chance is None else _percent(chance), "" if item.may_be_best else "pending"),
            ]
        if letters:
            text = letters.get(item.point_index, NONE)
            cells += [Cell(text, text)]
        rows.append(cells)
    return Table(headings, rows)


def _about(source: Source) -> list[str]:
    settings = source.settings
    if settings is None or settings.num_settings < 2:
        return []
    listed = len(settings.ranking)
    texts = [f"The first {listed} of {settings.num_settings:,} settings." if listed < settings.num_settings else ""]
    texts += _of_seeds(settings)
    if any(map(settings.num_never, settings.ranking)):
        never = number(settings.never_reached)
        texts += [f"A seed that never reaches the threshold counts as {never} env steps, twice the longest training."]
    if any(item.num_failed for item in settings.ranking):
        worst = "a training that never reaches the threshold" if counts_env_steps(settings) else _WORST
        texts += [f"A seed that failed counts as {worst}."]
    return [text for text in texts if text]


def _of_seeds(settings: SettingsRecord) -> list[str]:
    if settings.best.lower is not None:
        # Settings that aren't listed may be those of which seeds are known to differ.
        return [_SEVERAL_SEEDS, _LEADS_BY_THEM]
    if not settings.several_seeds:
        return [_ONE_SEED]
    # Where nothing but one score is known, each is as probably the best.
    return [
        f"{why_unsure(settings).capitalize()}: there are no intervals, and nothing says that the first is the best."
    ]


def _letters(source: Source, settings: SettingsRecord) -> dict[int, str]:
    """Return the tie groups of each listed setting as letters, by its point; none where seeds say nothing.

    Settings that share a letter are not told apart: a compact letter display (Piepho 2004, "An Algorithm for a
    Letter-Based Representation of All-Pairwise Comparisons").
    """
    if settings.best.probability_best is None:
        return {}
    ranked = source.ranked
    try:
        groups = tie_groups([item.scores for item in ranked], rng=random_streams.fixed()).groups
    except ValueError:  # scores so large that their squares are not finite, or no setting is left
        return {}
    listed = {item.point_index for item in settings.ranking}
    shown = [points for group in groups if (points := {ranked[index].point_index for index in group} & listed)]
    # Groups that differ in settings alone that are not listed are one here.
    shown = [points for rank, points in enumerate(shown) if not any(points <= other for other in shown[:rank])]
    letters: dict[int, str] = {}
    for letter, points in zip("abcdefghijklmnopqrstuvwxyz", shown, strict=False):
        for point in points:
            letters[point] = letters.get(point, "") + letter
    return letters


def _value(item: SettingRecord, name: str) -> Cell:
    value = cell_value(item.point.get(name))
    return Cell(value, value_text(item.point, name, lambda known: number(cell_value(known)), NONE))


def _percent(probability: float) -> str:
    return "< 1 %" if probability < 0.01 else "> 99 %" if probability > 0.99 else f"{100 * probability:.0f} %"


def fewest_env_steps(
    trials: Sequence[TrialRecord], results: Mapping[str, Sequence[IterationRecord]], goal: float | None
) -> str:
    """Say which hyperparameters solve the env in the fewest env steps; empty without a goal or trials."""
    if goal is None or not trials:
        return ""
    frame = steps_to_solve_frame(trials, results, threshold=goal)
    solving = frame[frame["num_solved"] > 0]
    over = f"a mean training return of {number(goal)} over {SOLVED_OVER_NUM_EPISODES} episodes"
    if solving.empty:
        return f"No trial reached {over}."
    # By columns: a row of them would have one type for all its numbers, and with it another word for "missing".
    first = {column: solving[column].iloc[0] for column in solving.columns}
    # The row has a cell for each hyperparameter that any trial has; what acts in this point is known by its trials.
    leader = next(trial for trial in trials if trial.point_index == first["point_index"])
    values = point_text(solving_point(leader, goal, results.get(leader.trial_id, ())))
    who = f"{values} reaches" if values else "The sweep's one point reaches"
    median, num_seeds = finite_or_none(float(first["median_num_env_steps"])), int(first["num_seeds"])
    if median is None:
        return (
            f"{who} {over} with only {int(first['num_solved'])} of {num_seeds} seeds, and no point with more than half."
        )
    seeds = "one seed" if num_seeds == 1 else f"the median of {num_seeds} seeds"
    return f"{who} {over} in the fewest env steps: {number(median)} ({seeds})."
