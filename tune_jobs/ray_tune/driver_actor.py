"""Run a sweep's driver as an actor on the cluster, for clients that join by `ray://`.

A Ray client cannot run Ray Tune's loop itself. The actor runs it and writes the records to the shared storage; the
client asks it for changes, and shows the same table. The client holds the sweep's lock and the actor its driver lock:
when a client is killed, Ray ends the actor only half a minute later, and until then the sweep must not be resumed.
"""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Any

import ray
from ray.exceptions import RayActorError

from analysis.records import TrialRecord
from policies.errors import CannotRunError, TuneJobsError
from tune_jobs.ray_tune.run_trials import RunJob, run_trials
from tune_jobs.store.opening import open_sweep, others_write, resume_command
from tune_jobs.store.record_keeper import Listener

_POLL_INTERVAL_S = 0.5
# A little of a resource that only the head node has: other nodes may leave, and the sweep would end with them.
_ON_THE_HEAD = {"node:__internal_head__": 0.001}


class RemoteDriver:
    """The actor: it runs one job; `run` and `changes` are called at the same time."""

    def __init__(self) -> None:
        self._changed: dict[str, TrialRecord] = {}
        self._lock = threading.Lock()

    def run(self, job: RunJob) -> None:
        """Run the job to its end.

        Raises:
            CannotRunError: Another driver runs this sweep.
        """
        with open_sweep(job.sweep_place).driver_lock():
            run_trials(job, self._take)

    def _take(self, record: TrialRecord) -> None:
        with self._lock:
            self._changed[record.trial_id] = record

    def changes(self) -> list[TrialRecord]:
        """Return the records that changed since the last call."""
        with self._lock:
            changed, self._changed = self._changed, {}
        return list(changed.values())


def run_trials_remotely(job: RunJob, listener: Listener) -> None:
    """Do what `run_trials.run_trials` does, with the loop in an actor on the joined cluster.

    Raises:
        CannotRunError: The actor or the connection to the cluster was lost.
    """
    others_write(job.sweep_place)
    driver: Any = ray.remote(num_cpus=0, max_concurrency=2, resources=_ON_THE_HEAD)(RemoteDriver).remote()
    try:
        running = driver.run.remote(job)
        ended = False
        while not ended:
            time.sleep(_POLL_INTERVAL_S)
            # Asked before the changes are fetched, so that the last changes are not missed.
            ended = bool(ray.wait([running], timeout=0)[0])
            for record in ray.get(driver.changes.remote()):
                listener(record)
        ray.get(running)
    except (RayActorError, ConnectionError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        go_on = _resume_command(job)
        raise CannotRunError(
            f"The sweep's driver on the cluster was lost: {reason}",
            f"What is done is kept; continue with `{go_on}` once the cluster works again.",
        ) from error
    finally:
        with contextlib.suppress(Exception):
            ray.kill(driver)


def _resume_command(job: RunJob) -> str:
    store, record = open_sweep(job.sweep_place), None
    with contextlib.suppress(TuneJobsError):
        record = store.read_record()
    return resume_command(store, record)
