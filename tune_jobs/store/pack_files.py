"""What lies in a sweep's `packs` folder: whom each pack is to train, and what its process printed.

The process that drives the sweep writes `<pack>.json`, the pack reads it before every step and writes `<pack>.log`.
"""

from __future__ import annotations

import json
from pathlib import Path

from policies.errors import MALFORMED, CheckpointError, NotFoundError
from policies.files import read_regular, write_atomic
from tune_jobs.store import names
from tune_jobs.store.logs import begin_log, log_tail
from tune_jobs.store.ownership import Owner
from tune_jobs.store.places import check_pack_id, check_trial_id, within
from tune_jobs.store.trial_contract import Assignment, Ownership

__all__ = ["Assignment", "PackFiles"]


class PackFiles:
    """The files of one pack.

    Args:
        sweep_folder: The sweep's folder.
        pack_id: `p00` and so on.

    Raises:
        NotFoundError: No pack is called so.
    """

    def __init__(self, sweep_folder: Path, pack_id: str) -> None:
        self.pack_id = check_pack_id(pack_id)
        self._sweep_folder = sweep_folder

    @property
    def assignment_path(self) -> Path:
        """Of `<pack>.json`."""
        return within(self._sweep_folder, names.PACKS_FOLDER, f"{self.pack_id}.json")

    @property
    def log_path(self) -> Path:
        """Of `<pack>.log`."""
        return within(self._sweep_folder, names.PACKS_FOLDER, f"{self.pack_id}.log")

    @property
    def owner_path(self) -> Path:
        """Of what says which process is the pack."""
        return within(self._sweep_folder, names.PACKS_FOLDER, f".{self.pack_id}{names.OWNER}")

    def take(self, under: Ownership | None = None) -> Owner:
        """Become the process that is this pack; see `Owner.take`.

        Raises:
            OwnershipLostError: `under` is another's by now.
        """
        return Owner.take(self.owner_path, under)

    def write(self, assignment: Assignment) -> None:
        """Replace the assignment."""
        data = {"trial_ids": list(assignment.trial_ids), "num_failures": dict(assignment.num_failures)}
        write_atomic(self.assignment_path, json.dumps(data) + "\n")

    def read(self) -> Assignment:
        """The assignment.

        Raises:
            CheckpointError: It is not there, or cannot be read.
        """
        try:
            data = json.loads(read_regular(self.assignment_path))
            trial_ids = tuple(check_trial_id(trial_id) for trial_id in data["trial_ids"])
            failures = {check_trial_id(trial_id): int(number) for trial_id, number in data["num_failures"].items()}
            return Assignment(trial_ids, failures)
        except (OSError, NotFoundError, *MALFORMED) as error:
            raise CheckpointError(
                f"{self.assignment_path} does not tell whom pack {self.pack_id} is to train: {repr(error)[:400]}.",
                "Check that all nodes see the sweep folder, and resume the sweep.",
            ) from error

    def begin_log(self) -> None:
        """See `logs.begin_log`."""
        begin_log(self._what)

    def log_tail(self, num_lines: int = 15) -> str:
        """See `logs.log_tail`: of the pack's last process."""
        return log_tail(self.log_path, self._what, num_lines)

    @property
    def _what(self) -> str:
        return f"pack {self.pack_id}"
