"""Keep the audit log from growing for ever: entries that are old enough are removed, at the start and daily."""

from __future__ import annotations

import logging
import threading

from sqlalchemy.exc import SQLAlchemyError

from tune_jobs.service.access.audit import Audit
from tune_jobs.service.ending import join

PAUSE_S = 86_400.0
_RETRY_S = 600.0
_DAY_S = 86_400.0
_log = logging.getLogger(__name__)


class Pruning:
    """Prunes the audit log, in a thread.

    Args:
        audit: The log.
        keep_days: How old an entry may be, in days.
    """

    def __init__(self, audit: Audit, keep_days: float) -> None:
        self._audit, self._keep_days = audit, keep_days
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pruning the audit log", daemon=True)

    def start(self) -> None:
        """Begin; the first time is now."""
        self._thread.start()

    def close(self) -> None:
        """End."""
        self._end.set()
        join(self._thread)

    def prune(self) -> int:
        """Remove what is old enough; return how many entries that were."""
        removed = 0
        # In parts, as others wait for the database meanwhile.
        while not self._end.is_set() and (some := self._audit.remove_older(self._keep_days * _DAY_S)):
            removed += some
        if removed:
            _log.info(
                "%d entries of the audit log were older than %g days; they are removed.", removed, self._keep_days
            )
        return removed

    def _run(self) -> None:
        wait_s = 0.0
        while not self._end.wait(wait_s):
            try:
                self.prune()
                wait_s = PAUSE_S
            except SQLAlchemyError as error:
                _log.warning("The audit log could not be pruned (%s); it is tried again.", type(error).__name__)
                wait_s = _RETRY_S
