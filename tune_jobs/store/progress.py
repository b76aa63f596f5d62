"""What a trial's process tells the process that drives the sweep."""

from __future__ import annotations

from pydantic import ConfigDict

from analysis.records import TrialState


class Progress(TrialState):
    """The state of a trial as its process knows it: everything but the number of failures, the node and the pid.

    The status is running, paused (the trial was asked to stop), completed or failed; a pack uses stopped for a member
    that it was told to end.
    """

    # Unlike a file, it cannot be of another version: an unknown name is a mistake.
    model_config = ConfigDict(extra="forbid")

    evaluated: bool
    """Whether `evaluation_return` is of this very iteration."""
