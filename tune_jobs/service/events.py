"""Notice what is worth telling: jobs that end, a new best policy, a sweep that is stuck."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from policies.errors import TuneJobsError
from tune_jobs.service.ending import join
from tune_jobs.service.jobs import Job
from tune_jobs.service.outages import Outages
from tune_jobs.service.queue import Queue
from tune_jobs.service.statuses import Statuses
from tune_jobs.service.telling import Event, Teller
from tune_jobs.sweeps.plain import to_json
from tune_jobs.sweeps.status import SweepStatus

LOOK_S = 5.0
STUCK_S = 900.0
"""How long a running sweep may take no env step before it counts as stuck."""
_EVENTS: dict[str, Event] = {"completed": "sweep.ended", "failed": "sweep.failed", "stopped": "sweep.stopped"}
_LOOKING = "Running sweeps can't be looked at"


class Watch:
    """Looks at running sweeps, in a thread.

    Args:
        queue: The jobs.
        statuses: The sweeps.
        teller: Who is told.
        stuck_s: How long a running sweep may take no env step.
        now: A monotonic clock, in seconds.
        outages: Where it is noted that sweeps can't be looked at.
    """

    def __init__(
        self,
        queue: Queue,
        statuses: Statuses,
        teller: Teller,
        *,
        stuck_s: float = STUCK_S,
        now: Callable[[], float] = time.monotonic,
        outages: Outages | None = None,
    ) -> None:
        self._outages = Outages() if outages is None else outages
        self._queue, self._statuses, self._teller = queue, statuses, teller
        self._stuck_s, self._now = stuck_s, now
        self._best: dict[str, float | None] = {}
        self._moved: dict[str, tuple[int, float]] = {}
        self._told_stuck: set[str] = set()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watching sweeps", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def close(self) -> None:
        """End."""
        self._end.set()
        join(self._thread)

    def ended(self, job: Job) -> None:
        """Tell that a job has ended."""
        event = _EVENTS.get(job.outcome or "")
        if event is None:
            return
        body: dict[str, Any] = {"sweep": job.sweep, "job": job.model_dump(mode="json")}
        try:
            body |= _told(self._statuses.see(job.sweep).status)
        except TuneJobsError as error:
            body["problem"] = error.message
        self._teller.tell(event, body)

    def _run(self) -> None:
        while not self._end.wait(LOOK_S):
            try:
                self.look()
                self._outages.worked(_LOOKING)
            except Exception as error:  # noqa: BLE001 (such as a database that is away for a while)
                self._outages.failed(_LOOKING, error)

    def look(self) -> None:
        """Look at all running sweeps once."""
        running = {job.sweep for job in self._queue.jobs("running")}
        for kept in (self._best, self._moved):
            for name in [name for name in kept if name not in running]:
                del kept[name]
        self._told_stuck &= running
        for name in sorted(running):
            try:
                status = self._statuses.see(name).status
            except TuneJobsError:
                continue
            self._look_at_best(name, status)
            self._look_whether_stuck(name, status)

    def _look_at_best(self, name: str, status: SweepStatus) -> None:
        score = None if status.best is None else status.best.score
        # What is there when one begins to look is no news.
        before = self._best.setdefault(name, score)
        if score is not None and (before is None or score > before):
            self._teller.tell("sweep.best", {"sweep": name} | _told(status))
        self._best[name] = score

    def _look_whether_stuck(self, name: str, status: SweepStatus) -> None:
        now = self._now()
        steps, since = self._moved.get(name, (-1, now))
        # While the best is confirmed and filmed, no trial takes a step.
        if status.num_env_steps != steps or status.sweep.state == "completed":
            self._moved[name] = (status.num_env_steps, now)
            self._told_stuck.discard(name)
        elif now - since >= self._stuck_s and name not in self._told_stuck:
            self._told_stuck.add(name)
            self._teller.tell("sweep.stuck", {"sweep": name, "no_env_step_for_s": round(now - since)} | _told(status))


def _told(status: SweepStatus) -> dict[str, Any]:
    return {
        "state": status.state,
        "counts": dict(status.counts),
        "num_env_steps": status.num_env_steps,
        "max_env_steps": status.max_env_steps,
        "best": None if status.best is None else to_json(status.best),
    }
