"""Which hyperparameters mattered."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.importance import Effect, Importance, WhatMattered
from analysis.importance.words import SCORES, interval, percent, score_interval, score_text, sentences
from analysis.page.source import Source
from analysis.plot_style import group_names
from analysis.report_tables import Cell, Table, group_table
from analysis.wording import NONE


@dataclass(frozen=True)
class Bar:
    """One hyperparameter's share; places are in per cent of the axis."""

    name: str
    share: str
    interval: str
    verdict: str
    is_clear: bool
    place: float
    low: float
    width: float


@dataclass(frozen=True)
class EffectTable:
    """The scores by the values of the hyperparameters."""

    table: Table
    what: str
    """What scores are."""
    notes: list[str]
    """Which values can't be compared, and why."""


@dataclass(frozen=True)
class Mattered:
    """What the section shows."""

    sentences: list[str]
    bars: list[Bar]
    clear: EffectTable
    """Of the hyperparameters that clearly mattered; of all, if none did."""
    others: EffectTable
    group_table: Table


def section(source: Source) -> Mattered:
    """Return what the section shows."""
    found = source.importance
    groups = group_names(source.trials, source.axis)
    clear = {item.name for item in found.hyperparams if item.is_clear}
    first = [effect for effect in found.effects if effect.name in clear or not clear]
    return Mattered(
        sentences=sentences(found) if found.hyperparams else [],
        bars=[_bar(item) for item in found.hyperparams if item.share is not None],
        clear=_effects(found, first),
        others=_effects(found, [effect for effect in found.effects if effect not in first]),
        # The values that a population's trial ended with are not those that it learnt with.
        group_table=group_table(
            source.trials, source.results, [] if source.is_population else groups, goal=source.goal
        ),
    )


def _bar(item: Importance) -> Bar:
    share, low, high = (100.0 * (value or 0.0) for value in (item.share, item.low, item.high))
    return Bar(
        item.name,
        percent(item.share),
        interval(item),
        "mattered" if item.is_clear else "may be chance",
        item.is_clear,
        round(share, 1),
        round(low, 1),
        round(high - low, 1),
    )


def _effects(found: WhatMattered, effects: list[Effect]) -> EffectTable:
    headings = ["hyperparameter", "value", "points", "mean", "adjusted mean", "95 % interval"]
    rows = [
        [
            Cell(effect.name, effect.name),
            Cell(level.label, level.label),
            Cell(level.num_points, f"{level.num_points:,}"),
            Cell(level.mean, score_text(level.mean, found.objective)),
            Cell(level.adjusted, NONE if level.adjusted is None else score_text(level.adjusted, found.objective)),
            Cell(level.low, score_interval(level.low, level.high, found.objective)),
        ]
        for effect in effects
        for level in effect.levels
    ]
    notes = [effect.why_not_comparable for effect in effects if effect.why_not_comparable]
    return EffectTable(Table(headings, rows), SCORES[found.objective], notes)
