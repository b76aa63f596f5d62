"""Format numbers, times, seeds and paths for readers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from numbers import Real
from pathlib import Path
from typing import Any

from rich import filesize

from analysis.statistics import Estimate

NONE = "\u2013"
"""The text for a value that is not known."""
PLAIN_NONE = "-"
"""The same for a terminal, which may not be able to show the other character."""
_SMALL = 2.0
"""Returns below it have more decimals: those of 0 to 1, and what an interval of these may reach."""
_TINY = 0.01
"""Returns below it have as many significant digits as others have decimals."""
_DECIMALS = 3
_MOST_DECIMALS = 8


def number(value: Any) -> str:
    """Return a cell's text: separated thousands, four significant digits, a dash if it is not known.

    From 1,000 on, all digits before the point: 12,346 reads better than 1.235e+04.
    """
    if value is None:
        return NONE
    if isinstance(value, bool | str) or not is_number(value):
        return str(value)
    if float(value).is_integer() and abs(value) < 1e15:
        return f"{int(value):,}"
    return f"{value:,.0f}" if 1e3 <= abs(value) < 1e15 else _rounded(value, 4)


def _rounded(value: float, digits: int) -> str:
    """Return a number with some significant digits; near 1, as many of what it lacks: a gamma of 0.9904 is not 0.99."""
    text = f"{value:.{digits}g}"
    if not 0.9 <= value < 1:
        return text
    decimals = max(digits, digits - 1 - math.floor(math.log10(1.0 - value)))
    return f"{value:.{decimals}f}".rstrip("0")


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a number with what it counts: "1 point", "1,024 points"."""
    return f"{count:,} {noun if count == 1 else plural or f'{noun}s'}"


def duration(seconds: float, *, tenths: bool = True, none: str = NONE) -> str:
    """Format seconds as "8.2 s", "42 s", "1 min 10 s" or "2 h 5 min".

    Args:
        seconds: The duration.
        tenths: Whether tenths are shown below 10 s: a running clock, or an estimate, is better without them.
        none: The text if it is not finite.
    """
    if not math.isfinite(seconds):
        return none
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if tenths and seconds < 10 else f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def moment(unix_time: float | None) -> str:
    """Format a Unix time as UTC, to the minute; a dash if it is not known or not a valid time."""
    if unix_time is None:
        return NONE
    try:
        return f"{datetime.fromtimestamp(unix_time, tz=UTC):%Y-%m-%d %H:%M} UTC"
    except (ValueError, OverflowError, OSError):
        return NONE


def seed_range(seeds: Sequence[int]) -> str:
    """Format seeds as "10 (4711 to 4720)", or as a list where they are not contiguous."""
    if not seeds:
        return "none"
    if tuple(seeds) == tuple(range(seeds[0], seeds[0] + len(seeds))):
        return f"{len(seeds)} ({seeds[0]} to {seeds[-1]})" if len(seeds) > 1 else str(seeds[0])
    return f"{len(seeds)} ({', '.join(map(str, seeds))})"


def interval_text(estimate: Estimate) -> str:
    """Format an interval as "188.1 to 199.9"."""
    return range_text(estimate.lower, estimate.upper)


def is_number(value: Any) -> bool:
    """Whether a value is a real number, including NumPy's; True and False are not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def shown_path(path: str | Path) -> str:
    """Return a place as a user would type it: relative if it is below the current folder; a URL as it is."""
    if isinstance(path, str):
        if "://" in path:
            return path
        path = Path(path)
    try:
        here = Path.cwd()
    except FileNotFoundError:  # the current folder was deleted
        return str(path)
    absolute = path.absolute()
    return str(absolute.relative_to(here)) if absolute.is_relative_to(here) else str(absolute)


def shown_part(place: str, name: str) -> str:
    """Return what a user types for a part of a place, such as a trial of a sweep; a URL's settings stay behind it."""
    path, mark, settings = place.partition("?") if "://" in place else (place, "", "")
    return f"{path}/{name}{mark}{settings}"


def setting_text(value: Any) -> str:
    """Return a hyperparameter's text for a terminal, as in a sweep file: no separated thousands; 64x64 for lists."""
    if isinstance(value, float):
        return _rounded(value, 4)
    if isinstance(value, list | tuple):
        return listed([setting_text(item) for item in value], value)
    return PLAIN_NONE if value is None else str(value)


def short_text(value: Any) -> str:
    """Return a hyperparameter's text where there is little room: three significant digits; 64x64 for lists."""
    if isinstance(value, float):
        return _rounded(value, 3)
    if isinstance(value, list | tuple):
        return listed([short_text(item) for item in value], value)
    return setting_text(value)


def listed(texts: Sequence[str], values: Sequence[Any]) -> str:
    """Return the texts of a list's values as one: 64x64, and 16x8x4 32x4x2 for lists in a list."""
    return (" " if any(isinstance(value, list | tuple) for value in values) else "x").join(texts)


def return_text(value: float | None, *beside: float, none: str = NONE) -> str:
    """Format a return or a score: with one decimal; where returns are small, with more.

    Returns of 0 to 1, as FrozenLake's, are told apart by their second and third decimals.

    Args:
        value: The return.
        beside: What it is read beside, and is to have as many decimals as: an interval's other end, the mean of a
            deviation. The largest of them all decides.
        none: The text of a return that is not known.
    """
    return none if value is None else f"{value:z{_places(value, *beside)}}"


def range_text(lower: float, upper: float) -> str:
    """Format the ends of a range of returns as "188.1 to 199.9"."""
    return f"{return_text(lower, upper)} to {return_text(upper, lower)}"


def known_return_text(value: float, *beside: float) -> str:
    """Format a return or a score that may be no finite number, which is said in words."""
    if math.isfinite(value):
        return return_text(value, *beside)
    return "not a number" if math.isnan(value) else "infinite"


def difference_text(value: float, *beside: float) -> str:
    """Format a difference of two returns, with its sign and the decimals of `return_text`; nothing is "+0.0"."""
    return f"{value:+z{_places(value, *beside)}}"


def _places(*values: float) -> str:
    """Return how returns are formatted that are read beside each other."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    if largest == 0.0 or largest >= _SMALL:
        return ".1f"
    decimals = _DECIMALS if largest >= _TINY else _DECIMALS - 1 - math.floor(math.log10(largest))
    return f".{decimals}f" if decimals <= _MOST_DECIMALS else f".{_DECIMALS}g"


def bytes_text(number: float) -> str:
    """Format bytes in powers of 1,000, such as "61.2 MB"."""
    return filesize.decimal(round(number))
