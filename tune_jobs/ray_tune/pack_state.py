"""What the driver of the packs knows of one pack, and how its process hears what it has to train."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

from tune_jobs.store.contract import Assignment, Pack

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
