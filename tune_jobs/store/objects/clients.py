"""The connections of a process to object stores: one set for each bucket, and for those who want an answer now."""

from __future__ import annotations

import functools
import os
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.patience import ANSWER_S

if TYPE_CHECKING:
    import obstore.store

REQUEST_TIMEOUT_S = 30.0
"""Seconds that one request may take."""
PATIENCE_S = 30.0
"""Seconds in which requests that failed for reasons that pass are repeated."""
_MAX_CLIENTS = 32
"""Buckets whose connections a process keeps: they are the same for all sweeps that it has open there."""


def client_of(url: ObjectUrl, *, now: bool) -> obstore.store.ObjectStore:
    """Return this process's connections to an address's bucket; `now`: of those who want an answer now."""
    # What it was made from: a forked process has none of its parent's threads, and each has its credentials from there.
    told = tuple(item for item in sorted(os.environ.items()) if item[0].startswith(("AWS_", "GOOGLE_", "AZURE_")))
    # Not for each sweep: to make them takes milliseconds and a new connection, and a service has thousands of sweeps.
    bucket = ObjectUrl(url.scheme, url.bucket, "", url.settings)
    return _client_of(os.getpid(), str(bucket), told, now=now)


@functools.lru_cache(maxsize=_MAX_CLIENTS)
def _client_of(
    _process: int, address: str, _told: tuple[tuple[str, str], ...], *, now: bool
) -> obstore.store.ObjectStore:
    return _open(ObjectUrl.parse(address), now=now)


def _open(url: ObjectUrl, *, now: bool) -> obstore.store.ObjectStore:
    from obstore.store import AzureStore, GCSStore, S3Store

    options: dict[str, Any] = {
        "client_options": {
            "timeout": timedelta(seconds=REQUEST_TIMEOUT_S),
            "connect_timeout": timedelta(seconds=5),
            "allow_http": url.settings.get("endpoint", "").startswith("http://"),
        },
        "retry_config": {"max_retries": 12, "retry_timeout": timedelta(seconds=PATIENCE_S)},
    }
    if now:
        # A large answer may take its time, but none that stands still.
        options["client_options"] |= {"read_timeout": timedelta(seconds=ANSWER_S)}
        options["client_options"] |= {"connect_timeout": timedelta(seconds=ANSWER_S / 2)}
        options["retry_config"] = {"max_retries": 3, "retry_timeout": timedelta(seconds=ANSWER_S / 2)}
    endpoint = url.settings.get("endpoint")
    if url.scheme == "s3":
        if endpoint:
            # A store of one's own has its buckets in the path, and seldom a region.
            options |= {"endpoint": endpoint, "virtual_hosted_style_request": False, "region": "us-east-1"}
        if region := url.settings.get("region"):
            options["region"] = region
        return S3Store(url.bucket, **options)
    if url.scheme == "gs":
        if endpoint:
            options["base_url"] = endpoint
        return GCSStore(url.bucket, **options)
    if account := url.settings.get("account"):
        options["account_name"] = account
    if endpoint:
        options["endpoint"] = endpoint
    return AzureStore(url.bucket, **options)
