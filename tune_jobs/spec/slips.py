"""Slips of the keyboard in a sweep file: say what to write in their place."""

from __future__ import annotations

import math
import re
from typing import Any

_WITHOUT_SPACE = re.compile(r"([A-Za-z_][\w.]*):(\S+)")
_WITH_COMMAS = re.compile(r"[-+]?[0-9]{1,3}(?:,[0-9]{3})+")


def text_of_no_space(value: Any) -> str | None:
    """Return what to write for `lr:1e-3`, which YAML reads as one word; None: it is something else."""
    found = _WITHOUT_SPACE.match(value) if isinstance(value, str) else None
    return None if found is None else f"write a space after the colon, {found[1]}: {found[2]}"


def number_in(text: str) -> float | None:
    """Return the finite number, an int if it can be, that a text in quotes holds; None: it holds none."""
    digits = text.replace(",", "") if _WITH_COMMAS.fullmatch(text) else text
    for kind in (int, float):
        try:
            number = kind(digits)
        except ValueError:
            continue
        return number if math.isfinite(number) else None
    return None
