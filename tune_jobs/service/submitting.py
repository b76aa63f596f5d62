"""From a request to a job: validate, plan, and write a sweep, with nothing half-made if it fails."""

from __future__ import annotations

import contextlib
import hashlib
import json
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from policies.envs.modules import allow_modules, allowed_again
from policies.errors import CannotRunError, NotFoundError, SpecError, TuneJobsError
from policies.guard.guard import guarding
from tune_jobs.plan.machine import Machine, local_machine
from tune_jobs.plan.points import num_trials_of
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.jobs import Job
from tune_jobs.service.queue import Queue
from tune_jobs.spec.file import find_preset, load_spec
from tune_jobs.spec.sweep_spec import SweepSpec, check_sweep_name, name_after
from tune_jobs.spec.yaml import parse_yaml
from tune_jobs.store.contract import Storage
from tune_jobs.sweeps.drive import write_new
from tune_jobs.sweeps.prior import read_priors


class DoesNotFitError(CannotRunError):
    """A sweep needs more than this machine has: to send it again is of no use."""


@dataclass(frozen=True)
class Submission:
    """What somebody sends: exactly one of preset, text and spec."""

    preset: str | None = None
    text: str | None = None
    """A sweep file."""
    spec: Mapping[str, Any] | None = None
    """The content of one."""
    overrides: Sequence[str] = ()
    name: str | None = None
    default_name: str | None = None
    """Name if the sweep file has none; with a number if it is taken."""
    priority: int = 0
    note: str = ""
    tags: Sequence[str] = field(default_factory=tuple)
    wait_for_nodes: float | None = None
    """On a cluster: the most seconds to wait until its nodes can hold one trial; None: as the operator has said."""

    @property
    def digest(self) -> str:
        """SHA-256 of the request, by which a second one with the same idempotency key is known to be the same."""
        data: dict[str, Any] = {
            "preset": self.preset, "text": self.text, "spec": self.spec, "overrides": list(self.overrides),
            "name": self.name, "priority": self.priority, "note": self.note, "tags": list(self.tags),
        }  # fmt: skip
        if self.default_name is not None:
            data["default_name"] = self.default_name
        if self.wait_for_nodes is not None:
            data["wait_for_nodes"] = self.wait_for_nodes
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


class Submitter:
    """Makes sweeps and jobs.

    Args:
        config: The service's settings.
        queue: The jobs.
        storage: The sweeps.
    """

    def __init__(self, config: ServiceConfig, queue: Queue, storage: Storage) -> None:
        self._config, self._queue, self._storage = config, queue, storage
        self._beginning, self._settling = threading.Lock(), threading.Lock()
        self._unsettled: dict[int, float | None] = {}

    @allowed_again()
    @guarding(start=True)
    def plan(self, submission: Submission) -> tuple[SweepSpec, SweepPlan]:
        """Validate a sweep, and return what would run; nothing is written.

        Raises:
            SpecError: The sweep is wrong or not allowed here, or its name is one that no new sweep may have.
            DoesNotFitError: It needs more than this machine has.
        """
        spec, plan = self._planned(submission)
        # What a submission would refuse is not called valid.
        self._free_name(submission, spec)
        return spec, plan

    @allowed_again()
    @guarding(start=True)
    def submit(
        self,
        submission: Submission,
        *,
        owner: str,
        key: str | None = None,
        check_room: Callable[[], None] = lambda: None,
        on_made: Callable[[Job, float], None] = lambda *_: None,
    ) -> tuple[Job, bool]:
        """Write a sweep and let it wait; return its job, and whether it is new.

        Args:
            submission: The sweep.
            owner: Who asks.
            key: The idempotency key; None: the request has none.
            check_room: Raises an error if the owner may have no further one; of a request that was repeated it is not
                asked, as that makes none.
            on_made: Called with the job of a sweep that is new, and with when that was created.

        Raises:
            SpecError: The sweep is wrong or not allowed here, its name is taken, or the key was used for another one.
            DoesNotFitError: It needs more than this machine has.
            CannotRunError: It cannot be written.
        """
        arguments = waiting_arguments(self._config, submission.wait_for_nodes)
        keyed = None if key is None else (key, submission.digest)
        if (known := self._known(owner, keyed)) is not None:
            return known, False
        try:
            # To plan takes a while, which is spared.
            check_room()
            spec, plan = self._planned(submission)
            name = self._free_name(submission, spec)
        except TuneJobsError:
            # The request that this one repeats may have begun meanwhile: it is what has the name, or the room.
            if (known := self._known(owner, keyed)) is not None:
                return known, False
            raise
        # Of many that come at once, each sees those before it.
        with self._beginning:
            if (known := self._known(owner, keyed)) is not None:
                return known, False
            check_room()
            # The job comes first: a sweep whose job was never written would be begun twice where the request is
            # repeated.
            job, is_new = self._queue.begin(
                name, "drive", arguments, owner=owner, priority=submission.priority, key=keyed, state="creating"
            )
        if not is_new:
            return job, False
        job, created_at = self._written(job, submission, spec, plan)
        num_cpus = num_cpus_of(plan)
        with self._noting(job.id, num_cpus):
            job = self._queue.created(job.id, num_cpus=num_cpus)
        on_made(job, created_at)
        return job, True

    def _written(self, job: Job, submission: Submission, spec: SweepSpec, plan: SweepPlan) -> tuple[Job, float]:
        """Write the sweep of a job; the job is forgotten if that fails.

        Returns:
            The job, which may have another name by then, and when the sweep was created.
        """
        try:
            while True:
                sweep = self._storage.sweep(job.sweep)
                try:
                    sweep.create()
                    break
                except SpecError:
                    if _wanted(submission, spec) is not None:
                        raise
                    job = self._queue.rename(job.id, self._free_name(submission, spec))
            try:
                with sweep.lock():
                    created_at = write_new(sweep, spec, plan, self._config.address, "created")
            except BaseException:
                sweep.discard()
                raise
        except BaseException:
            with self._noting(job.id, None):
                self._queue.forget(job.id)
            raise
        return job, created_at

    def settle(self) -> None:
        """Tell the queue what it could not be told before: which sweeps are written by now, and which never will be.

        After a restart, `Supervisor.reconcile` does it.
        """
        with self._settling:
            for job_id, num_cpus in list(self._unsettled.items()):
                if num_cpus is None:
                    self._queue.forget(job_id)
                else:
                    with contextlib.suppress(NotFoundError):
                        self._queue.created(job_id, num_cpus=num_cpus)
                del self._unsettled[job_id]

    @contextlib.contextmanager
    def _noting(self, job_id: int, num_cpus: float | None) -> Iterator[None]:
        """Keep in mind what the queue can't be told of a job: the CPUs of its sweep, or that it has none."""
        try:
            yield
        except BaseException:
            self._unsettled[job_id] = num_cpus
            raise

    def _known(self, owner: str, keyed: tuple[str, str] | None) -> Job | None:
        """Return the job that an earlier request with this key made; None: there was none, or it has no key."""
        if keyed is None or (known := self._queue.known(owner, *keyed)) is None:
            return None
        if known.id not in self._unsettled:
            return known
        self.settle()
        return self._queue.known(owner, *keyed)

    def _planned(self, submission: Submission) -> tuple[SweepSpec, SweepPlan]:
        allow_modules(self._config.modules)
        spec = _spec_of(submission)
        if not self._config.allows_env(spec.env.id):
            raise SpecError(
                f"env.id: the environment {spec.env.id!r} is not one that may be used here.",
                "Choose one that the service's operator allows (serve --env).",
            )
        limits = self._config.limits
        # Before it is planned: a request of somebody's must not have the service plan trials by the ten thousand.
        num_trials = num_trials_of(spec) + len(spec.points) * spec.seeds_per_point
        if num_trials > limits.trials:
            raise SpecError(
                f"The sweep has {num_trials:,} trials; here a sweep may have at most {limits.trials:,}.",
                "Lower num_samples, seeds_per_point or the grids.",
            )
        try:
            prior = read_priors(spec, self._config.storage, by_name=True)
            plan = make_plan(spec, self._machine(spec), prior=prior)
        except NotFoundError as error:
            # What is asked for is there; what its sweep names is not.
            raise SpecError(error.message, error.hint) from error
        except CannotRunError as error:
            raise DoesNotFitError(error.message, error.hint) from error
        if limits.env_steps is not None and plan.max_env_steps > limits.env_steps:
            raise SpecError(
                f"The sweep may train {plan.max_env_steps:,} env steps; here it may train at most "
                f"{limits.env_steps:,}.",
                "Lower stop.num_env_steps or num_samples.",
            )
        return spec, plan

    def _machine(self, spec: SweepSpec) -> Machine:
        if self._config.address is None:
            return local_machine()
        return Machine(max(1, spec.cpus_per_trial), spec.resources.num_gpus, source=self._config.address)

    def _free_name(self, submission: Submission, spec: SweepSpec) -> str:
        wanted = _wanted(submission, spec)
        if wanted is not None:
            return self._storage.new_sweep(check_sweep_name(wanted)).name
        name = stem = check_sweep_name(name_after(submission.default_name or submission.preset or "sweep"))
        number = 1
        while self._storage.is_taken(name):
            number += 1
            try:
                name = check_sweep_name(f"{stem}-{number}")
            except SpecError as error:
                raise SpecError(
                    f"The sweep would be called '{stem}-{number}', as {stem!r} is taken; that is not allowed as a "
                    "sweep's name.",
                    f"Give another name. {error.hint}",
                ) from error
        return name


def waiting_arguments(config: ServiceConfig, wait_for_nodes: float | None) -> dict[str, float]:
    """Return what a job's arguments say of how long it waits for nodes: nothing, where it is as the operator has said.

    Raises:
        SpecError: It is given, and sweeps run on the service's own machine, where no node joins.
    """
    if wait_for_nodes is None:
        return {}
    if wait_for_nodes and config.address is None:
        raise SpecError(
            f"wait_for_nodes {wait_for_nodes:g} (--wait-for-nodes) waits for nodes of a Ray cluster, and this service "
            "runs sweeps on its own machine.",
            "Leave it out, or ask a service that runs them on a cluster (`tune-jobs serve --address`).",
        )
    return {"wait_for_nodes": wait_for_nodes}


def _wanted(submission: Submission, spec: SweepSpec) -> str | None:
    return submission.name if submission.name is not None else spec.name


def _spec_of(submission: Submission) -> SweepSpec:
    given = [item for item in (submission.preset, submission.text, submission.spec) if item is not None]
    if len(given) != 1:
        raise SpecError(f"A sweep is given as one of preset, text and spec; there are {len(given)}.")
    if submission.spec is not None:
        return load_spec(submission.spec, submission.overrides)
    if submission.preset is not None:
        # Looked up by its name here, as a text may be the path of a file of this machine.
        return load_spec(parse_yaml(find_preset(submission.preset).text, submission.preset), submission.overrides)
    data = parse_yaml(submission.text or "", "the sweep file")
    if not isinstance(data, dict):
        raise SpecError("The sweep file holds no fields.", "Begin with env: and algorithm:, or with a preset.")
    return load_spec(data, submission.overrides)


def num_cpus_of(plan: SweepPlan) -> float:
    """Return how many CPUs a sweep takes while it runs, at most those of its machine."""
    packs, others, packed = plan.packs, len(plan.trials), 0.0
    if packs is not None:
        others -= len(packs.trial_ids)
        packed = packs.num_packs * packs.cpus_per_pack
    alone = min(others, plan.max_concurrent_alone) * plan.cpus_per_trial
    # Packs are done before trials alone begin.
    return float(min(max(1.0, packed, alone), plan.machine.num_cpus))
