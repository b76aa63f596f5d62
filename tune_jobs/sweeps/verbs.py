"""Everything one can do with a sweep: the functions behind both the command line and the Python API.

Words: *create* writes a new sweep, *drive* runs it, *launch* does both, *resume* continues an interrupted one,
*extend* adds points to one, *inject* a point that somebody chose, *replicate* trains its leading points with more
seeds, *stop* ends one that another process or thread runs. A sweep is named by its folder, or by its name in the
storage folder.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from policies.arguments import PositiveInt, Seconds, checked
from policies.envs.modules import allowed_again
from policies.guard.guard import guarding
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.plan.user_code import Source, load_source, modules_of
from tune_jobs.process.interruption import can_drive, current
from tune_jobs.spec.plain_data import to_plain
from tune_jobs.sweeps.alone import run_alone
from tune_jobs.sweeps.compare import compare
from tune_jobs.sweeps.create import CreatedSweep, removed_if_not_begun, write_created
from tune_jobs.sweeps.detached import cancel_waiting
from tune_jobs.sweeps.drive import connected, forks_begun_ahead, machine_here, settled, write_new
from tune_jobs.sweeps.exports import dataframe, export, figure, study
from tune_jobs.sweeps.outcome import Progress, SweepResult
from tune_jobs.sweeps.policies import best, evaluate, restore, video
from tune_jobs.sweeps.prior import read_priors
from tune_jobs.sweeps.reproduce import reproduce
from tune_jobs.sweeps.results import importance, report, trials
from tune_jobs.sweeps.stages import run_sweep
from tune_jobs.sweeps.status import SweepStatus, list_sweeps, status
from tune_jobs.sweeps.storage import choose_store, create_store, stem_of, storage_place
from tune_jobs.sweeps.waiting import check_wait

__all__ = [
    "CreatedSweep", "SweepResult", "SweepStatus", "best", "compare", "create", "dataframe", "drive", "evaluate",
    "export", "extend", "figure", "importance", "inject", "launch", "list_sweeps", "replicate", "report", "reproduce",
    "restore", "resume", "status", "stop", "study", "trials", "video",
]  # fmt: skip


@checked
@allowed_again()
@guarding(start=True)
def create(
    source: Source,
    *,
    overrides: Sequence[str] = (),
    name: str | None = None,
    storage: str | Path | None = None,
    address: str | None = None,
    rl_module: type[Any] | str | None = None,
) -> CreatedSweep:
    """Write a new sweep without starting anything; `drive` runs it, from any thread and process.

    Args:
        source: The same as for `launch`.
        overrides: The same as for `launch`.
        name: The same as for `launch`.
        storage: The same as for `launch`.
        address: Ray cluster that it is for; it is joined only when the sweep is driven. None: this machine.
        rl_module: The same as for `launch`.

    Returns:
        The sweep's name and folder.

    Raises:
        SpecError: The sweep is wrong, or its name is taken. Nothing was written.
        CannotRunError: It cannot run here. Nothing was written.
    """
    spec = load_source(source, overrides, rl_module)
    chosen = name if name is not None else spec.name
    return write_created(spec, chosen, stem_of(source), storage_place(storage), address)


@checked
def drive(
    sweep: str | Path,
    *,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: Progress = "auto",
) -> SweepResult:
    """Run a sweep that was created, or what is missing of one, to its end; this process is afterwards as before.

    In a thread other than the main one, or if this process runs a sweep already, the sweep is run in a child process.

    Args:
        sweep: Name or folder.
        storage: Folder for sweeps.
        address: Ray cluster to run on; None: the one that it was created for or ran on last, mostly this machine.
        finish: The same as for `launch`.
        progress: The same as for `launch`.

    Raises:
        NotFoundError: There is no such sweep.
        CannotRunError: Another process or thread runs the sweep, it cannot run here, or Ray died.
        SweepInterrupted: In the same cases as `launch`; what was created is kept.
    """
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(sweep, storage)
    where = store.read_record().address if address is None else address
    return resume(store.place, address=where, finish=finish, progress=progress)


@checked
def launch(
    source: Source,
    *,
    overrides: Sequence[str] = (),
    name: str | None = None,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: Progress = "auto",
    rl_module: type[Any] | str | None = None,
    wait_for_nodes: Seconds = 0.0,
) -> SweepResult:
    """Run a new sweep to its end.

    Args:
        source: A sweep file, a preset's name, a `SweepSpec`, or a mapping with a sweep file's keys, in which `env` or
            `env.id` may be a class of your own.
        overrides: `a.b=value` settings that replace the source's.
        name: Name of the sweep and its folder; None: the spec's, else the source's with a number if it is taken.
        storage: Folder for sweeps; None: $TUNE_JOBS_STORAGE, else ./sweeps.
        address: Ray cluster to run on; None: this machine.
        finish: Whether to give the leading settings more seeds (`confirm`), choose and confirm the best policy, film it
            and write the report afterwards.
        progress: `auto`: a table on a terminal, else lines, also in threads other than the main one; or `none`.
        rl_module: An RLModule class of your own, or its `module:Class`; None: the source's, mostly none.
        wait_for_nodes: The most seconds to wait until the cluster's nodes can hold one trial; its autoscaler is asked
            for them. The sweep is written first, and kept if none come. 0: a cluster that is too small is refused.

    Returns:
        The records, and the path of each result. Failed trials are in the records; they raise no error.

    Raises:
        SpecError: The sweep is wrong, or its name is taken. Nothing was written.
        CannotRunError: It cannot run here, and nothing was written; or Ray died, and what is done can be resumed.
        SweepInterrupted: Ctrl-C, SIGTERM or SIGHUP ended it, and what is done is saved. It is a KeyboardInterrupt; an
            end by `stop` raises no error.
    """
    check_wait(address, wait_for_nodes)
    if can_drive():
        given: tuple[Any, ...] = (source, overrides, name, storage, address)
        if wait_for_nodes:
            from tune_jobs.sweeps.patient_launch import launch_and_wait

            return launch_and_wait(
                *given, finish=finish, progress=progress, rl_module=rl_module, wait_for_nodes=wait_for_nodes
            )
        return _launch_here(*given, finish=finish, progress=progress, rl_module=rl_module)
    # The source may hold classes, and errors in it are raised here.
    created = create(source, overrides=overrides, name=name, storage=storage, address=address, rl_module=rl_module)
    with removed_if_not_begun(created):
        return resume(created.place, address=address, finish=finish, progress=progress, wait_for_nodes=wait_for_nodes)


@run_alone
@guarding(start=True)
def _launch_here(
    source: Source,
    overrides: Sequence[str],
    name: str | None,
    storage: str | Path | None,
    address: str | None,
    *,
    finish: bool,
    progress: Progress,
    rl_module: type[Any] | str | None,
) -> SweepResult:
    spec = load_source(source, overrides, rl_module)
    names = (name if name is not None else spec.name, stem_of(source), storage_place(storage))
    choose_store(*names)
    # Planned here and not only on the cluster, so that a bad env or point is found before Ray starts.
    machine = machine_here() if address is None else None
    with contextlib.ExitStack() as stack:
        stack.enter_context(forks_begun_ahead(spec, machine))
        prior = read_priors(spec, storage)
        plan = make_plan(spec, machine, prior=prior) if machine is not None else None
        if plan is None:
            connection = stack.enter_context(connected(address, None))
            plan = make_plan(spec, connection.machine, prior=prior)
        store = create_store(*names)
        try:
            stack.enter_context(store.lock())
            if address is not None:
                from tune_jobs.ray_tune.node_checks import check_nodes

                plan = plan.with_notes(check_nodes(store.place, modules_of(spec), num_gpus=spec.resources.num_gpus))
            stack.enter_context(settled(store))
            write_new(store, spec, plan, address)
        except BaseException:
            with current().shielded():
                stack.pop_all().close()
                store.discard()
            raise
        return run_sweep(store, plan, address=address, machine=machine, finish=finish, progress=progress)


@checked
@run_alone
def resume(
    sweep: str | Path,
    *,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: Progress = "auto",
    retry_failed: bool = False,
    wait_for_nodes: Seconds = 0.0,
) -> SweepResult:
    """Run what is missing of a sweep: trials that had begun continue from their latest checkpoints.

    Such a trial begins new episodes, and DQN fills its replay memory anew, so its numbers differ from those of a trial
    that was never interrupted.

    Args:
        sweep: Name or folder.
        storage: Folder for sweeps.
        address: Ray cluster to run on; it need not be the one it began on.
        finish: The same as for `launch`.
        progress: The same as for `launch`.
        retry_failed: Run failed trials again too, from their latest checkpoints.
        wait_for_nodes: The same as for `launch`.

    Raises:
        NotFoundError: There is no such sweep.
        CannotRunError: Another process or thread runs the sweep, it cannot run here, or Ray died.
        SweepInterrupted: In the same cases as `launch`.
    """
    from tune_jobs.sweeps.resume import go_on
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(sweep, storage)
    return go_on(
        store, address, finish=finish, progress=progress, retry_failed=retry_failed, wait_for_nodes=wait_for_nodes
    )


@checked
@run_alone
def extend(
    sweep: str | Path,
    num_samples: PositiveInt,
    *,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: Progress = "auto",
    wait_for_nodes: Seconds = 0.0,
) -> SweepResult:
    """Add samples to a sweep and run them (and whatever else is missing).

    Args:
        sweep: Name or folder.
        num_samples: How many random draws to add for each combination of the grids' values.
        storage: Folder for sweeps.
        address: Ray cluster to run on.
        finish: The same as for `launch`.
        progress: The same as for `launch`.
        wait_for_nodes: The same as for `launch`.

    Raises:
        SpecError: num_samples is not positive, or the space has nothing random to draw.
        NotFoundError: There is no such sweep.
        CannotRunError: Another process or thread runs the sweep, it cannot run here, or Ray died.
        SweepInterrupted: In the same cases as `launch`. `resume` goes on; this again would add as many samples more.
    """
    from tune_jobs.sweeps.resume import go_on
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(sweep, storage)
    return go_on(
        store, address, num_samples=num_samples, finish=finish, progress=progress, wait_for_nodes=wait_for_nodes
    )


@checked
def inject(
    sweep: str | Path,
    point: Mapping[str, Any],
    *,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: Progress = "auto",
    wait_for_nodes: Seconds = 0.0,
) -> SweepResult:
    """Add a point of one's own to a sweep and run it (and whatever else is missing).

    It is trained with all of the sweep's `seeds_per_point`, and is shown, compared and chosen like any other. Points
    that are drawn later are the same as without it; a search method learns from it.

    Args:
        sweep: Name or folder.
        point: A value for each searched hyperparameter, by its name. A value outside of its domain is trained too, if
            the algorithm takes it; a search by a model learns nothing from such a point, and a note says so.
        storage: Folder for sweeps.
        address: Ray cluster to run on.
        finish: The same as for `launch`.
        progress: The same as for `launch`.
        wait_for_nodes: The same as for `launch`.

    Raises:
        SpecError: A name is not searched or is missing, a value is not allowed, the sweep has the point already, it has
            no space, or it is one of population based training.
        NotFoundError: There is no such sweep.
        CannotRunError: Another process or thread runs the sweep, it cannot run here, or Ray died.
        SweepInterrupted: In the same cases as `launch`.
    """
    from tune_jobs.sweeps.inject import inject_plain

    # Another process may run it, which is sent what is plain; what isn't is refused here, in whichever thread.
    plain = to_plain(point, "point")
    return inject_plain(
        sweep, plain, storage=storage, address=address, finish=finish, progress=progress, wait_for_nodes=wait_for_nodes
    )


@checked
@run_alone
def replicate(
    sweep: str | Path,
    *,
    top: PositiveInt = 5,
    seeds: PositiveInt = 5,
    race: str | None = None,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: Progress = "auto",
    wait_for_nodes: Seconds = 0.0,
) -> SweepResult:
    """Train the leading settings of a sweep again with fresh seeds, and rank them anew.

    The settings race: one that the seeds so far show to be worse than another gets no more of them. Whatever is missing
    of the sweep is run first. A scheduler of the sweep ends none of the new trials.

    A race that was interrupted goes on by `resume`, or by the same call again; once it is over, the same call is
    another race.

    Args:
        sweep: Name or folder.
        top: How many of the leading settings race.
        seeds: How many more seeds a setting gets at most.
        race: A name for the race: of one name there is one race, however often it is asked for. None: it has none.
        storage: Folder for sweeps.
        address: Ray cluster to run on.
        finish: The same as for `launch`.
        progress: The same as for `launch`.
        wait_for_nodes: The same as for `launch`.

    Raises:
        SpecError: The sweep is one of population based training, whose trials have no setting.
        NotFoundError: There is no such sweep.
        CannotRunError: Another process or thread runs the sweep, it cannot run here, or Ray died.
        SweepInterrupted: In the same cases as `launch`.
    """
    from tune_jobs.sweeps.replicate import run_race
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(sweep, storage)
    return run_race(
        store, address, top=top, seeds=seeds, finish=finish, progress=progress, name=race, wait_for_nodes=wait_for_nodes
    )


@checked
def stop(sweep: str | Path, *, storage: str | Path | None = None) -> bool:
    """Ask the process that runs a sweep to stop; its running trials save a checkpoint first.

    Returns:
        Whether a process runs the sweep, or was about to: a job that has not begun with it is ended.

    Raises:
        NotFoundError: There is no such sweep.
        CannotRunError: Only the sweep's record names the cluster of its job, which would be shown Ray's token.
    """
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(sweep, storage)
    if not store.is_driven():
        return store.read_record().job is not None and cancel_waiting(store)
    store.request_stop()
    return True
