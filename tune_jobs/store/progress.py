"""What a trial's process tells the process that drives the sweep."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

from pydantic import ConfigDict, Field

from analysis.records import IterationRecord, TrialState


class Progress(TrialState):
    """The state of a trial as its process knows it: everything but the number of failures, the node and the pid.

    The status is running, paused (the trial was asked to stop), completed or failed; a pack uses stopped for a member
    that it was told to end.
    """

    # Unlike a file, it cannot be of another version: an unknown name is a mistake.
    model_config = ConfigDict(extra="forbid")

    evaluated: bool
    """Whether `evaluation_return` is of this very iteration."""
    iterations: tuple[IterationRecord, ...] = Field(
        (), description="The iterations since the last report, oldest first, without their episodes."
    )

    def with_iterations(self, iterations: Sequence[IterationRecord]) -> Self:
        """Return the progress with iterations; their episodes are only in results.jsonl."""
        lean = [item.model_copy(update={"episode_returns": (), "episode_lengths": ()}) for item in iterations]
        return self.model_copy(update={"iterations": tuple(lean)})
