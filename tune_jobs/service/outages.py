"""Say in the log that something fails once, not each time that it is tried; and once that it works again.

What runs for ever tries again and again: a database that is away for a night would fill the disk with the same lines.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy.exc import SQLAlchemyError

from policies.errors import TuneJobsError
from tune_jobs.service.database.opening import reason_of

FIRST_WAIT_S, MOST_WAIT_S = 60.0, 3_600.0
"""How long after it was told it is told again; each time twice as long, up to the second."""
CALM_S = 5.0
"""How long nothing may have failed before it is said to work again: what fails now and then is one outage."""
_DATABASE = "The service's database can't be used"
_log = logging.getLogger(__name__)


@dataclass
class _Outage:
    since: float
    tell_at: float
    wait_s: float
    last_at: float
    count: int = 0


class Outages:
    """What fails just now; threads may share it.

    Args:
        clock: A monotonic clock, in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._open: dict[str, _Outage] = {}
        self._lock = threading.Lock()

    def failed(self, what: str, error: Exception) -> None:
        """Note that something failed, which will be tried again; it is logged if that is news.

        Args:
            what: What failed, as a sentence without its end. Where the database is the reason, that is told instead,
                once for all who use it.
            error: Why.
        """
        is_database, now = isinstance(error, SQLAlchemyError), self._clock()
        what = _DATABASE if is_database else what
        with self._lock:
            is_new = what not in self._open
            outage = self._open.setdefault(what, _Outage(now, now, FIRST_WAIT_S, now))
            outage.count += 1
            outage.last_at = now
            if now < outage.tell_at:
                return
            outage.tell_at = now + outage.wait_s
            outage.wait_s = min(MOST_WAIT_S, 2.0 * outage.wait_s)
        # Where a database is away, or an error was raised on purpose, the lines of the code tell nothing.
        said = reason_of(error) if isinstance(error, SQLAlchemyError) else None
        if isinstance(error, TuneJobsError):
            said = error.message.rstrip(".")
        why, trace = (what, error) if said is None else (f"{what}: {said}", None)
        if is_new:
            _log.error("%s. It is tried again.", why, exc_info=trace)
        else:
            told = (why, now - outage.since, outage.count)
            _log.error("%s, for %.0f s by now (%d attempts).", *told, exc_info=trace)

    def worked(self, what: str) -> None:
        """Note that something worked, and with it the database."""
        if not self._open:
            return
        now = self._clock()
        with self._lock:
            over = {
                name: outage
                for name, outage in self._open.items()
                if name in (what, _DATABASE) and now - outage.last_at >= CALM_S
            }
            for name in over:
                del self._open[name]
        for name, outage in over.items():
            told = (name, outage.last_at - outage.since, outage.count)
            _log.warning("It works again: %s, for %.0f s (%d attempts).", *told)
