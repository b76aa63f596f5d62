"""What every search method is asked, and how it answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tune_jobs.search.history import KnownPoint
from tune_jobs.search.parts import Parts
from tune_jobs.spec.domains import Domain

Check = Callable[[dict[str, Any]], object]
"""Raises SpecError for a point whose values contradict each other."""


@dataclass(frozen=True)
class Question:
    """The next point is asked for."""

    space: Mapping[str, Domain]
    """What is searched: lists and ranges, without conditions. Every point has a value of each (see `parts`)."""
    known: Sequence[KnownPoint]
    """The points that were tried before, in their order; what is planned but not begun is not among them."""
    index: int
    """How many points the search gave before: the random numbers of the answer belong to it."""
    seed: int
    """The sweep's seed."""
    parts: Parts | None = None
    """Which names act in which point; None: all do in each."""


Method = Callable[[Question, Check], dict[str, Any]]
"""Answers by a point whose values go together. The same question has the same answer, whatever was asked before.

Raises SpecError if none of many points is valid.
"""
