"""The files in a sweep's `packs` folder: which trials each pack has to train, and the logs of the packs.

The process that drives the sweep writes `<pack>.json`, the pack reads it before every step and writes `<pack>.log`.
"""

from __future__ import annotations

import json
from pathlib import Path

from policies.errors import MALFORMED, CannotRunError, CheckpointError, NotFoundError
from policies.files import read_regular, write_atomic
from tune_jobs.store import names
from tune_jobs.store.logs import begin_log, log_tail
from tune_jobs.store.ownership import Owner
from tune_jobs.store.pack_contract import Assignment
from tune_jobs.store.places import check_pack_id, within
from tune_jobs.store.trial_contract import Ownership

__all__ = ["Assignment", "PackFiles"]


class PackFiles:
    """The files of one pack; implements `Pack`.

    Args:
        sweep_folder: The sweep's folder.
        pack_id: `p00` and so on.

    Raises:
        NotFoundError: This cannot be a pack's id.
    """

    def __init__(self, sweep_folder: Path, pack_id: str) -> None:
        self.pack_id = check_pack_id(pack_id)
        self._sweep_folder = sweep_folder

    @property
    def assignment_path(self) -> Path:
        """The path of `<pack>.json`."""
        return within(self._sweep_folder, names.PACKS_FOLDER, f"{self.pack_id}.json")

    @property
    def log_path(self) -> Path:
        """The path of `<pack>.log`."""
        return within(self._sweep_folder, names.PACKS_FOLDER, f"{self.pack_id}.log")

    @property
    def owner_path(self) -> Path:
        """The path of the file that says which process runs the pack."""
        return within(self._sweep_folder, names.PACKS_FOLDER, f".{self.pack_id}{names.OWNER}")

    def take(self, under: Ownership | None = None) -> Owner:
        """Become the process that runs this pack; see `Owner.take`.

        Raises:
            OwnershipLostError: Another process has taken `under`.
            CannotRunError: The sweep's folder is gone, which is not made anew.
        """
        if not self._sweep_folder.is_dir():
            raise CannotRunError(
                f"{self._sweep_folder} is gone.", "Mount or connect the storage again, and resume the sweep."
            )
        return Owner.take(self.owner_path, under)

    def write(self, assignment: Assignment, *, soon: bool = False) -> None:  # noqa: ARG002 (it is at once)
        """Replace the assignment."""
        write_atomic(self.assignment_path, json.dumps(assignment.as_json()) + "\n")

    def read(self) -> Assignment:
        """Read the assignment.

        Raises:
            CheckpointError: It does not exist, or cannot be read.
        """
        try:
            return Assignment.from_json(json.loads(read_regular(self.assignment_path)))
        except (OSError, NotFoundError, *MALFORMED) as error:
            raise CheckpointError(
                f"{self.assignment_path} does not say which trials pack {self.pack_id} trains: {repr(error)[:400]}.",
                "Check that all nodes see the sweep folder, and resume the sweep.",
            ) from error

    def begin_log(self) -> None:
        """Print the line that separates this process's output from that of earlier ones."""
        begin_log(self._what)

    def log_tail(self, num_lines: int = 15) -> str:
        """Return the lines that say how the pack's last process ended."""
        return log_tail(self.log_path, self._what, num_lines)

    @property
    def _what(self) -> str:
        return f"pack {self.pack_id}"
