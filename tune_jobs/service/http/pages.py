"""Pages of long lists: sorted by a key, with cursors that hold across changes."""

from __future__ import annotations

import base64
import binascii
import json
import math
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from policies.errors import SpecError

Item = TypeVar("Item")


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
    page by key and identity: items that come and go between two pages neither repeat nor hide others.

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
    return None if isinstance(value, float) and math.isnan(value) else value


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
    return base64.urlsafe_b64encode(json.dumps(last).encode()).decode().rstrip("=")


def _decoded(cursor: str) -> tuple[Any, str]:
    try:
        value, identity = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
    except (ValueError, binascii.Error, TypeError, RecursionError) as error:
        raise _wrong() from error
    if not isinstance(identity, str) or not (value is None or isinstance(value, str | int | float)):
        raise _wrong()
    return value, identity


def _wrong() -> SpecError:
    return SpecError("cursor: this is no cursor of this list.", "Take `next_cursor` of the page before, unchanged.")
