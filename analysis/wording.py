"""Numbers, times, seeds and paths as text for a reader."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from numbers import Real
from pathlib import Path
from typing import Any

from analysis.statistics import Estimate

NONE = "\u2013"
"""What stands for a value that is not known."""


def number(value: Any) -> str:
    """A cell's text: thousands apart, four significant digits, a dash for what is not known."""
    if value is None:
        return NONE
    if isinstance(value, bool | str) or not is_number(value):
        return str(value)
    if float(value).is_integer() and abs(value) < 1e15:
        return f"{int(value):,}"
    return f"{value:.4g}"


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """A number with what it counts: "1 point", "1,024 points"."""
    return f"{count:,} {noun if count == 1 else plural or f'{noun}s'}"


def duration(seconds: float) -> str:
    """Seconds as "42 s", "1 min 10 s" or "2 h 5 min"; a dash if they are not finite."""
    if not math.isfinite(seconds):
        return NONE
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def moment(unix_time: float | None) -> str:
    """A Unix time as UTC, to the minute; a dash if it is not known or no time."""
    if unix_time is None:
        return NONE
    try:
        return f"{datetime.fromtimestamp(unix_time, tz=UTC):%Y-%m-%d %H:%M} UTC"
    except (ValueError, OverflowError, OSError):
        return NONE


def seed_range(seeds: Sequence[int]) -> str:
    """Seeds as "10 (4711 to 4720)"; listed where they are not contiguous."""
    if not seeds:
        return "none"
    if tuple(seeds) == tuple(range(seeds[0], seeds[0] + len(seeds))):
        return f"{len(seeds)} ({seeds[0]} to {seeds[-1]})" if len(seeds) > 1 else str(seeds[0])
    return f"{len(seeds)} ({', '.join(map(str, seeds))})"


def interval_text(estimate: Estimate) -> str:
    """An interval as "188.1 to 199.9"."""
    return f"{estimate.lower:.1f} to {estimate.upper:.1f}"


def is_number(value: Any) -> bool:
    """Whether a value is a real number, NumPy's included; True and False are not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def shown_path(path: Path) -> str:
    """A path as a user would type it: relative where it lies below the current folder."""
    try:
        here = Path.cwd()
    except FileNotFoundError:  # it was deleted
        return str(path)
    absolute = path.absolute()
    return str(absolute.relative_to(here)) if absolute.is_relative_to(here) else str(absolute)


def format_value(value: Any) -> str:
    """A hyperparameter for a table: 64x64 for lists, four digits for floats."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return "x".join(format_value(item) for item in value)
    return "-" if value is None else str(value)


def format_score(value: float | None) -> str:
    """A return for a table."""
    return "-" if value is None else f"{value:.1f}"


def format_duration(seconds: float) -> str:
    """Seconds as people say them: 42 s, 3 min 20 s, 2 h 5 min."""
    if not math.isfinite(seconds):
        return "-"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def format_bytes(number: float) -> str:
    """Bytes in powers of 1,000."""
    for unit in ("B", "kB", "MB", "GB"):
        if number < 1000:
            return f"{number:.0f} {unit}"
        number /= 1000
    return f"{number:.1f} TB"
