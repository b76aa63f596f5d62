"""Drive a sweep whose lock is held: write its records, run its trials, and conclude it."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from analysis.records import FINISHED, SweepRecord, SweepState
from policies.errors import CannotRunError, TuneJobsError
from tune_jobs.plan.engine_choice import PackPlan, forked_of, may_pack
from tune_jobs.plan.machine import Machine, local_machine, usable_cpus
from tune_jobs.plan.sweep_plan import SweepPlan
from tune_jobs.plan.user_code import modules_of
from tune_jobs.process.clock import passing_s
from tune_jobs.process.interruption import current
from tune_jobs.process.ran_with import versions
from tune_jobs.ray_tune.address import check_address
from tune_jobs.search.given_points import given_points
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.closing import close_run
from tune_jobs.store.contract import Ownership, Sweep
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.transitions import pending_record
from tune_jobs.sweeps.changed_code import git_commit, spaces_of
from tune_jobs.sweeps.forecast import caps_of
from tune_jobs.sweeps.importing import import_what_runs_trials, importing_what_follows
from tune_jobs.sweeps.monitor import SweepMonitor
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.reached import reached_of

if TYPE_CHECKING:
    from tune_jobs.ray_tune.cluster import Connection
    from tune_jobs.ray_tune.forks import Forked

_most_cpus: ContextVar[float | None] = ContextVar("most_cpus", default=None)


def write_new(
    store: Sweep, spec: SweepSpec, plan: SweepPlan, address: str | None, state: SweepState = "running"
) -> float:
    """Write the records of a new sweep, which is run at once or only created; return when it was created."""
    for trial in plan.trials:
        store.trial(trial.trial_id).write_record(pending_record(trial), soon=True)
    # An id without its version may mean another environment by the next run, which is to train as this one does.
    env = spec.env.model_copy(update={"id": plan.env.env_id})
    # Written last: a folder without this record is not a sweep, so no reader sees half of one.
    store.write_record(
        SweepRecord(
            name=store.name,
            state=state,
            spec=spec.model_copy(update={"name": store.name, "env": env}).model_dump(mode="json"),
            evaluation_seeds=plan.evaluation_seeds,
            confirmation_seeds=plan.confirmation_seeds,
            num_trials=len(plan.trials),
            created_at=(created_at := time.time()),
            versions=versions(),
            git_commit=git_commit(),
            address=address,
            allowed_modules=modules_of(spec),
            chosen_points=given_points(spec),
            prior=plan.prior,
            env_threshold=plan.env.threshold,
            env_spaces=spaces_of(plan.env),
            is_flattened=plan.env.is_flattened,
            is_masked=plan.env.mask is not None,
        )
    )
    return created_at


def connected(
    address: str | None, here: Machine | None, *, forked: Forked | None = None
) -> AbstractContextManager[Connection]:
    """Join a cluster or start Ray here; see `cluster.connect`. Ray is imported only when this is called.

    Raises:
        SpecError: The address has a wrong form.
        CannotRunError: Nothing listens there.
    """
    if address is not None:
        check_address(address)
    from tune_jobs.ray_tune.cluster import connect

    return connect(address, here, forked=forked, meanwhile=import_what_runs_trials)


def forks_begun_ahead(spec: SweepSpec, here: Machine | None) -> AbstractContextManager[None]:
    """Let the process from which those of trials are forked import what they need while the block plans a sweep.

    Args:
        spec: The sweep, of which something is left to train.
        here: This machine, if Ray will be started here.
    """
    from tune_jobs.ray_tune.forks import begun_ahead

    # As `cluster.connect` asks for one.
    is_able = here is not None and not here.num_gpus and not _has_joined_ray()
    return begun_ahead(forked_of(spec, packs=may_pack(spec)) if is_able else None)


@contextlib.contextmanager
def within_cpus(num_cpus: float) -> Iterator[None]:
    """Let sweeps that are driven on this machine in the block use at most so many of its CPUs; others have the rest."""
    token = _most_cpus.set(num_cpus)
    try:
        yield
    finally:
        _most_cpus.reset(token)


def machine_here() -> Machine:
    """Return where a sweep without an address runs: the Ray that the user joined in this process, or this machine."""
    if not _is_connected_by_user():
        machine = local_machine()
    else:
        from tune_jobs.ray_tune.connected_ray import connected_machine

        machine = connected_machine()
    most = _most_cpus.get()
    # Only a service limits them, whose Ray, kept warm, is this machine and no cluster: its memory limits trials too.
    return machine if most is None else replace(machine, num_cpus=min(most, machine.num_cpus), nodes=())


def cpus_for_episodes(address: str | None) -> int:
    """Return in how many processes of this machine what follows a sweep's trials may play at once.

    Args:
        address: The cluster that the sweep ran on; None: this machine. On a cluster's node it is one, as the others are
            given to those who asked for them.
    """
    if address is not None:
        return 1
    most = _most_cpus.get()
    return max(1, int(usable_cpus() if most is None else min(most, usable_cpus())))


def address_of_users_ray() -> str | None:
    """Return the address of the Ray that the user joined in this process; None: there is none, or it is a sweep's."""
    if not _is_connected_by_user():
        return None
    from tune_jobs.ray_tune.connected_ray import address_for_others

    return address_for_others()


def _has_joined_ray() -> bool:
    ray: Any = sys.modules.get("ray")
    # While another thread imports ray, it has no such function yet.
    return ray is not None and bool(getattr(ray, "is_initialized", bool)())


def _is_connected_by_user() -> bool:
    if not _has_joined_ray():
        return False
    from tune_jobs.ray_tune.connected_ray import is_of_a_sweep

    return not is_of_a_sweep()


@contextlib.contextmanager
def settled(store: Sweep) -> Iterator[None]:
    """Ensure that the sweep's record does not say running after the block; its lock has to be held."""
    is_ours = True
    try:
        yield
    except OwnershipLostError:
        is_ours = False
        raise
    finally:
        # If it cannot be read or written here, this was so before too, and that error is reported.
        with current().shielded(), contextlib.suppress(TuneJobsError):
            if is_ours and store.exists():
                store.clear_stop_request()
                store.remove_leftovers()
                close_if_open(store)


class Shared:
    """What the stages of one run have in common: one Ray, one table. It is a context, which ends both.

    Attributes:
        stack: Ends what was begun.
        monitor: Sums up the trials of all stages; None before the first.
        connection: The Ray of all stages; None before the first.
        is_shown: Whether the table is on the screen.
    """

    def __init__(self) -> None:
        self.stack = contextlib.ExitStack()
        self.monitor: SweepMonitor | None = None
        self.connection: Connection | None = None
        self.is_shown = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A first signal does not cut this short; that it came is noted.
        with noted(), current().asking(lambda: None):
            self.stack.__exit__(kind, error, trace)


def run_trials_of(
    store: Sweep,
    plan: SweepPlan,
    shared: Shared,
    *,
    address: str | None,
    machine: Machine | None,
    progress: str,
    told: str = "",
) -> SweepResult:
    """Run the unfinished trials of a sweep whose lock is held.

    Args:
        store: The sweep.
        plan: Its plan.
        shared: What this has in common with earlier and later stages.
        address: Ray cluster to run on; None: this machine.
        machine: This machine, if Ray is started here.
        progress: The same as for `launch`.
        told: What these trials are for, as the table's heading says it; empty: they are the sweep's.

    Raises:
        KeyboardInterrupt: A signal came.
        CannotRunError: Ray cannot run here, or died.
    """
    # From here on, processes that an earlier run left, here or on other machines, can't take a trial any more.
    run = store.take()
    todo = tuple(trial.trial_id for trial in store.read_trials() if trial.status not in FINISHED)
    if todo:
        if current().came:
            # The signal came while the records were written, which is never cut short.
            raise KeyboardInterrupt
        record = store.read_record()
        started = record.started_at or time.time()
        store.write_record(record.model_copy(update={"state": "running", "started_at": started, "ended_at": None}))
        spec, trials = stored_spec(record), store.read_trials()
        caps = caps_of(spec, trials)
        if shared.monitor is None:
            shared.monitor = SweepMonitor(store.name, trials, caps=caps, reached=reached_of(store))
        else:
            shared.monitor.begin_stage(told, trials, caps)
        try:
            _run_trials(
                store, plan, todo, shared, run, address=address, machine=machine,
                forked=forked_of(spec, packs=plan.packs is not None), progress=progress, ran_s=record.run_time_s,
            )  # fmt: skip
        finally:
            run.release()
        close_if_open(store)
    from tune_jobs.store.candidates import read_trials

    with store.reading():
        records, record = read_trials(store), store.read_record()
    interrupted = any(trial.status not in FINISHED for trial in records)
    return SweepResult(store.place, record, records, interrupted=interrupted)


def _run_trials(
    store: Sweep,
    plan: SweepPlan,
    todo: tuple[str, ...],
    shared: Shared,
    run: Ownership,
    *,
    address: str | None,
    machine: Machine | None,
    forked: Forked | None,
    progress: str,
    ran_s: float,
) -> None:
    from tune_jobs.sweeps.live_view import shown

    monitor, stack = shared.monitor, shared.stack
    if monitor is None:
        raise RuntimeError("A stage is run before it has a monitor.")
    # Not by the clock, which may be set back.
    began_s = passing_s()
    with noted():
        if not shared.is_shown:
            monitor.phase = "starting Ray" if address is None else f"joining the Ray cluster at {address}"
            stack.enter_context(shown(monitor, progress, store.driver_log, plan.notes))
            shared.is_shown = True

        def ask() -> None:
            monitor.stopping = True
            store.request_stop()

        with current().asking(ask):
            if shared.connection is None:
                try:
                    shared.connection = stack.enter_context(connected(address, machine, forked=forked))
                except CannotRunError:
                    # A signal that ends Ray's processes as they start is no failure of Ray's, either.
                    if current().came:
                        raise KeyboardInterrupt from None
                    raise
            from tune_jobs.ray_tune.run_trials import RunJob, run_trials

            most = plan.max_concurrent_alone
            job = RunJob(
                store.place,
                todo,
                plan.cpus_per_trial,
                plan.gpus_per_trial,
                most if address is None else most_at_once(store, most, num_trials=len(todo)),
                packs=plan.packs,
                more_packs=0 if address is None else packs_for_more_nodes(store, plan.packs),
                run=run.token,
            )
            listener = importing_what_follows(monitor)
            monitor.phase = "starting the trials"
            try:
                if shared.connection.is_client:
                    from tune_jobs.ray_tune.driver_actor import run_trials_remotely

                    run_trials_remotely(job, listener)
                else:
                    run_trials(job, listener)
            except CannotRunError:
                # A signal to the whole process group ends Ray's processes too, which is not a failure of Ray.
                if not current().came:
                    raise
            finally:
                monitor.phase = "ending Ray" if address is None else "leaving the Ray cluster"
                # Done before Ray is shut down: if a part of Ray died, that takes long, and may end this process.
                with current().shielded(), run.held(), _giving_way_to(sys.exception()):
                    close_run(store, ran_s + passing_s() - began_s)


@contextlib.contextmanager
def _giving_way_to(earlier: BaseException | None) -> Iterator[None]:
    """Say nothing of what can't be written in the block if the same storage has ended the run before, which is told."""
    try:
        yield
    except CannotRunError:
        if earlier is None:
            raise


def most_at_once(store: Sweep, now: int, *, num_trials: int) -> int:
    """Return how many single trials may run at once on a cluster: those that wait may begin on nodes that join.

    Args:
        store: The sweep.
        now: How many the present nodes hold.
        num_trials: How many trials are left.
    """
    spec = stored_spec(store.read_record())
    # What a search proposes depends on how many trials run at once.
    return now if spec.search.has_model else spec.resources.max_concurrent or num_trials


def packs_for_more_nodes(store: Sweep, packs: PackPlan | None) -> int:
    """Return how many more packs may begin on nodes that join a cluster: as many as the trials that wait would fill.

    Args:
        store: The sweep.
        packs: The packs that the present nodes hold; None: there are none.
    """
    spec = stored_spec(store.read_record())
    if packs is None or spec.search.has_model:
        return 0
    at_once = packs.num_packs * packs.slots
    needed = math.ceil(max(0, len(packs.trial_ids) - at_once) / packs.slots)
    most = spec.resources.max_concurrent
    return needed if most is None else min(needed, max(0, most - at_once) // packs.slots)


@contextlib.contextmanager
def noted() -> Iterator[None]:
    """End the block at a KeyboardInterrupt, which is raised again when everything is saved."""
    try:
        yield
    except KeyboardInterrupt:
        current().came = True


def close_if_open(store: Sweep) -> None:
    """Close the run if Ray failed before the run began."""
    with current().shielded():
        if store.read_record().state == "running":
            close_run(store)
