"""A sweep that is written and not begun: whoever drives it later finds all of it in its folder."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from policies.errors import TuneJobsError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.ray_tune.address import check_form
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.local_storage import open_sweep
from tune_jobs.sweeps.drive import machine_here, write_new
from tune_jobs.sweeps.storage import choose_store, create_store


@dataclass(frozen=True)
class CreatedSweep:
    """A sweep that has been written, and that nobody has begun."""

    name: str
    folder: Path


def write_created(spec: SweepSpec, name: str | None, stem: str, storage: Path, address: str | None) -> CreatedSweep:
    """Plan a sweep and write it.

    Args:
        spec: The sweep.
        name: As `choose_store`.
        stem: As `choose_store`.
        storage: As `choose_store`.
        address: Ray cluster that it is for, which is not asked; None: this machine, which must be able to run it.

    Raises:
        SpecError: The sweep is wrong, its name is taken, or the address is none. Nothing was written.
        CannotRunError: It cannot run on this machine, or the storage cannot be written. Nothing was written.
    """
    if address is not None:
        check_form(address)
    choose_store(name, stem, storage)
    plan = make_plan(spec, machine_here() if address is None else _smallest_machine(spec, address))
    store = create_store(name, stem, storage)
    try:
        with store.lock():
            write_new(store, spec, plan, address, "created")
    except BaseException:
        store.discard()
        raise
    return CreatedSweep(store.name, store.folder)


def _smallest_machine(spec: SweepSpec, address: str) -> Machine:
    """What a trial needs: trials are the same on every machine, and who drives them plans again for his."""
    return Machine(max(1, spec.cpus_per_trial), spec.resources.num_gpus, source=f"the cluster at {address}")


@contextlib.contextmanager
def removed_if_not_begun(created: CreatedSweep) -> Iterator[None]:
    """Remove a sweep again if the block fails before anything of it has begun."""
    try:
        yield
    except BaseException:
        store = open_sweep(created.folder)
        with contextlib.suppress(TuneJobsError), store.lock():
            if store.read_record().state == "created":
                store.discard()
        raise
