"""What the service counts, as Prometheus has it.

No label says who asked, who owns what, which sweep it is or where a webhook leads: each has few values, known before.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from importlib.metadata import version
from typing import get_args

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    PlatformCollector,
    ProcessCollector,
    disable_created_metrics,
)
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from tune_jobs.service.jobs import Job, Outcome, Verb
from tune_jobs.service.telling import Delivery, Kind

_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_METHODS = frozenset({"GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE"})


class Metrics:
    """What is counted while it happens, and the registry of all that is told; threads may share one."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        # When each was first counted would be one more series for each, and nobody asks for it.
        disable_created_metrics()  # type: ignore[no-untyped-call]
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)
        Info("tune_jobs_build", "The version of tune-jobs.", registry=self.registry).info(
            {"version": version("tune-jobs"), "python": platform.python_version()}
        )
        self._requests = Histogram(
            "tune_jobs_http_request_duration_seconds",
            "Seconds from a request to the begin of its answer, by the path as it is declared.",
            ("method", "route", "status"),
            buckets=_BUCKETS_S,
            registry=self.registry,
        )
        self._ended = Counter(
            "tune_jobs_jobs_ended_total", "Jobs that have ended.", ("verb", "outcome"), registry=self.registry
        )
        self._deaths = Counter(
            "tune_jobs_driver_deaths_total", "Processes of sweeps that died before their job had ended.",
            registry=self.registry,
        )  # fmt: skip
        self._deliveries = Counter(
            "tune_jobs_webhook_deliveries_total",
            "Attempts to tell what happened; failed: it is tried again, given_up: it is not.",
            ("kind", "outcome"),
            registry=self.registry,
        )
        self._players = Gauge("tune_jobs_players", "Episodes that are being played for pages.", registry=self.registry)
        # From zero on, so that the first of each is an increase.
        for verb in get_args(Verb):
            for outcome in get_args(Outcome):
                self._ended.labels(verb, outcome)
        for kind in get_args(Kind):
            for delivery in get_args(Delivery):
                self._deliveries.labels(kind, delivery)

    def add(self, collector: Collector) -> None:
        """Tell what a collector finds, too, each time it is asked."""
        self.registry.register(collector)

    def answered(self, method: str, route: str, status: int, took_s: float) -> None:
        """Count a request whose answer has begun.

        Args:
            method: Its method.
            route: Its path as it is declared.
            status: The answer's status.
            took_s: How long it took until then, in seconds.
        """
        known = method if method in _METHODS else "other"
        self._requests.labels(known, route, f"{status // 100}xx").observe(took_s)

    def job_ended(self, job: Job) -> None:
        """Count a job that has ended."""
        if job.outcome is not None:
            self._ended.labels(job.verb, job.outcome).inc()

    def driver_died(self) -> None:
        """Count a driver that died."""
        self._deaths.inc()

    def delivered(self, kind: Kind, delivery: Delivery) -> None:
        """Count an attempt to tell something."""
        self._deliveries.labels(kind, delivery).inc()

    def ask_for_players(self, count: Callable[[], int]) -> None:
        """Say how it is known how many episodes are being played."""
        self._players.set_function(count)

    def exposition(self, accept: str) -> tuple[bytes, str]:
        """Return all metrics and their media type.

        Args:
            accept: What the client takes, as the header Accept has it: OpenMetrics if it names that, else Prometheus'
                text format.
        """
        encoder, media_type = choose_encoder(accept)
        return encoder(self.registry), media_type
