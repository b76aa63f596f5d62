"""The driver of a sweep as an actor on the cluster: for clients that join by `ray://`.

A Ray client cannot run Ray Tune's loop itself. The actor runs it and writes the records to the shared storage; the
client asks it for what has changed, and shows the same table.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import ray

from analysis.records import TrialRecord
from tune_jobs.runner import Listener, RunJob, run_trials

_POLL_INTERVAL_S = 0.5


class RemoteDriver:
    """Runs one job; its two methods are called at the same time."""

    def __init__(self) -> None:
        self._changed: dict[str, TrialRecord] = {}
        self._lock = threading.Lock()

    def run(self, job: RunJob) -> None:
        """Run the job to its end."""
        run_trials(job, self._take)

    def _take(self, record: TrialRecord) -> None:
        with self._lock:
            self._changed[record.trial_id] = record

    def changes(self) -> list[TrialRecord]:
        """The records that changed since the last call."""
        with self._lock:
            changed, self._changed = self._changed, {}
        return list(changed.values())


def run_trials_remotely(job: RunJob, listener: Listener) -> None:
    """As `runner.run_trials`, with the loop in an actor on the joined cluster."""
    driver: Any = ray.remote(num_cpus=0, max_concurrency=2)(RemoteDriver).remote()
    running = driver.run.remote(job)
    ended = False
    while not ended:
        time.sleep(_POLL_INTERVAL_S)
        # Asked before the changes are fetched, so that the last ones are not missed.
        ended = bool(ray.wait([running], timeout=0)[0])
        for record in ray.get(driver.changes.remote()):
            listener(record)
    ray.get(running)
    ray.kill(driver)
