"""The name that was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: object, known: Iterable[str], *, at_most: int = 1, cutoff: float = 0.6) -> str:
    """' Did you mean ...?' with the nearest of the known names, or nothing. Small and capital letters are the same.

    Args:
        name: What was given; it may be no text at all.
        known: The names that there are.
        at_most: How many of the nearest are named.
        cutoff: How near a name has to be, from 0 (any is) to 1 (the same).
    """
    wanted, names = str(name).lower(), {other.lower(): other for other in known}
    close = difflib.get_close_matches(wanted, names, n=at_most, cutoff=cutoff)
    if not close:
        # `environment` and `epochs` look unlike `env` and `num_epochs`, but mean them.
        inside = [one for one in names if min(len(wanted), len(one)) >= 3 and (one in wanted or wanted in one)]
        close = [max(inside, key=len)] if inside else []
    return f" Did you mean {' or '.join(repr(names[one]) for one in close)}?" if close else ""
