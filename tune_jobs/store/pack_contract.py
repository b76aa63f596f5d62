"""The contract of a store for one pack; the rules for all of it are in `contract`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

from tune_jobs.store.places import check_trial_id
from tune_jobs.store.trial_contract import Ownership


@dataclass(frozen=True)
class Assignment:
    """The trials that a pack has to train."""

    trial_ids: tuple[str, ...] = ()
    """The pack's members, in the order in which they were added; a member that is not named has to be ended."""
    num_failures: Mapping[str, int] = field(default_factory=dict)
    """How often each member has failed by itself in this run; those that have not failed are left out."""
    hold_at: Mapping[str, int] = field(default_factory=dict)
    """Env steps from which a member, at its next evaluation, saves and waits for other trials; those that never wait
    are left out."""
    num_changes: Mapping[str, int] = field(default_factory=dict)
    """How many changes the record of each member has; one whose process knows fewer is opened again. Those that have
    none are left out."""

    def as_json(self) -> dict[str, Any]:
        """Return it in the form in which it is written; what an older version does not know is left out if empty."""
        new = {"hold_at": dict(self.hold_at), "num_changes": dict(self.num_changes)}
        old = {"trial_ids": list(self.trial_ids), "num_failures": dict(self.num_failures)}
        return old | {name: known for name, known in new.items() if known}

    @classmethod
    def from_json(cls, data: Any) -> Self:
        """Return what `as_json` gave.

        Raises:
            NotFoundError: A name cannot be a trial's.
            KeyError: A part is missing; a TypeError or ValueError: it is something else.
        """
        numbers = [
            {check_trial_id(trial_id): int(number) for trial_id, number in found.items()}
            for found in (data["num_failures"], data.get("hold_at", {}), data.get("num_changes", {}))
        ]
        return cls(tuple(check_trial_id(trial_id) for trial_id in data["trial_ids"]), *numbers)


class Pack(Protocol):
    """One pack. The driver writes its assignment; the pack's process reads it, and prints to the log."""

    @property
    def pack_id(self) -> str:
        """The pack's id: `p00` and so on."""
        ...

    def take(self, under: Ownership | None = None) -> Ownership:
        """Become the process that runs this pack.

        Raises:
            OwnershipLostError: Another process has taken `under`.
        """
        ...

    def write(self, assignment: Assignment, *, soon: bool = False) -> None:
        """Replace the assignment, atomically.

        Args:
            assignment: The assignment. The records of its trials are kept before.
            soon: Whether it may be kept a little later; `Sweep.settle` waits for it.

        Raises:
            CannotRunError: It cannot be written.
        """
        ...

    def read(self) -> Assignment:
        """Read the assignment.

        Raises:
            CheckpointError: It does not exist, or cannot be read.
        """
        ...

    @property
    def log_path(self) -> Path:
        """A local file that the pack's process appends its output to."""
        ...

    def begin_log(self) -> None:
        """Print the line that separates this process's output from that of earlier ones in the log."""
        ...

    def log_tail(self, num_lines: int = 15) -> str:
        """Return the lines that say how the pack's last process ended; empty without a log."""
        ...
