"""A comparison in words and rows of text, for the terminal, the page and notebooks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from analysis.comparison.compare import Comparison
from analysis.comparison.entries import Entry
from analysis.comparison.pairs import Pair
from analysis.records import Objective
from analysis.statistics import Estimate
from analysis.wording import PLAIN_NONE, counted, difference_text, duration, range_text, return_text, setting_text

_SCORES: dict[Objective, str] = {
    "final": "final return",
    "area": "mean over training",
    "best": "best evaluation",
    "steps_to_threshold": "env steps to goal",
}


def fact_rows(comparison: Comparison) -> list[tuple[str, list[str]]]:
    """Return the facts as rows: what it is, and the text of each entry. Rows that say nothing are left out."""
    entries = comparison.entries
    threshold = entries[0].threshold
    readers: list[tuple[str, Callable[[Entry], str]]] = [
        ("sweep" if all(entry.is_sweep for entry in entries) else "what", lambda entry: entry.name),
        ("trained on", lambda entry: f"{entry.algorithm.upper()} on {entry.env_id}"),
        ("setting", _point),
        ("seeds", _seeds),
        (_SCORES[comparison.objective], lambda entry: _score(entry.mean, entry)),
        ("95 % interval", _interval),
        ("IQM", lambda entry: _score(entry.iqm, entry)),
        ("solved by", _solved),
        (f"steps to {threshold:g}" if threshold is not None else "steps", _median),
        ("env steps spent", _spent),
        ("core time", lambda entry: PLAIN_NONE if entry.core_seconds is None else duration(entry.core_seconds)),
        ("wall time", _wall),
        ("no scores", lambda entry: entry.why_none or PLAIN_NONE),
    ]
    rows = [(title, [read(entry) for entry in entries]) for title, read in readers]
    return [(title, cells) for title, cells in rows if any(cell != PLAIN_NONE for cell in cells)]


def pair_lines(comparison: Comparison) -> list[tuple[str, list[str]]]:
    """Return the verdict of each pair, and the lines below it."""
    return [(pair.verdict, _lines(pair, comparison.objective)) for pair in comparison.pairs]


def _lines(pair: Pair, objective: Objective) -> list[str]:
    left, right = pair.left, pair.right
    lines = []
    if pair.difference is not None:
        sign = -1.0 if objective == "steps_to_threshold" else 1.0
        what = f"{left} - {right}, over training seeds" + (" (env steps)" if sign < 0 else "")
        low, high = sorted((sign * pair.difference.lower, sign * pair.difference.upper))
        mean = sign * pair.difference.mean
        of_mean, of_low, of_high = (_signed(value, sign, (mean, low, high)) for value in (mean, low, high))
        lines.append(f"{what}: {of_mean} ({of_low} to {of_high} with 95 %)")
    if pair.probability is not None:
        lines.append(f"P({left} > {right}), a training scores more: {_share(pair.probability)}")
    else:
        lines.append(f"P({left} > {right}) can't be given: {pair.why_no_probability}.")
    if pair.shared is not None:
        shared = pair.shared
        lines.append(
            f"In the {counted(shared.num_settings, 'setting')} that both have: P({left} > {right}) "
            f"{_share(shared.probability)}"
        )
        left_iqm, right_iqm = _iqm(shared.left_iqm, objective), _iqm(shared.right_iqm, objective)
        lines.append(f"Their IQM there: {left} {left_iqm}, {right} {right_iqm}")
    elif pair.why_none_shared:
        lines.append(f"No setting in common: {pair.why_none_shared}.")
    return lines


def _share(estimate: Estimate) -> str:
    return f"{estimate.mean:.2f} ({estimate.lower:.2f} to {estimate.upper:.2f} with 95 %)"


def _iqm(estimate: Estimate, objective: Objective) -> str:
    mean = _score_text(estimate.mean, objective)
    if not math.isfinite(estimate.lower):
        return mean
    return f"{mean} ({_range(estimate.lower, estimate.upper, objective)})"


def _range(lower: float, upper: float, objective: Objective) -> str:
    # Fewer env steps are better, so that they are scored below zero.
    if objective == "steps_to_threshold":
        return f"{_score_text(upper, objective)} to {_score_text(lower, objective)}"
    return range_text(lower, upper)


def _signed(value: float, sign: float, beside: Sequence[float]) -> str:
    return f"{value:+z,.0f}" if sign < 0 else difference_text(value, *beside)


def _point(entry: Entry) -> str:
    values = ", ".join(f"{name} {setting_text(value)}" for name, value in entry.point.items())
    return values or ("no searched values" if entry.scores else PLAIN_NONE)


def _seeds(entry: Entry) -> str:
    if not entry.scores:
        return PLAIN_NONE
    failed = f", {entry.num_failed} failed" if entry.num_failed else ""
    return f"{counted(len(entry.scores), 'seed')}{failed}"


def _score(value: float | None, entry: Entry) -> str:
    return PLAIN_NONE if value is None else _score_text(value, entry.objective)


def _score_text(value: float, objective: Objective) -> str:
    # An interval may go beyond what there can be: nothing is reached in less than no env steps.
    return f"{max(0.0, -value):,.0f}" if objective == "steps_to_threshold" else return_text(value)


def _interval(entry: Entry) -> str:
    if entry.lower is None or entry.upper is None:
        return PLAIN_NONE
    return _range(entry.lower, entry.upper, entry.objective)


def _solved(entry: Entry) -> str:
    return PLAIN_NONE if entry.num_solved is None else f"{entry.num_solved} of {counted(len(entry.scores), 'seed')}"


def _median(entry: Entry) -> str:
    if entry.threshold is None or not entry.scores:
        return PLAIN_NONE
    if entry.median_env_steps is None:
        return "not by half of the seeds" if len(entry.scores) > 1 else "not reached"
    text = f"{entry.median_env_steps:,.0f}"
    if len(entry.scores) < 2:
        return text
    low = "0" if entry.median_lower is None else f"{entry.median_lower:,.0f}"
    return f"{text} ({low} to {f'{entry.median_upper:,.0f}' if entry.median_upper is not None else 'never'})"


def _wall(entry: Entry) -> str:
    if entry.wall_s is None:
        return PLAIN_NONE
    told = duration(entry.wall_s, none=PLAIN_NONE)
    return f"{told} before this run" if entry.is_running else told


def _spent(entry: Entry) -> str:
    return f"{entry.num_env_steps:,} in {counted(entry.num_trials, 'trial')}"
