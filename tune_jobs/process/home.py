"""The home folder of a user that has none, as in a container that is run by any number (Docker's --user, OpenShift)."""

from __future__ import annotations

import os
from pathlib import Path

NO_HOME = "/nonexistent"
"""The folder of Debian's users that have none; it isn't made, so nobody else can put files there that are believed."""


def name_a_home() -> None:
    """Say where the home folder would be, if nobody does: ray.train ends at its import without one (ray 2.60)."""
    try:
        Path.home()
    except (OSError, RuntimeError):
        os.environ["HOME"] = NO_HOME
