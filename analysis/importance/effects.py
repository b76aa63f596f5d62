"""The scores by the values of each hyperparameter, adjusted for the other hyperparameters.

A level's adjusted mean is the generalised least squares estimate of the score that its points would have had, had all
levels been tried with the same values of the other hyperparameters, whose terms are random as in `model`. No model
knows how a level does where it was never tried: a level whose points lie apart from the others in the values of another
hyperparameter is not comparable with them.

Sources: Aitken 1936, "On Least Squares and Linear Combination of Observations"; Rosenbaum & Rubin 1983, "The Central
Role of the Propensity Score", for the overlap that adjusting needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.importance.answer import Effect, Level
from analysis.importance.model import Fit, Floats, Terms, fit
from analysis.importance.searched import NOT_SET, Searched
from analysis.statistics.student_t import t_quantile
from analysis.wording import setting_text, short_text

Bools = NDArray[np.bool_]
Part = tuple[str, Any, Bools]
"""A level's label, its value and its points."""
_NUM_PARTS = 3
_MOST_LEVELS = 12
_LEAST_SHARE = 0.25
"""The part of a level's points that must lie among the other points, or the other way round."""
_ASTRAY = 0.1


def plain_effects(varied: Sequence[Searched], scores: Sequence[float]) -> list[Effect]:
    """Return the mean score of each level, adjusted for nothing."""
    return [Effect(item.name, tuple(_levels(_parts(item), np.asarray(scores)))) for item in varied]


def adjusted_effects(varied: Sequence[Searched], terms: Terms, scores: Sequence[float]) -> list[Effect]:
    """Return the scores of each level, in the order of the hyperparameters.

    Args:
        varied: The hyperparameters with more than one value.
        terms: Their model.
        scores: The score of each point.
    """
    outcome = np.asarray(scores, dtype=np.float64)
    # In units of their spread, as the scores of some envs are so large or small that their squares are lost.
    centre = float(np.median(outcome))
    spread = max(float(np.abs(outcome - centre).max()), 1e-300)
    unit = (outcome - centre) / spread
    fitted = fit(terms, unit)
    effects = []
    for index, item in enumerate(varied):
        parts = _parts(item)
        levels, masks = _levels(parts, outcome), [mask for _, _, mask in parts]
        why_not = [_why_not_comparable(item, level, mask, varied) for level, mask in zip(levels, masks, strict=True)]
        # Points in which it does not act are a level of their own, of which nothing is said.
        idle = [item.is_idle] if item.is_idle.any() else []
        means, half_widths = _adjusted(terms, fitted, index, np.column_stack([*masks, *idle]).astype(np.float64), unit)
        effects.append(
            Effect(
                item.name,
                tuple(
                    level
                    if why
                    else Level(
                        level.label,
                        level.value,
                        level.num_points,
                        level.mean,
                        centre + spread * mean,
                        centre + spread * (mean - half_width),
                        centre + spread * (mean + half_width),
                    )
                    for level, why, mean, half_width in zip(
                        levels, why_not, means.tolist(), half_widths.tolist(), strict=False
                    )
                ),
                next(filter(None, why_not), ""),
            )
        )
    return effects


def _levels(parts: Sequence[Part], outcome: Floats) -> list[Level]:
    return [
        Level(label, value, int(mask.sum()), float(outcome[mask].mean()), None, None, None)
        for label, value, mask in parts
    ]


def _parts(item: Searched) -> list[Part]:
    """Return each level's label, its value and its points; a value that is too rare for a row of its own has none."""
    if not item.is_numeric or item.kind == "power_of_two":
        keys, key_of = np.array(item.keys), dict(zip(map(repr, item.values), item.keys, strict=True))
        found = [
            (
                NOT_SET if value is None else setting_text(value),
                value,
                (keys == key_of[repr(value)]) & ~item.is_idle,
            )
            for value in item.listed
        ]
        if len(found) <= _MOST_LEVELS:
            return found
        kept = sorted(found, key=lambda part: -int(part[2].sum()))[: _MOST_LEVELS - 1]
        rest = ~np.any([mask for _, _, mask in kept], axis=0) & ~item.is_idle
        return [*kept, ("others", None, rest)]
    scaled = item.scaled()
    low, high = item.scaled_ends
    ends = np.linspace(low, high, _NUM_PARTS + 1)
    part = np.clip(np.searchsorted(ends, scaled, "right") - 1, 0, _NUM_PARTS - 1)
    part[item.is_missing] = -1
    parts = []
    for index in range(_NUM_PARTS):
        mask = part == index
        if mask.any():
            first, last, middle = (
                item.unscaled(end) for end in (*ends[index : index + 2], ends[index : index + 2].mean())
            )
            if item.is_whole:
                # Those that are in it: an end may be in the next part.
                inside = [item.values[place] for place in np.flatnonzero(mask)]
                first, last = min(inside), max(inside)
            label = short_text(first) if first == last else f"{short_text(first)} to {short_text(last)}"
            parts.append((label, middle, mask))
    missing = item.is_missing & ~item.is_idle
    return [*parts, (NOT_SET, None, missing)] if missing.any() else parts


def _adjusted(terms: Terms, fitted: Fit, index: int, levels: Floats, outcome: Floats) -> tuple[Floats, Floats]:
    """Return the adjusted mean of each level, and half of its 95 % interval's width."""
    others = terms.owners != index
    noise = float(fitted.noise[0])
    columns = terms.columns[:, others] * np.sqrt(fitted.variances[0][terms.owners[others]])
    system = noise * np.eye(columns.shape[1]) + columns.T @ columns
    used = float(np.trace(np.linalg.solve(system, columns.T @ columns)))
    weighted = (levels - columns @ np.linalg.solve(system, columns.T @ levels)) / noise
    covariance = np.linalg.pinv(levels.T @ weighted)
    df = max(1.0, len(outcome) - levels.shape[1] - used)
    means: Floats = covariance @ (weighted.T @ outcome)
    return means, t_quantile(0.975, df) * np.sqrt(np.maximum(np.diag(covariance), 0.0))


def _why_not_comparable(item: Searched, level: Level, mask: Bools, varied: Sequence[Searched]) -> str:
    """Say which other hyperparameter has other values in a level than elsewhere; empty if none has."""
    for other in varied:
        # Where one of them does not act, the other's values make no difference that it could be taken for.
        both = ~item.is_idle & ~other.is_idle
        here, there = mask & both, ~mask & both
        if other.name != item.name and here.any() and there.any() and not _overlap(other, here, there):
            return (
                f"{item.name} {level.label} was tried with {other.name} {_values(other, here)}, and other values of "
                f"{item.name} with {_values(other, there)}: which of the two made the difference can't be told."
            )
    return ""


def _overlap(other: Searched, here: Bools, there: Bools) -> bool:
    """Whether the values of another hyperparameter in a level, and those elsewhere, have enough in common."""
    missing = other.is_missing
    if not other.is_numeric or missing[here].all() or missing[there].all():
        keys = np.array(other.keys)
        return bool(np.isin(keys[here], keys[there]).mean() >= _LEAST_SHARE)
    scaled = other.scaled()
    inner, outer = scaled[here & ~missing], scaled[there & ~missing]
    return max(_inside(inner, outer), _inside(outer, inner)) >= _LEAST_SHARE


def _inside(values: Floats, others: Floats) -> float:
    """Return the part of values between others, of which a tenth on each side may be astray."""
    low, high = np.quantile(others, [_ASTRAY, 1.0 - _ASTRAY])
    return float(((values >= low) & (values <= high)).mean())


def _values(other: Searched, mask: Bools) -> str:
    chosen = [value for value, here in zip(other.values, mask, strict=True) if here]
    if other.is_numeric and None not in chosen:
        low, high = min(chosen), max(chosen)
        return short_text(low) if low == high else f"{short_text(low)} to {short_text(high)}"
    return ", ".join(dict.fromkeys(setting_text(value) for value in chosen))
