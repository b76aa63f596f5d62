"""Find out what a launch would do: make the checks of `verbs.launch` in their order, and leave nothing behind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from policies.arguments import checked
from tune_jobs.plan.machine import local_machine
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.plan.user_code import Source, load_source, modules_of
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.drive import connected
from tune_jobs.sweeps.prior import read_priors
from tune_jobs.sweeps.storage import choose_store, stem_of, storage_place
from tune_jobs.sweeps.waiting import check_wait


@checked
def planned(
    source: Source,
    overrides: Sequence[str] = (),
    *,
    name: str | None = None,
    storage: str | Path | None = None,
    address: str | None = None,
    wait_for_nodes: float = 0.0,
) -> tuple[SweepSpec, SweepPlan]:
    """Return the sweep and the plan that `verbs.launch` would run; it waits for no node.

    Arguments and errors are those of `verbs.launch`.
    """
    check_wait(address, wait_for_nodes)
    spec = load_source(source, overrides)
    if name is not None:
        spec = spec.model_copy(update={"name": name})
    store = choose_store(spec.name, stem_of(source), storage_place(storage))
    if address is None:
        plan = make_plan(spec, local_machine(), prior=read_priors(spec, storage))
        with store.rehearsal():
            return spec, plan
    with connected(address, None) as connection:
        plan = make_plan(spec, connection.machine, prior=read_priors(spec, storage))
        with store.rehearsal() as rehearsed:
            plan = plan.with_notes(_check_nodes(rehearsed.place, modules_of(spec), spec.resources.num_gpus))
        return spec, plan


def _check_nodes(place: str, modules: Sequence[str], num_gpus: float) -> Sequence[str]:
    from tune_jobs.ray_tune.node_checks import check_nodes

    return check_nodes(place, modules, num_gpus=num_gpus)
