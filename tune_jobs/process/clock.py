"""Time that passes, whatever the machine's clock is set to meanwhile."""

from __future__ import annotations

import time


def passing_s() -> float:
    """Return seconds since some moment, for differences within this machine; they go on while it sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()
