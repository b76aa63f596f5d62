"""Suggest the name that was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: object, known: Iterable[str], *, at_most: int = 1, cutoff: float = 0.6) -> str:
    """Return ' Did you mean ...?' with the nearest of the known names, or nothing. Case does not matter.

    Args:
        name: What was given; it need not be a string.
        known: The names that exist.
        at_most: The most names that are suggested.
        cutoff: How near a name has to be, from 0 (any is) to 1 (the same).
    """
    wanted, names = str(name).lower(), {other.lower(): other for other in known}
    close = difflib.get_close_matches(wanted, names, n=at_most, cutoff=cutoff)
    if not close:
        # `environment` and `epochs` look unlike `env` and `num_epochs`, but mean them.
        inside = [one for one in names if min(len(wanted), len(one)) >= 3 and (one in wanted or wanted in one)]
        close = [max(inside, key=len)] if inside else []
    return f" Did you mean {' or '.join(repr(names[one]) for one in close)}?" if close else ""
