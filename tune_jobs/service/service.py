"""The parts of a running service, put together."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shlex
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

from sqlalchemy import Engine

from policies.errors import CannotRunError, TuneJobsError
from tune_jobs.plan.machine import local_machine
from tune_jobs.service.access.audit import Audit
from tune_jobs.service.access.gate import Gate
from tune_jobs.service.access.pruning import Pruning
from tune_jobs.service.access.tokens import Tokens
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database.holding import Hold, held
from tune_jobs.service.database.opening import open_database
from tune_jobs.service.derived import Derived
from tune_jobs.service.events import Watch
from tune_jobs.service.jobs import Job
from tune_jobs.service.labels import Labels, date_labels
from tune_jobs.service.metrics import Metrics
from tune_jobs.service.queue import Queue
from tune_jobs.service.state_metrics import EnvSteps, StateCollector
from tune_jobs.service.statuses import Statuses
from tune_jobs.service.storage_health import StorageHealth
from tune_jobs.service.submitting import Submitter
from tune_jobs.service.supervisor import Supervisor
from tune_jobs.service.surroundings import Surroundings
from tune_jobs.service.telling import Teller
from tune_jobs.service.turns import Turns
from tune_jobs.service.watching import Watching
from tune_jobs.store.command_names import served
from tune_jobs.store.contract import Storage
from tune_jobs.store.opening import open_storage


@dataclass(frozen=True)
class Service:
    """A service and its parts."""

    config: ServiceConfig
    engine: Engine
    gate: Gate
    storage: Storage
    queue: Queue
    labels: Labels
    statuses: Statuses
    storage_health: StorageHealth
    submitter: Submitter
    supervisor: Supervisor
    watching: Watching
    derived: Derived
    metrics: Metrics
    env_steps: EnvSteps
    adding: threading.RLock = field(default_factory=threading.RLock)
    """Held from the look at what a sweep's jobs ask for until one is added: of those that come at once, each sees those
    before it."""
    planning: Turns = field(default_factory=Turns)
    """At planning sweeps, which takes seconds each."""


@contextlib.contextmanager
def opened(config: ServiceConfig) -> Iterator[Service]:
    """Open the database and run the queue for the block; sweeps that run at its end live on.

    Raises:
        CannotRunError: Another service has this storage folder or the database, they can't be used, or nobody could
            come in.
    """
    with _alone(config), served(config.place), _database(config) as (engine, hold):
        gate = _gate(config, engine)
        storage, queue, labels = open_storage(config.place), Queue(engine), Labels(engine)
        statuses = Statuses(storage)
        # A cluster shares its CPUs among the trials of all sweeps by itself.
        num_cpus = float("inf") if config.address is not None else float(local_machine().num_cpus)
        where = Surroundings(
            config.working_folder, config.folder, config.address, num_cpus, config.modules, config.log_format,
            config.wait_for_nodes,
        )  # fmt: skip
        metrics = Metrics()
        watching = Watching(storage, statuses, queue, labels, config.limits.watchers)
        teller = Teller(
            engine, config.targets, secret=config.webhook_secret, on_attempt=metrics.delivered, outages=gate.outages
        )
        watch = Watch(queue, statuses, teller, stuck_s=config.stuck_s, outages=gate.outages)

        env_steps = EnvSteps()

        def on_end(job: Job) -> None:
            watch.ended(job)
            metrics.job_ended(job)
            with contextlib.suppress(TuneJobsError):
                env_steps.saw(statuses.see(job.sweep))

        submitter = Submitter(config, queue, storage)

        def before_look() -> None:
            hold.check()
            submitter.settle()

        supervisor = Supervisor(
            queue, storage, where,
            spare_idle_s=config.spare_idle_s, on_end=on_end, on_death=metrics.driver_died, outages=gate.outages,
            settle=before_look,
        )  # fmt: skip
        metrics.add(
            StateCollector(
                queue=queue,
                storage=storage,
                statuses=statuses,
                supervisor=supervisor,
                watching=watching,
                teller=teller,
                env_steps=env_steps,
            )
        )
        pruning = Pruning(gate.audit, config.keep_audit_days)
        with contextlib.ExitStack() as stack:
            for part in (teller, watch, supervisor, pruning):
                part.start()
                stack.callback(part.close)
            stack.callback(watching.close)
            date_labels(labels, queue, storage)
            yield Service(
                config=config,
                engine=engine,
                gate=gate,
                storage=storage,
                queue=queue,
                labels=labels,
                statuses=statuses,
                storage_health=StorageHealth(storage),
                submitter=submitter,
                supervisor=supervisor,
                watching=watching,
                derived=Derived(storage, statuses),
                metrics=metrics,
                env_steps=env_steps,
            )


@contextlib.contextmanager
def _database(config: ServiceConfig) -> Iterator[tuple[Engine, Hold]]:
    engine = open_database(config.database_url)
    try:
        with held(engine) as hold:
            yield engine, hold
    finally:
        engine.dispose()


def _gate(config: ServiceConfig, engine: Engine) -> Gate:
    tokens = Tokens(engine)
    if config.needs_token and not tokens.any_valid():
        raise CannotRunError(
            f"Others than this machine's users can reach {config.host}, so a token is needed, and there is none."
            if not config.is_local
            else "A token is needed, and there is none.",
            f"Make one: tune-jobs token make NAME --role admin{_where(config)}",
        )
    return Gate(config, tokens, Audit(engine))


def _where(config: ServiceConfig) -> str:
    if config.database is None:
        folder = "" if config.own_folder is None else f" --folder {shlex.quote(str(config.own_folder))}"
        return f" --storage {shlex.quote(config.place)}{folder}"
    # Its password stays out of the terminal.
    return " --database URL"


@contextlib.contextmanager
def _alone(config: ServiceConfig) -> Iterator[None]:
    folder, is_own = config.folder, config.own_folder is not None
    option = "--folder" if is_own else "--storage"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise CannotRunError(
            f"The service can't write {folder}: {error.strerror}.", f"Check the {'' if is_own else 'storage '}folder."
        ) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise CannotRunError(
                f"Another service has the folder {folder}."
                if is_own
                else f"Another service has the storage folder {folder.parent}.",
                f"End it first, or give another {option}.",
            ) from error
        except OSError as error:
            raise CannotRunError(
                f"The service can't lock {folder / 'lock'}: {error.strerror}.",
                f"Give another {option}, on a file system that has locks.",
            ) from error
        yield
    finally:
        os.close(descriptor)
