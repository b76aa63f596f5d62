"""Say in sentences what mattered; the report, the command line and Python say the same."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.importance.answer import Importance, WhatMattered
from analysis.records import Objective
from analysis.wording import NONE, counted, range_text, return_text

SCORES: dict[Objective, str] = {
    "final": "return in the later half of training",
    "area": "return over all of training",
    "best": "best evaluation return",
    "steps_to_threshold": "env steps to the threshold",
}
"""What scores are, by objective."""


def sentences(mattered: WhatMattered) -> list[str]:
    """Return what there is to say, the most important first."""
    if mattered.too_few:
        return [mattered.too_few, *mattered.notes]
    clear = [item for item in mattered.hyperparams if item.is_clear]
    told = [_clear(clear)]
    unclear = [item.name for item in mattered.hyperparams if not item.is_clear and item.share is not None]
    if unclear:
        told.append(
            f"Whether {listed(unclear, 'or')} matters can't be told from {counted(mattered.num_points, 'point')}."
        )
    told += [
        f"{pair.names[0]} and {pair.names[1]} matter together: what the one does depends on the value of the other "
        f"({percent(pair.share)} more)."
        for pair in mattered.interactions
    ]
    told += [edge.text for edge in mattered.edges]
    return [*told, *mattered.notes]


def _clear(clear: Sequence[Importance]) -> str:
    first, *others = [f"{percent(item.share)} ({interval(item)})" for item in clear]
    names = [item.name for item in clear]
    text = f"How points rank depends most on {names[0]}, which accounts for {first} of it by itself"
    if others:
        text += ", then on " + listed(
            [f"{name}, {share}" for name, share in zip(names[1:], others, strict=True)], "and"
        )
    return f"{text}."


def listed(names: Sequence[str], word: str) -> str:
    """Return names as a list in words: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"


def percent(share: float | None) -> str:
    """Return a share as a whole number of per cent."""
    return NONE if share is None else f"{100 * share:.0f} %"


def interval(item: Importance) -> str:
    """Return the 95 % interval of a share: "17 to 33 %"."""
    return NONE if item.low is None or item.high is None else f"{100 * item.low:.0f} to {100 * item.high:.0f} %"


def score_text(score: float | None, objective: Objective) -> str:
    """Return a score as a return, or as env steps, which are scored below zero as fewer are better."""
    if score is None or objective != "steps_to_threshold":
        return return_text(score)
    return f"{max(0.0, -score):,.0f}"


def score_interval(low: float | None, high: float | None, objective: Objective) -> str:
    """Return the interval of a score: "188.1 to 199.9"."""
    if low is None or high is None:
        return NONE
    if objective == "steps_to_threshold":
        return f"{score_text(high, objective)} to {score_text(low, objective)}"
    return range_text(low, high)
