"""Slips of the keyboard in a sweep file, and what other languages have: say what to write in their place."""

from __future__ import annotations

import math
import re
from typing import Any

from policies.errors import shortened

_WITHOUT_SPACE = re.compile(r"([A-Za-z_][\w.]*):(\S+)")
_OF_TOML = re.compile(r"(?:\[[\w.]+\]|[\w.]+[ \t]*=[ \t]*\S.*)\Z")
_NUMBER = r"[-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_IN_PARENTHESES = re.compile(rf"\([ \t]*({_NUMBER}(?:[ \t]*,[ \t]*{_NUMBER})*)[ \t]*,?[ \t]*\)")
_WITH_COMMAS = re.compile(r"[-+]?[0-9]{1,3}(?:,[0-9]{3})+")


def text_of_no_space(value: Any) -> str | None:
    """Return what to write for `lr:1e-3`, which YAML reads as one word; None: it is something else."""
    found = _WITHOUT_SPACE.match(value) if isinstance(value, str) else None
    return None if found is None else f"write a space after the colon, {found[1]}: {found[2]}"


def text_of_no_mapping(text: str, data: Any) -> str | None:
    """Return what to write where a whole sweep file is one text, or a list; None: it is not known.

    Args:
        text: The content of the file.
        data: What YAML makes of it.
    """
    if isinstance(data, list):
        return "Write the fields without dashes before them: a dash begins an item of a list."
    if (meant := text_of_toml(text)) is not None:
        return meant
    spaced = text_of_no_space(text.strip())
    return None if spaced is None else f"W{spaced[1:].splitlines()[0]}."


def text_of_toml(text: str) -> str | None:
    """Return how a sweep file is written where the first line of one is of TOML or Python; None: it is not.

    Args:
        text: The content of the file.
    """
    lines = (line.strip() for line in text.splitlines())
    first = next((line for line in lines if line and not line.startswith("#")), "")
    if _OF_TOML.match(first) is None:
        return None
    return f"Sweep files are YAML, as in `env: CartPole-v1`; the line {shortened(first)} is of another language."


def text_of_parentheses(text: str, problems: str) -> str | None:
    """Return how to write the first tuple of numbers, which YAML reads as words; None: there is none that is a problem.

    Args:
        text: The content of a sweep file. A title may have numbers in parentheses, as the year of a source.
        problems: What is wrong with the sweep: it names a part of the tuple.
    """
    without_comments = re.sub(r"(?m)(?:^|(?<=[ \t]))#.*$", "", text)
    for found in _IN_PARENTHESES.finditer(without_comments):
        parts = [part.strip() for part in found[0].split(",")]
        if len(parts) > 1 and any(part in problems for part in (parts[0], parts[-1]) if len(part) > 1):
            line = without_comments.count("\n", 0, found.start()) + 1
            return f"line {line}: YAML has no {found[0]}: write [{found[1].strip()}]"
    return None


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
