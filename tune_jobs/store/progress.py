"""Where a trial stands: what its process tells the one that drives the sweep."""

from __future__ import annotations

from pydantic import ConfigDict

from analysis.records import TrialState


class Progress(TrialState):
    """The state of a trial as its process knows it, which is all but its failures, its node and its process's number.

    Its status is running, paused (asked to stop), completed or failed; a pack says stopped of a member that was to be
    ended.
    """

    # It is no file of another version: what has no field is a mistake.
    model_config = ConfigDict(extra="forbid")

    evaluated: bool
    """Whether `evaluation_return` is of this very iteration."""
