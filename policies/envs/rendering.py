"""Draw environments where there is no display."""

from __future__ import annotations

import os
import sys


def draw_without_display() -> None:
    """Let pygame draw into memory if this machine has no display; call it before making an environment that draws."""
    # Otherwise pygame prints a greeting on standard output and connects to a display.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
