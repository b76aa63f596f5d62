"""The results of `what_mattered`: typed, and frozen.

Words: a *point* is one combination of values, with one score, the mean over its training seeds. A *level* is one value
of a hyperparameter whose values are listed, or one third of a range. A *share* is the part of the variance of the
points' ranks that a hyperparameter accounts for by itself, the others held fixed, less what chance alone would give: 0
to 1. Shares don't add up to 1: the rest is joint effects, and seeds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from analysis.notebook import facts_html, rows_html
from analysis.records import Objective


@dataclass(frozen=True)
class Importance:
    """How much the scores depend on one hyperparameter."""

    name: str
    share: float | None
    """The share of the variance of ranks; None: it can't be said, as one value alone was tried or points are few."""
    low: float | None
    """The lower end of the share's 95 % interval."""
    high: float | None
    is_clear: bool
    """Whether chance alone would hardly ever give as much: 1 in 20 sweeps, for all hyperparameters together."""


@dataclass(frozen=True)
class Level:
    """The scores that a hyperparameter's level goes with."""

    label: str
    """The value, or the ends of the part of a range."""
    value: Any
    """The value, or the middle of the part, in the scale that it was searched on."""
    num_points: int
    mean: float
    """The mean score of its points, whatever their other values are."""
    adjusted: float | None
    """The same, had the levels been tried with the same values of the other hyperparameters; None: not comparable."""
    low: float | None
    """The lower end of the 95 % interval of the adjusted mean."""
    high: float | None


@dataclass(frozen=True)
class Effect:
    """The scores by one hyperparameter."""

    name: str
    levels: tuple[Level, ...]
    why_not_comparable: str = ""
    """Why the levels' means can't be compared, even adjusted; empty if they can."""


@dataclass(frozen=True)
class Interaction:
    """How much more two hyperparameters account for together than each by itself."""

    names: tuple[str, str]
    share: float
    is_clear: bool
    """Whether chance alone would hardly ever give as much: 1 in 20 sweeps, for all pairs together."""


@dataclass(frozen=True)
class Edge:
    """An end of a hyperparameter's values at which the best points lie: beyond it may be better ones."""

    name: str
    side: str
    """low or high."""
    end: Any
    """The value at that end."""
    domain: dict[str, Any]
    """A wider domain, as in a sweep file: {"loguniform": [1e-5, 0.1]}."""
    text: str
    """The same as a sentence."""


@dataclass(frozen=True)
class WhatMattered:
    """What mattered in a sweep."""

    objective: Objective
    """What scores are of."""
    num_points: int
    """The points that have a score."""
    num_trials: int
    """Their trials."""
    hyperparams: tuple[Importance, ...]
    """Every searched hyperparameter, the most important first; those of which nothing is known last."""
    effects: tuple[Effect, ...] = ()
    """Those with more than one value, in the same order."""
    interactions: tuple[Interaction, ...] = ()
    """The pairs that are clear, the largest share first."""
    edges: tuple[Edge, ...] = ()
    too_few: str = ""
    """Why nothing can be said of importance; empty if it can."""
    notes: tuple[str, ...] = ()
    """What the reader has to know, such as that trials are judged at an earlier env step."""
    num_env_steps: int | None = None
    """The env steps that trials are judged at; None: at their ends."""

    @property
    def names(self) -> tuple[str, ...]:
        """The searched hyperparameters, the most important first."""
        return tuple(item.name for item in self.hyperparams)

    def _repr_html_(self) -> str:
        rows = [
            [
                item.name,
                f"{item.share:.0%}",
                f"{item.low or 0.0:.0%} to {item.high or 0.0:.0%}",
                "mattered" if item.is_clear else "may be chance",
            ]
            for item in self.hyperparams
            if item.share is not None
        ]
        told = facts_html("What mattered", {"not known": self.too_few} if self.too_few else {})
        return told + (rows_html(["hyperparameter", "share", "95 % interval", ""], rows) if rows else "")
