"""The name that was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """' Did you mean ...?' with the nearest of the known names, or nothing."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1)
    # `environment` and `epochs` look unlike `env` and `num_epochs`, but mean them.
    inside = [other for other in names if min(len(name), len(other)) >= 3 and (other in name or name in other)]
    nearest = close[0] if close else max(inside, key=len, default=None)
    return "" if nearest is None else f" Did you mean {nearest!r}?"
