"""Tell how far a film is, whose pictures an environment may take a quarter of a second each to draw."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from policies.guard.guard import guarding


@contextlib.contextmanager
def telling_frames(say: Callable[[str], None], doing: str) -> Iterator[None]:
    """Say what is done, and while the block films, which frame is drawn.

    Args:
        say: Told what is done, from time to time.
        doing: The words for it, such as "filming".
    """
    say(doing)
    with guarding() as guard:
        before = guard.look

        def look() -> None:
            if guard.num_renders:
                say(f"{doing}: frame {guard.num_renders:,}")

        guard.look = look
        try:
            yield
        finally:
            guard.look = before
