"""What an operator sets."""

from __future__ import annotations

import ipaddress
import json
import re
from dataclasses import dataclass, field
from pathlib import Path

from policies.errors import SpecError
from tune_jobs.service.database.opening import password_in, sqlite_url
from tune_jobs.service.events import STUCK_S
from tune_jobs.service.job_files import own_database, own_folder
from tune_jobs.service.logs import LogFormat
from tune_jobs.service.telling import COMMAND, check_secret, check_target, secrets_of
from tune_jobs.store.urls import folder_of, is_url
from tune_jobs.sweeps.waiting import check_wait

LOOPBACK = "loopback"
"""As the address of a proxy: one on this machine."""


def is_loopback(address: str) -> bool:
    """Whether an address can be reached from its own machine alone."""
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Limits:
    """What one request or one person may take; None: no limit."""

    body_bytes: int = 1_000_000
    body_s: float = 30.0
    """How long a body may take to arrive."""
    trials: int = 10_000
    """Of one sweep."""
    env_steps: int | None = None
    """Of one sweep, by its caps."""
    sweeps: int | None = None
    """That wait or run, of one person."""
    watchers: int = 200
    """Event streams at once."""
    players: int = 4
    """Episodes that are played for pages at once."""


@dataclass(frozen=True)
class ServiceConfig:
    """The service's settings.

    Args:
        storage: Where sweeps are kept: an absolute folder, or a URL.
        host: The address to listen on.
        port: The port; 0: any that is free.
        address: The Ray cluster that sweeps run on; None: this machine.
        database: Its URL; None: an SQLite file in the service's own folder.
        modules: Modules of environments and RLModules that specs may name.
        envs: Patterns (regular expressions) of env ids that specs may name; none: all that need no module.
        limits: What one request or one person may take.
        spare_idle_s: How long a driver process with a Ray of its own is kept warm while no sweep comes; 0: not at all.
        webhooks: URLs that are told what happens.
        webhook_secret: What these messages are signed with; None: they are not.
        command: A command that is run when something happens, with its arguments; none: nothing is run.
        stuck_s: How long a running sweep may take no env step before it counts as stuck.
        drain_s: How long sweeps may take to save when the service ends.
        public_names: Names, or names and ports, that it is asked for by, besides this machine's own.
        require_token: Whether a token is needed on this machine, too.
        behind_proxy: The address of the proxy whose headers are believed; `loopback`: one on this machine.
        tls_certificate: A file with the certificate and those above it, PEM.
        tls_key: A file with its key, PEM.
        log_format: Of the service's own log.
        keep_audit_days: How long the audit log keeps an entry, in days.
        own_folder: The folder for what the service itself writes, which its drivers work in, too; None: one in the
            storage folder.
        wait_for_nodes: The most seconds that a sweep waits until the cluster's nodes can hold one trial, where its
            request does not say it.
    """

    storage: str | Path
    host: str = "127.0.0.1"
    port: int = 8470
    address: str | None = None
    database: str | None = None
    modules: tuple[str, ...] = ()
    envs: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    spare_idle_s: float = 1_800.0
    webhooks: tuple[str, ...] = ()
    webhook_secret: str | None = None
    command: tuple[str, ...] = ()
    stuck_s: float = STUCK_S
    drain_s: float = 60.0
    public_names: tuple[str, ...] = ()
    require_token: bool = False
    behind_proxy: str | None = None
    tls_certificate: Path | None = None
    tls_key: Path | None = None
    log_format: LogFormat = "text"
    keep_audit_days: float = 365.0
    own_folder: Path | None = None
    wait_for_nodes: float = 0.0

    def __post_init__(self) -> None:
        check_wait(self.address, self.wait_for_nodes)
        for url in self.webhooks:
            check_target(url)
        if self.webhook_secret is not None:
            check_secret(self.webhook_secret)
        for pattern in self.envs:
            try:
                re.compile(pattern)
            except re.error as error:
                raise SpecError(f"{pattern!r} is no pattern of env ids: {error}.") from error
        if self.behind_proxy not in (None, LOOPBACK):
            try:
                ipaddress.ip_address(str(self.behind_proxy))
            except ValueError as error:
                raise SpecError(
                    f"{self.behind_proxy!r} is no address of a proxy.",
                    "Give --behind-proxy alone for one on this machine, else its IP address.",
                ) from error
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise SpecError(
                "TLS needs a certificate and its key; one of them is missing.",
                "Give both --tls-certificate and --tls-key.",
            )

    @property
    def targets(self) -> tuple[str, ...]:
        """Who is told what happens."""
        return (*self.webhooks, *([COMMAND + json.dumps(self.command)] if self.command else []))

    @property
    def secrets(self) -> tuple[str, ...]:
        """What never appears in a log."""
        known = [self.webhook_secret or "", *password_in(self.database_url)]
        return tuple(item for item in [*known, *(part for url in self.webhooks for part in secrets_of(url))] if item)

    @property
    def place(self) -> str:
        """The place of the storage."""
        return str(self.storage)

    @property
    def folder(self) -> Path:
        """The folder for what the service itself writes.

        Raises:
            SpecError: The storage is an object store, and no folder was given.
        """
        if self.own_folder is not None:
            return self.own_folder
        if is_url(self.storage):
            raise SpecError(
                f"The storage {self.storage} is no folder; the service needs one for its database, jobs and logs.",
                "Give one of this machine with --folder, the same one each time.",
            )
        return own_folder(folder_of(self.storage))

    @property
    def working_folder(self) -> Path:
        """The folder that drivers work in: that of the storage, or the service's own if one was given."""
        return self.folder if self.own_folder is not None or is_url(self.storage) else folder_of(self.storage)

    @property
    def database_url(self) -> str:
        """The URL of the database, also where none was given."""
        return self.database or sqlite_url(own_database(self.folder))

    @property
    def is_local(self) -> bool:
        """Whether only this machine can reach it."""
        return is_loopback(self.host)

    @property
    def needs_token(self) -> bool:
        """Whether nobody comes in without a token: others than the users of this machine can reach it."""
        return not self.is_local or self.require_token or self.behind_proxy is not None or self.has_public_name

    @property
    def has_public_name(self) -> bool:
        """Whether it is asked for under names that this machine has elsewhere."""
        return not all(is_loopback(re.sub(r":\d+$", "", name).strip("[]").lower()) for name in self.public_names)

    def allows_env(self, env_id: str) -> bool:
        """Whether a spec may name an environment; that its module is allowed is checked elsewhere."""
        return not self.envs or any(re.fullmatch(pattern, env_id) for pattern in self.envs)
