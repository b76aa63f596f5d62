"""Wait until a cluster's nodes can hold one trial of a sweep, for as long as the user lets it."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from analysis.waits import WaitRecord
from policies.errors import CannotRunError, SpecError
from tune_jobs.plan.concurrency import FOR_EVER, refuse_too_large
from tune_jobs.plan.machine import Machine
from tune_jobs.process.interruption import current
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Sweep

if TYPE_CHECKING:
    from tune_jobs.ray_tune.cluster import Connection

_POLL_INTERVAL_S = 1.0


class WaitEndedError(Exception):
    """A signal or `stop` ended the wait; no trial had begun."""


def check_wait(address: str | None, wait_s: float) -> None:
    """Check that there is something to wait for.

    Raises:
        SpecError: The sweep is for this machine, where no node joins.
    """
    if wait_s and address is None:
        raise SpecError(
            f"--wait-for-nodes {wait_s:g} (wait_for_nodes) waits for nodes of a Ray cluster, and no address names one.",
            "Give --address too, or leave it out: this machine has the CPUs and GPUs that it has.",
        )


def machine_that_fits(store: Sweep, connection: Connection, wait_s: float, *, progress: str) -> Machine:
    """Return the joined cluster's machine once one trial fits there; meanwhile its autoscaler is asked for nodes.

    The sweep's record says for what, since when and until when it waits, so that others can tell it. If the wait is in
    vain, the record still says so.

    Args:
        store: The sweep, whose lock is held.
        connection: The joined cluster.
        wait_s: The most seconds to wait; 0: a cluster that is too small is returned as it is, to be refused.
        progress: The same as for `launch`.

    Raises:
        CannotRunError: The cluster is too small still, or its autoscaler may add no node that would change that.
        WaitEndedError: A signal came, or the sweep was asked to stop.
    """
    note_wait(store, None)
    spec, machine = stored_spec(store.read_record()), connection.machine
    if wait_s <= 0 or _lacking(spec, machine) is None:
        return machine
    _refuse_what_never_comes(spec, machine)
    try:
        machine = _waited(store, spec, connection, wait_s, progress)
    except KeyboardInterrupt as error:
        current().came = True
        raise WaitEndedError from error
    note_wait(store, None)
    return machine


def note_wait(store: Sweep, wait: WaitRecord | None) -> None:
    """Write into a sweep's record what it waits for; the caller has to be the one that may write it."""
    record = store.read_record()
    if record.waiting != wait:
        store.write_record(record.model_copy(update={"waiting": wait}))


def _waited(store: Sweep, spec: SweepSpec, connection: Connection, wait_s: float, progress: str) -> Machine:
    from tune_jobs.ray_tune.connected_ray import asking_for, present_machine
    from tune_jobs.sweeps.live_view import working

    since, deadline = time.time(), time.monotonic() + wait_s
    at, limit = (time.strftime("%H:%M:%S", time.localtime(each)) for each in (since, since + wait_s))
    bundles, machine = bundles_of_trial(spec), connection.machine
    with asking_for(bundles) as asked:
        while (lacking := _lacking(spec, machine)) is not None:
            seen, told = machine, f"{_told(lacking)} {_missing(spec, machine)}."
            wait = WaitRecord(since=since, until=since + wait_s, resources=total_of(bundles), lacking=told)
            note_wait(store, wait)
            what = f"waiting for nodes since {at}, until {limit} at the latest: {told.removesuffix('.')}"
            with working(store.name, what, progress):
                while machine == seen:
                    if time.monotonic() >= deadline:
                        raise _in_vain(store, connection.address, wait_s, told)
                    if store.stop_requested():
                        raise WaitEndedError
                    time.sleep(_POLL_INTERVAL_S)
                    asked.let_go()
                    machine = present_machine(seen.source)
    return machine


def _refuse_what_never_comes(spec: SweepSpec, machine: Machine) -> None:
    """Refuse a trial that would not fit on the cluster with all nodes that its autoscaler may add, if that is known.

    Raises:
        CannotRunError: It would not; the message has both numbers.
    """
    from tune_jobs.ray_tune.autoscaler import node_types

    types, lacking = node_types(), _lacking(spec, machine)
    if not types or lacking is None:
        return
    # No trial has its parts on more nodes than it has parts.
    more = [
        (each.num_cpus, each.num_gpus) for each in types for _ in range(min(each.most, len(bundles_of_trial(spec))))
    ]
    largest = replace(
        machine,
        num_cpus=machine.num_cpus + sum(cpus for cpus, _ in more),
        num_gpus=machine.num_gpus + sum(gpus for _, gpus in more),
        nodes=(*machine.nodes, *more),
    )
    if _lacking(spec, largest) is None:
        return
    known = ", ".join(
        f"{each.name} ({_resources(each.num_cpus, each.num_gpus) or 'no CPUs'}, {each.most:,} at most)"
        for each in types
    )
    raise CannotRunError(
        f"{_told(lacking)} With all nodes that its autoscaler may add it would not fit either: {known}.",
        "Give the autoscaler a type of nodes that one trial fits on, or lower what it needs: resources.num_cpus, "
        "resources.num_env_runners or resources.num_gpus.",
    )


def _in_vain(store: Sweep, address: str | None, wait_s: float, told: str) -> CannotRunError:
    job = store.read_record().job
    where = f"{job.address} --detach" if job is not None else str(address)
    again = f"tune-jobs resume {name_in_commands(store.place)} --address {where} --wait-for-nodes SECONDS"
    return CannotRunError(
        f"No node that one trial fits on joined within {wait_s:g} s. {told}",
        f"Add nodes (`ray status` says what an autoscaler does), or wait longer: `{again}`.",
    )


def _lacking(spec: SweepSpec, machine: Machine) -> CannotRunError | None:
    """Return why one trial does not fit on a machine; None: it fits."""
    try:
        refuse_too_large(spec, machine)
    except CannotRunError as error:
        return error
    return None


def _told(lacking: CannotRunError) -> str:
    return lacking.message.removesuffix(FOR_EVER).strip()


def _missing(spec: SweepSpec, machine: Machine) -> str:
    missing = _resources(spec.cpus_per_trial - machine.num_cpus, spec.resources.num_gpus - machine.num_gpus)
    return f"Missing: {missing or 'a larger node'}"


def _resources(cpus: float, gpus: float) -> str:
    return " and ".join(
        f"{count:g} {name}{'s' * (count != 1)}" for name, count in (("CPU", cpus), ("GPU", gpus)) if count > 0
    )


def bundles_of_trial(spec: SweepSpec) -> list[dict[str, float]]:
    """Return the bundles of resources that one trial needs, each on one node."""
    runners, gpus = spec.resources.num_env_runners, spec.resources.num_gpus
    main: dict[str, float] = {"CPU": float(spec.cpus_per_trial - runners)}
    if gpus:
        main["GPU"] = gpus
    return [main, *[{"CPU": 1.0}] * runners]


def total_of(bundles: list[dict[str, float]]) -> dict[str, float]:
    """Return what bundles have together, by Ray's names."""
    return {name: sum(each.get(name, 0.0) for each in bundles) for name in bundles[0]}
