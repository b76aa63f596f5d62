"""Write a sweep without beginning it; everything that a later run needs is in its folder."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from analysis.notebook import facts_html
from policies.errors import TuneJobsError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.ray_tune.address import check_form
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import open_sweep
from tune_jobs.sweeps.drive import machine_here, write_new
from tune_jobs.sweeps.prior import read_priors
from tune_jobs.sweeps.storage import choose_store, create_store, folder_at, shown_place


@dataclass(frozen=True)
class CreatedSweep:
    """A sweep that has been written but not begun."""

    name: str
    place: str = field(metadata={"json": "folder"})
    """Where it is: its folder, or its URL in an object store."""

    @property
    def folder(self) -> Path:
        """The sweep's folder.

        Raises:
            SpecError: The sweep is in an object store, and has none.
        """
        return folder_at(self.place)

    def _repr_html_(self) -> str:
        facts = {"folder": shown_place(self.place), "run it with": "tune_jobs.drive(...)"}
        return facts_html(f"Sweep {self.name}: created", facts)


def write_created(spec: SweepSpec, name: str | None, stem: str, storage: str, address: str | None) -> CreatedSweep:
    """Plan a sweep and write it.

    Args:
        spec: The sweep.
        name: The same as for `choose_store`.
        stem: The same as for `choose_store`.
        storage: The same as for `choose_store`.
        address: The Ray cluster that it is for, which is not contacted; None: this machine, which must be large enough.

    Raises:
        SpecError: The sweep is wrong, its name is taken, or the address has a wrong form. Nothing was written.
        CannotRunError: It cannot run on this machine, or the storage cannot be written. Nothing was written.
    """
    if address is not None:
        check_form(address)
    choose_store(name, stem, storage)
    machine = machine_here() if address is None else _smallest_machine(spec, address)
    plan = make_plan(spec, machine, prior=read_priors(spec, storage))
    store = create_store(name, stem, storage)
    try:
        with store.lock():
            write_new(store, spec, plan, address, "created")
    except BaseException:
        store.discard()
        raise
    return CreatedSweep(store.name, store.place)


def _smallest_machine(spec: SweepSpec, address: str) -> Machine:
    """Return a machine of the size of one trial, as the sweep is planned again for the machine that it runs on."""
    return Machine(max(1, spec.cpus_per_trial), spec.resources.num_gpus, source=f"the cluster at {address}")


@contextlib.contextmanager
def removed_if_not_begun(created: CreatedSweep) -> Iterator[None]:
    """Remove a sweep again if the block fails before any part of it has begun, unless it waited for nodes in vain."""
    try:
        yield
    except BaseException:
        store = open_sweep(created.place)
        with contextlib.suppress(TuneJobsError), store.lock():
            remove_unless_it_waited(store)
        raise


def remove_unless_it_waited(store: Sweep) -> None:
    """Remove a sweep whose lock is held if it has not begun; one that waited for nodes is resumed when they are there.

    Others may have seen it wait, for hours.
    """
    record = store.read_record()
    if record.state == "created" and record.waiting is None:
        store.discard()
