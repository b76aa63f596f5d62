"""Characters that the encoding of standard output lacks, as Latin-1 lacks "≥"."""

from __future__ import annotations

import codecs
import io
import sys

_SPELT = {"≥": ">=", "≤": "<=", "±": "+/-", "…": "...", "─": "-", "█": "#"}
_HANDLER = "tune_jobs.spelt"


def has_all_characters() -> bool:
    """Whether every character can be printed on standard output."""
    encoding = getattr(sys.stdout, "encoding", None)  # what stands for it in a program may have none
    return encoding is None or codecs.lookup(encoding).name == "utf-8"


def spell_missing_characters() -> None:
    """Print characters of tables that standard output lacks in those of ASCII, and others as "?".

    What the user has chosen for them, by PYTHONIOENCODING, stays.
    """
    stdout = sys.stdout
    if isinstance(stdout, io.TextIOWrapper) and stdout.errors == "strict" and not has_all_characters():
        codecs.register_error(_HANDLER, _spelt)
        stdout.reconfigure(errors=_HANDLER)


def _spelt(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    return "".join(_SPELT.get(character, "?") for character in error.object[error.start : error.end]), error.end
