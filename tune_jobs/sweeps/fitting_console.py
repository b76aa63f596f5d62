"""A console of rich's that prints no control characters of texts: records are written by others, too.

Rich's `Text` keeps ESC, with which a text could write to the clipboard of whoever looks at a sweep, or name its window.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from policies.errors import fit


class FittingConsole(Console):
    """Escapes what a terminal could not take, in all that is printed; rich's own styles and controls are no texts."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render an object into segments, of which those with a text are fitted."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=fit(segment.text))

    def on_broken_pipe(self) -> None:
        """Leave it to whoever prints whether a command fails because nobody reads it; rich would end the process.

        Raises:
            BrokenPipeError: Always.
        """
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
