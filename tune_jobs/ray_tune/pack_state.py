"""What the driver of the packs knows of one pack, and how its process hears what it has to train."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from tune_jobs.store.contract import Assignment, Pack

_PATIENCE_S = 300.0
"""How long a pack keeps its members without a process: Tune begins one at once, or as soon as another node has come.

By then a node that an autoscaler starts is there. Who gives them away earlier may have no use for that node any more.
"""

Tell = Callable[[Assignment], object]
"""Tells the process of a pack which trials it has to train, before it trains on."""


class PackState:
    """One pack; its members are changed by the driver.

    Args:
        files: The pack's part of the storage.
    """

    def __init__(self, files: Pack) -> None:
        self.files = files
        self.members: dict[str, None] = {}
        self.ending: set[str] = set()
        """Members that the scheduler has ended; the pack removes them before it trains on."""
        self.is_up = False
        self.tell: Tell | None = None
        """Tells its process; None: there is none, or it has not reported yet, and reads in the storage."""
        self.told: Assignment | None = None
        """What it was told last; None: nothing yet."""
        self._written: Assignment | None = None
        self._ended_at: float | None = None

    def began(self) -> None:
        """Note that its process runs."""
        self.is_up, self._ended_at = True, None

    def ended(self) -> None:
        """Note that its process has ended; Tune may begin another one."""
        self.is_up, self.tell, self._ended_at = False, None, time.monotonic()

    @property
    def is_given_up(self) -> bool:
        """Whether it has members, and its process ended so long ago that no other one is to be expected."""
        return bool(self.members) and self._ended_at is not None and time.monotonic() - self._ended_at >= _PATIENCE_S

    @property
    def staying(self) -> tuple[str, ...]:
        """The members that the pack keeps training."""
        return tuple(trial_id for trial_id in self.members if trial_id not in self.ending)

    def assign(
        self, assignment: Assignment, owned: Callable[[], AbstractContextManager[None]], *, soon: bool = False
    ) -> None:
        """Write what the pack has to train, and tell its process.

        Args:
            assignment: What it has to train.
            owned: Returns the context manager for each write of the driver.
            soon: Whether it may be kept a little later.
        """
        if self.tell is None or assignment != self._written:
            with owned():
                # A process that is told does not read it; the next one of the pack is begun after another write.
                self.files.write(assignment, soon=soon or self.tell is not None)
            self._written = assignment
        if self.tell is not None and assignment != self.told:
            # In the storage it may see it late, and train members on that have ended.
            self.tell(assignment)
            self.told = assignment
