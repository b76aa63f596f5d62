"""Pages of long lists: sorted by a key, with cursors that hold across changes."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import math
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from policies.errors import SpecError

Item = TypeVar("Item")

MAX_CURSOR = 4_000
"""Characters of a cursor. Of the longest key and the longest name that a file system has, it takes fewer."""
_MAX_TEXT = 200
"""Characters of a text that is sorted by; of a longer one there are so many, and what tells it from others."""


def page_of(
    items: Iterable[Item],
    *,
    key: Callable[[Item], Any],
    identity: Callable[[Item], str],
    descending: bool,
    cursor: str | None,
    limit: int,
) -> tuple[list[Item], str | None]:
    """Return a page and the cursor of the next one.

    Texts come after numbers, and items without a key last, whichever way. A cursor names the last item of its
    page by key and identity: items that come and go between two pages neither repeat nor hide others. Texts that begin
    with the same 200 characters are in an order of their own, which is always the same.

    Raises:
        SpecError: The cursor is not one of this list.
    """
    with_key = [(_sortable(key(item)), identity(item), item) for item in items]
    known = sorted((entry for entry in with_key if entry[0] is not None), key=lambda entry: _place(entry[:2]))
    if descending:
        known.reverse()
    none = sorted((entry for entry in with_key if entry[0] is None), key=lambda entry: entry[1])
    ordered = [*known, *none]
    if cursor is not None:
        last = _decoded(cursor)
        ordered = [entry for entry in ordered if _is_after(entry[:2], last, descending=descending)]
    page = ordered[:limit]
    more = len(ordered) > limit
    return [entry[2] for entry in page], _encoded(page[-1][:2]) if more and page else None


def _sortable(value: Any) -> Any:
    # What is no number is neither before nor after any other: sorted by it, pages would leave items out.
    if isinstance(value, float) and math.isnan(value):
        return None
    if isinstance(value, str) and len(value) > _MAX_TEXT:
        # A cursor has the key in it, and why a trial failed takes pages.
        return value[:_MAX_TEXT] + hashlib.sha256(value.encode("utf-8", "surrogatepass")).hexdigest()
    return value


def _is_after(entry: tuple[Any, str], last: tuple[Any, str], *, descending: bool) -> bool:
    if last[0] is None:
        return entry[0] is None and entry[1] > last[1]
    if entry[0] is None:
        return True
    return _place(entry) < _place(last) if descending else _place(entry) > _place(last)


def _place(entry: tuple[Any, str]) -> tuple[bool, Any, str]:
    # A hyperparameter may have numbers and texts; numbers come first.
    return isinstance(entry[0], str), *entry


def _encoded(last: tuple[Any, str]) -> str:
    # Escaped, a letter that is not ASCII would take up to 12 characters.
    text = json.dumps(last, ensure_ascii=False).encode("utf-8", "surrogatepass")
    return base64.urlsafe_b64encode(text).decode().rstrip("=")


def _decoded(cursor: str) -> tuple[Any, str]:
    try:
        text = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)).decode("utf-8", "surrogatepass")
        value, identity = json.loads(text)
    except (ValueError, binascii.Error, TypeError, RecursionError) as error:
        raise _wrong() from error
    if not isinstance(identity, str) or not (value is None or isinstance(value, str | int | float)):
        raise _wrong()
    return value, identity


def _wrong() -> SpecError:
    return SpecError("cursor: this is no cursor of this list.", "Take `next_cursor` of the page before, unchanged.")
