"""Tell in a sweep's record, in the middle of its run, that no node has room for a trial any more."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

from analysis.records import FINISHED
from analysis.waits import WaitRecord
from policies.errors import CannotRunError
from tune_jobs.store.contract import Sweep
from tune_jobs.store.record_keeper import RecordKeeper

# As for the live table: from one trial to the next takes less.
_IDLE_S = 10.0
_LACKING = "Trials are left, and none runs: no node that is there has room for one."


class RunWaits:
    """Writes into the record of a sweep on a cluster that it waits, while none of its trials runs, and takes it away.

    A run that begins is no wait: until its first trial has run, nothing is said.

    Args:
        store: The sweep.
        keeper: The records of its trials.
        clock: A monotonic clock, in seconds.

    Attributes:
        resources: CPUs and GPUs of one trial, or of one pack, by Ray's names.
    """

    def __init__(self, store: Sweep, keeper: RecordKeeper, clock: Callable[[], float] = time.monotonic) -> None:
        self._store, self._keeper, self._clock = store, keeper, clock
        # On one machine no node comes or goes.
        self._looks = store.read_record().address is not None
        self._ran_at: float | None = None
        self._is_told = False
        self.resources: dict[str, float] = {}

    def __getstate__(self) -> dict[str, Any]:
        # As for `RecordKeeper`, Tune's pickle of what uses this is never read back.
        return {}

    def look(self) -> None:
        """Find out whether a trial runs, and write it if that has changed; called continually.

        Raises:
            OwnershipLostError: Another process runs the sweep by now.
        """
        if not self._looks:
            return
        now = self._clock()
        if self._keeper.running:
            self._ran_at = now
            self.end()
        elif not self._is_told and self._ran_at is not None and now - self._ran_at >= _IDLE_S and self._is_left():
            since = time.time() - (now - self._ran_at)
            self._write(WaitRecord(since=since, resources=self.resources, lacking=_LACKING))

    def end(self) -> None:
        """Take it away, as a trial runs again or the run ends.

        Raises:
            OwnershipLostError: Another process runs the sweep by now.
        """
        if self._is_told:
            self._write(None)

    def _is_left(self) -> bool:
        return any(record.status not in FINISHED for record in self._keeper.all_records())

    def _write(self, wait: WaitRecord | None) -> None:
        self._is_told = wait is not None
        # A storage that can't be written is told by others, who know since when.
        with contextlib.suppress(CannotRunError, OSError), self._keeper.owned():
            self._store.write_record(self._store.read_record().model_copy(update={"waiting": wait}))
