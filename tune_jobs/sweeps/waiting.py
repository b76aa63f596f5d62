"""Wait until a cluster's nodes can hold one trial of a sweep, for as long as the user lets it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from policies.errors import CannotRunError
from tune_jobs.plan.concurrency import FOR_EVER, refuse_too_large
from tune_jobs.plan.machine import Machine
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.interrupted import SweepInterrupted

if TYPE_CHECKING:
    from tune_jobs.ray_tune.cluster import Connection

_POLL_INTERVAL_S = 1.0


def machine_that_fits(
    spec: SweepSpec,
    connection: Connection,
    wait_s: float,
    *,
    name: str,
    progress: str,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Machine:
    """Return the joined cluster's machine once one trial fits there; meanwhile its autoscaler is asked for nodes.

    Args:
        spec: The sweep.
        connection: The joined cluster.
        wait_s: The most seconds to wait; 0: a cluster that is too small is returned as it is, to be refused.
        name: What the sweep is called on the screen.
        progress: The same as for `launch`.
        stop_requested: Whether the sweep is asked to stop meanwhile.

    Raises:
        CannotRunError: The cluster is too small still.
        SweepInterrupted: The sweep was asked to stop; nothing was changed.
    """
    machine = connection.machine
    lacking = _lacking(spec, machine)
    if lacking is None or wait_s <= 0:
        return machine
    from tune_jobs.ray_tune.connected_ray import asking_for, present_machine
    from tune_jobs.sweeps.live_view import working

    since, deadline = time.strftime("%H:%M:%S"), time.monotonic() + wait_s
    with asking_for(_one_trial(spec)):
        while lacking is not None:
            seen = machine
            what = f"waiting for nodes since {since}, for at most {wait_s:g} s: {_told(lacking)} {_missing(spec, seen)}"
            with working(name, what, progress):
                while machine == seen:
                    if time.monotonic() >= deadline:
                        raise CannotRunError(
                            f"No node that one trial fits on joined within {wait_s:g} s. {_told(lacking)}",
                            "Add nodes (`ray status` says what an autoscaler does), or wait longer.",
                        )
                    if stop_requested():
                        raise SweepInterrupted
                    time.sleep(_POLL_INTERVAL_S)
                    machine = present_machine(seen.source)
            lacking = _lacking(spec, machine)
    return machine


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
    cpus, gpus = spec.cpus_per_trial - machine.num_cpus, spec.resources.num_gpus - machine.num_gpus
    parts = [f"{cpus:g} CPU{'s' * (cpus != 1)}"] if cpus > 0 else []
    if gpus > 0:
        parts.append(f"{gpus:g} GPU{'s' * (gpus != 1)}")
    return f"Missing: {' and '.join(parts) or 'a larger node'}"


def _one_trial(spec: SweepSpec) -> list[dict[str, float]]:
    """Return the bundles of resources that one trial needs, each on one node."""
    runners, gpus = spec.resources.num_env_runners, spec.resources.num_gpus
    main: dict[str, float] = {"CPU": float(spec.cpus_per_trial - runners)}
    if gpus:
        main["GPU"] = gpus
    return [main, *[{"CPU": 1.0}] * runners]
