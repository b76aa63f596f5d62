"""What the service is just now, for Prometheus: queue, sweeps, trials, processes. It is looked up when asked for."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError

from analysis.records import SweepState, TrialStatus
from policies.errors import TuneJobsError
from tune_jobs.service.jobs import JobState, Verb
from tune_jobs.service.queue import Queue
from tune_jobs.service.statuses import Seen, Statuses
from tune_jobs.service.supervisor import Supervisor
from tune_jobs.service.telling import Teller
from tune_jobs.service.watching import Watching
from tune_jobs.store.contract import Storage

_MEMORY_FRESH_S = 60.0


class StateCollector(Collector):
    """Looks when it is asked; of a sweep it takes what `Statuses` knows, and reads only what that would read.

    Args:
        queue: The jobs.
        storage: The sweeps.
        statuses: What they look like.
        supervisor: Runs the queue.
        watching: Has the clients that follow sweeps.
        teller: Has the messages that wait.
        env_steps: Counts those of all sweeps.
    """

    def __init__(
        self,
        *,
        queue: Queue,
        storage: Storage,
        statuses: Statuses,
        supervisor: Supervisor,
        watching: Watching,
        teller: Teller,
        env_steps: EnvSteps,
    ) -> None:
        self._queue, self._storage, self._statuses = queue, storage, statuses
        self._supervisor, self._watching, self._teller = supervisor, watching, teller
        self._steps = env_steps
        self._memory = (float("-inf"), 0)

    def collect(self) -> Iterator[Metric]:
        """Return all of it; where the database is away, without what is in there."""
        try:
            found = [
                *self._jobs(),
                _gauge("tune_jobs_messages_waiting", "Messages that wait to be sent.", self._teller.waiting()),
            ]
        except SQLAlchemyError:
            found = []
        yield _gauge("tune_jobs_database_up", "Whether the database can be used.", bool(found))
        yield from found
        yield from self._sweeps()
        yield from self._processes()

    def _jobs(self) -> Iterator[Metric]:
        load = self._queue.load()
        kinds = [(state, verb) for state in get_args(JobState) for verb in get_args(Verb) if state != "ended"]
        counts = {kind: load.counts.get(kind, 0) for kind in kinds}
        yield _gauges("tune_jobs_jobs", "Jobs that have not ended.", ("state", "verb"), counts)
        yield _gauge("tune_jobs_queue_owners", "How many people's jobs wait or run.", load.num_owners)
        yield _gauge(
            "tune_jobs_queue_oldest_wait_seconds", "How long the oldest job that waits has waited.", load.waited_s
        )
        yield _gauge("tune_jobs_cpus_used", "CPUs that running jobs take.", load.num_cpus)
        if self._supervisor.where.num_cpus < float("inf"):
            yield _gauge("tune_jobs_cpus", "CPUs that running jobs share.", self._supervisor.where.num_cpus)
        yield _gauge("tune_jobs_drivers", "Processes that drive sweeps.", self._supervisor.num_drivers())

    def _sweeps(self) -> Iterator[Metric]:
        seen, names, num_unreadable = self._seen()
        states = Counter[str](item.status.state for item in seen)
        trials: Counter[str] = Counter()
        for item in seen:
            trials.update(item.status.counts)
        yield _gauges("tune_jobs_sweeps", "Sweeps by state.", ("state",), _by(get_args(SweepState), states))
        yield _gauge("tune_jobs_sweeps_unreadable", "Sweeps whose files can't be read.", num_unreadable)
        yield _gauges(
            "tune_jobs_trials", "Trials of all sweeps by status.", ("status",), _by(get_args(TrialStatus), trials)
        )
        yield CounterMetricFamily(
            "tune_jobs_env_steps_total",
            "Env steps that were trained since the service began.",
            self._steps.update(seen, names),
        )
        rate = sum(item.status.env_steps_per_s or 0.0 for item in seen if item.status.alive)
        yield _gauge("tune_jobs_env_steps_per_second", "Env steps per second of all running trials.", rate)

    def _seen(self) -> tuple[list[Seen], set[str], int]:
        found, num_unreadable = [], 0
        try:
            sweeps = self._storage.sweeps()
        except TuneJobsError:
            return [], set(), 1
        for sweep in sweeps:
            try:
                found.append(self._statuses.see(sweep.name))
            except TuneJobsError:
                # One that was deleted just now is not there the next time.
                num_unreadable += sweep.exists()
        return found, {sweep.name for sweep in sweeps}, num_unreadable

    def _processes(self) -> Iterator[Metric]:
        yield _gauge("tune_jobs_queue_up", "Whether the queue is being run.", self._supervisor.is_alive)
        yield _gauge(
            "tune_jobs_draining", "Whether nothing more is started, as the service ends.", self._supervisor.is_draining
        )
        yield _gauge("tune_jobs_event_streams", "Clients that follow sweeps.", self._watching.num_watchers)
        yield _gauge(
            "tune_jobs_event_streams_limit", "How many clients may follow sweeps.", self._watching.max_watchers
        )
        is_warm = self._supervisor.spare_is_warm()
        yield _gauge("tune_jobs_spare_warm", "Whether a process is kept warm for the next sweep.", is_warm or False)
        memory = 0 if is_warm is None else self._spare_memory()
        yield _gauge("tune_jobs_spare_memory_bytes", "Memory of the process that is kept for the next sweep.", memory)

    def _spare_memory(self) -> int:
        """Return the bytes of the process that is kept; it takes tens of milliseconds, so that it may be a bit old."""
        known_at, known = self._memory
        if time.monotonic() - known_at >= _MEMORY_FRESH_S:
            known = (self._supervisor.spare() or {}).get("memory_bytes") or 0
            self._memory = time.monotonic(), known
        return known


@dataclass
class EnvSteps:
    """Counts env steps from the numbers that sweeps have; threads may share one.

    A counter must not go back: what a sweep has trained counts on when it is deleted. What was there before the service
    began is not counted, as a counter begins at zero. Sweeps are looked at whenever somebody asks for the total, and
    when they end: nobody may ask before they are deleted.
    """

    began_at: float = field(default_factory=time.time)
    """Seconds since 1970."""
    total: int = 0
    _known: dict[str, tuple[float, int, float]] = field(default_factory=dict)
    """When a sweep was created, its env steps when it was last seen, and when that was."""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def update(self, seen: Sequence[Seen], names: Collection[str]) -> int:
        """Count what is new, and return the total.

        Args:
            seen: The sweeps as they are.
            names: All sweeps that there are, those too that can't be read just now.
        """
        with self._lock:
            for item in seen:
                self._count(item)
            self._known = {name: known for name, known in self._known.items() if name in names}
            return self.total

    def saw(self, item: Seen) -> None:
        """Count what is new of one sweep."""
        with self._lock:
            self._count(item)

    def _count(self, item: Seen) -> None:
        created_at, steps, at = item.status.sweep.created_at, item.status.num_env_steps, item.summed_up.at
        known = self._known.get(item.name)
        if known is None or known[0] != created_at:
            # Another one of the same name, or one that is seen for the first time.
            before = 0 if created_at >= self.began_at else steps
        elif at < known[2]:
            # Somebody else has seen it later, and counted.
            return
        else:
            before = known[1]
        self.total += max(0, steps - before)
        self._known[item.name] = (created_at, steps, at)


def _by(names: Sequence[str], counts: Mapping[str, int]) -> dict[tuple[str, ...], int]:
    return {(name,): counts.get(name, 0) for name in names}


def _gauge(name: str, text: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(name, text, float(value))


def _gauges(name: str, text: str, labels: Sequence[str], values: Mapping[Any, float]) -> GaugeMetricFamily:
    made = GaugeMetricFamily(name, text, labels=labels)
    for key, value in values.items():
        made.add_metric(key, value)
    return made
