"""Drawing environments where there is no display."""

from __future__ import annotations

import os
import sys


def draw_without_display() -> None:
    """Let pygame draw into memory where this machine has no display; before an environment that draws is made."""
    # pygame would greet on standard output, and open a connection to a display.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
