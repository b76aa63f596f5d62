"""Texts that leave this machine: of the paths in them the last part alone is kept, whoever wrote the text."""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_GONE = "…"
_PART = r"[^\s/\\\"'<>|:;,()\[\]{}=…]+"
# Addresses of the web stay. Between quotes a path may hold spaces; without them it ends at the first. A single part,
# such as /tmp or the 1 of "7/1", says nothing of a machine.
_PATH = re.compile(
    rf"""
    (?P<web>https?://[^\s"'<>]+)
    | (?P<quote>["'])(?:file:)?(?:~[\w.-]*|[A-Za-z]:)?[/\\]+(?:(?!(?P=quote))[^\n])*?[/\\]
      (?P<quoted>(?:(?!(?P=quote))[^\n/\\])*)(?P=quote)
    | (?<![\w.~/\\…-])(?:file:)?(?:
        (?:~[\w.-]*)?(?:/+{_PART})+/+(?P<unix>{_PART})/*
        | ~[\w.-]*/+(?P<home>{_PART})/*
        | [A-Za-z]:(?:[/\\]+{_PART})*[/\\]+(?P<drive>{_PART})[/\\]*
        | \\\\(?:{_PART}\\)+(?P<share>{_PART})\\*
      )
    """,
    re.VERBOSE,
)


class Shortener:
    """Shortens the paths in JSON-like data.

    Args:
        folders: Folders of this machine that texts may name, or those they lie in; their names may hold spaces.
    """

    def __init__(self, folders: Iterable[Path] = ()) -> None:
        given = [outer for folder in folders for outer in (folder, *folder.parents) if len(outer.parts) > 2]
        known = {str(folder) for folder in (*given, *_usual())} - {"/", "."}
        # The longest first, as it may lie in another one.
        ordered = sorted(known, key=lambda text: (-len(text), text))
        self._folders = re.compile("|".join(rf"{re.escape(text)}(?![\w.-])" for text in ordered) or r"(?!)")

    def __call__(self, value: Any) -> Any:
        """Return the same data with shorter texts, those of keys too."""
        if isinstance(value, str):
            return self.text(value)
        if isinstance(value, dict):
            return {self(key): self(item) for key, item in value.items()}
        return [self(item) for item in value] if isinstance(value, list | tuple) else value

    def text(self, text: str) -> str:
        """Return a text with shorter paths."""
        # Most texts have none.
        if "/" not in text and "\\" not in text:
            return text
        return _PATH.sub(_shorter, self._folders.sub(_GONE, text))


def _usual() -> Iterable[Path]:
    yield Path(sys.prefix)
    yield Path(tempfile.gettempdir())
    try:
        yield Path.home()
        yield Path.cwd()
    except (OSError, RuntimeError):
        # There is no such user any more, or the folder was deleted.
        return


def _shorter(found: re.Match[str]) -> str:
    if found["web"] is not None:
        return found["web"]
    if found["quote"] is not None:
        return f"{found['quote']}{_GONE}/{found['quoted']}{found['quote']}"
    name = found["unix"] or found["home"] or found["drive"] or found["share"]
    return f"{_GONE}/{name}"
