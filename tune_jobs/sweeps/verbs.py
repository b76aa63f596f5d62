"""Everything one can do with a sweep; the command line and the Python API are this.

Words: *launch* starts a new sweep, *resume* goes on with an interrupted one, *extend* adds trials to one, *stop* ends
one that another process runs. A sweep is named by its folder, or by its name in the storage folder.
"""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from analysis.records import BestRecord, EvaluationRecord, SweepRecord
from policies.arguments import NumEpisodes, PositiveInt, Seed, checked
from policies.envs.modules import allowed_again
from policies.errors import TuneJobsError
from policies.guard.guard import guarding
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.plan.user_code import Source, load_source
from tune_jobs.process.interruption import current
from tune_jobs.store.sweep_store import SweepStore, list_sweep_stores
from tune_jobs.sweeps.drive import connected, machine_here, run_sweep, settled, write_new
from tune_jobs.sweeps.interrupted import run_alone
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.results import dataframe, report, trials
from tune_jobs.sweeps.storage import choose_store, create_store, expanded, stem_of, storage_folder

if TYPE_CHECKING:
    from ray.rllib.algorithms.algorithm import Algorithm

__all__ = [
    "SweepResult", "SweepStatus", "best", "dataframe", "evaluate", "extend", "launch", "list_sweeps",
    "report", "restore", "resume", "status", "stop", "trials", "video",
]  # fmt: skip

Progress = Literal["auto", "none"]


@dataclass(frozen=True)
class SweepStatus:
    """A sweep in a few numbers."""

    sweep: SweepRecord
    counts: dict[str, int]
    """Number of trials by status."""
    alive: bool
    """Whether a process runs it now."""


@run_alone
@checked
@guarding(start=True)
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
) -> SweepResult:
    """Run a new sweep to its end.

    Args:
        source: A sweep file, a preset's name, a `SweepSpec`, or a mapping with a sweep file's keys, in which `env` or
            `env.id` may be a class of your own.
        overrides: `a.b=value` settings that replace the source's.
        name: Name of the sweep and its folder; None: the spec's, else the source's with a number if it is taken.
        storage: Folder for sweeps; None: $TUNE_JOBS_STORAGE, else ./sweeps.
        address: Ray cluster to run on; None: this machine.
        finish: Also choose and confirm the best, film it and write the report.
        progress: `auto` or `none`.
        rl_module: An RLModule class of your own, or its `module:Class`; None: the source's, mostly none.

    Returns:
        The records, and where each result lies. Failed trials are in the records; they raise nothing.

    Raises:
        SpecError: The sweep is wrong, or its name is taken. Nothing was written.
        CannotRunError: It cannot run here, and nothing was written; Ray died, and what is done can be resumed; or
            another thread of this process runs a sweep.
        SweepInterrupted: Ctrl-C, SIGTERM or SIGHUP ended it, and what is done is saved. It is a KeyboardInterrupt; an
            end by `stop` raises nothing.
    """
    spec = load_source(source, overrides, rl_module)
    names = (name if name is not None else spec.name, stem_of(source), storage_folder(storage))
    choose_store(*names)
    # Here and not only on the cluster's machine, so that a bad env or point is known before Ray starts.
    machine = machine_here() if address is None else None
    plan = make_plan(spec, machine) if machine is not None else None
    with contextlib.ExitStack() as stack:
        if plan is None:
            connection = stack.enter_context(connected(address, None))
            plan = make_plan(spec, connection.machine)
        store = create_store(*names)
        try:
            stack.enter_context(store.lock())
            if address is not None:
                from tune_jobs.ray_tune.cluster import check_storage

                check_storage(store.folder)
            stack.enter_context(settled(store))
            write_new(store, spec, plan, address)
        except BaseException:
            with current().shielded():
                stack.pop_all().close()
                store.discard()
            raise
        return run_sweep(store, plan, address=address, machine=machine, finish=finish, progress=progress)


@run_alone
@checked
def resume(
    sweep: str | Path,
    *,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: Progress = "auto",
    retry_failed: bool = False,
) -> SweepResult:
    """Run what is missing of a sweep: trials that had begun go on from their latest checkpoints.

    Such a trial begins new episodes there, and DQN fills its replay memory anew: its numbers differ from those of a
    trial that nothing has interrupted.

    Args:
        sweep: Name or folder.
        storage: Folder for sweeps.
        address: Ray cluster to run on; it need not be the one it began on.
        finish: As `launch`.
        progress: As `launch`.
        retry_failed: Run failed trials again too, from their latest checkpoints.

    Raises:
        NotFoundError: No such sweep.
        CannotRunError: It is being run by another process or thread, cannot run here, or Ray died.
        SweepInterrupted: As `launch`.
    """
    from tune_jobs.sweeps.conclude import find_sweep
    from tune_jobs.sweeps.resume import go_on

    store = find_sweep(sweep, storage)
    return go_on(store, address, 0, finish=finish, progress=progress, retry_failed=retry_failed)


@run_alone
@checked
def extend(
    sweep: str | Path,
    num_samples: PositiveInt,
    *,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: Progress = "auto",
) -> SweepResult:
    """Add samples to a sweep and run them (and whatever else is missing).

    Args:
        sweep: Name or folder.
        num_samples: How many random draws to add for each combination of the grids' values.
        storage: Folder for sweeps.
        address: Ray cluster to run on.
        finish: As `launch`.
        progress: As `launch`.

    Raises:
        SpecError: num_samples is not positive, or the space has nothing random to draw.
        NotFoundError: No such sweep.
        CannotRunError: It is being run by another process or thread, cannot run here, or Ray died.
        SweepInterrupted: As `launch`.
    """
    from tune_jobs.sweeps.conclude import find_sweep
    from tune_jobs.sweeps.resume import go_on

    store = find_sweep(sweep, storage)
    return go_on(store, address, num_samples, finish=finish, progress=progress, retry_failed=False)


@checked
def stop(sweep: str | Path, *, storage: str | Path | None = None) -> bool:
    """Ask the process that runs a sweep to stop; its running trials save a checkpoint first.

    Returns:
        Whether a process runs it.
    """
    from tune_jobs.sweeps.conclude import find_sweep

    store = find_sweep(sweep, storage)
    if not store.is_driven():
        return False
    store.request_stop()
    return True


@checked
def status(sweep: str | Path, *, storage: str | Path | None = None) -> SweepStatus:
    """How a sweep stands.

    Raises:
        NotFoundError: No such sweep.
    """
    from tune_jobs.sweeps.conclude import find_sweep

    return _status(find_sweep(sweep, storage))


@checked
def list_sweeps(storage: str | Path | None = None) -> list[SweepStatus]:
    """How every sweep in a storage folder stands, by name; one that cannot be read is left out with a warning."""
    from tune_jobs.store.candidates import leave_out

    found = []
    for store in list_sweep_stores(storage_folder(storage)):
        try:
            found.append(_status(store))
        except TuneJobsError as error:
            leave_out(error)
    return found


def _status(store: SweepStore) -> SweepStatus:
    record, alive = store.read_record(), store.is_driven()
    counts = Counter(trial.status for trial in store.read_trials())
    if record.state == "running" and not alive:
        # Its process was killed before it could write so.
        record = record.model_copy(update={"state": "interrupted"})
        counts["paused"] += counts.pop("running", 0)
    return SweepStatus(record, {name: number for name, number in counts.items() if number}, alive)


@allowed_again()
@checked
def best(sweep: str | Path, *, storage: str | Path | None = None, num_episodes: NumEpisodes = 100) -> BestRecord:
    """Choose a sweep's winner, confirm it on fresh seeds, and copy its policy to best/.

    Raises:
        NotFoundError: No such sweep, or no trial of it can win (the message says why).
    """
    from tune_jobs.sweeps.conclude import choose_best, find_sweep

    return choose_best(find_sweep(sweep, storage), num_episodes)


@allowed_again()
@checked
@guarding(start=True)
def evaluate(
    source: str | Path,
    *,
    storage: str | Path | None = None,
    num_episodes: NumEpisodes = 100,
    first_seed: Seed | None = None,
    env_id: str | None = None,
    action: int | Sequence[float] | None = None,
) -> tuple[EvaluationRecord, EvaluationRecord]:
    """Run greedy episodes of a policy, and of a random one on the same seeds.

    Args:
        source: A sweep (its best), `SWEEP/TRIAL`, a checkpoint folder, a policy file, `random` or `constant`.
        storage: Folder for sweeps.
        num_episodes: How many.
        first_seed: Seeds are this and the next ones; None: seeds that no training or selection uses.
        env_id: Another environment than the policy's own; needed for a baseline.
        action: What `constant` does; None: 0.

    Returns:
        The policy's record, and the random policy's.

    Raises:
        NotFoundError: There is no such policy.
    """
    from tune_jobs.sweeps import conclude as finish

    return finish.evaluate(finish.find_policy(source, storage, env_id, action), num_episodes, first_seed)


@allowed_again()
@checked
@guarding()
def video(
    source: str | Path,
    *,
    storage: str | Path | None = None,
    output: str | Path | None = None,
    seed: Seed | None = None,
    env_id: str | None = None,
    action: int | Sequence[float] | None = None,
) -> dict[str, Path]:
    """Film a policy.

    Args:
        source: As `evaluate`.
        storage: Folder for sweeps.
        output: File to write, as .mp4 and as .gif; or a folder, that exists or whose name ends with `/`, for files
            called after policy and environment. None: into a sweep's best/ (with the random policy before, and both
            side by side), else into the current folder.
        seed: Episode to film; None: the first confirmation seed, or one that nothing else uses.
        env_id: Another environment than the policy's own; needed for a baseline.
        action: What `constant` does; None: 0.

    Returns:
        The files.

    Raises:
        NotFoundError: There is no such policy.
        EnvError: The environment cannot be drawn.
    """
    from tune_jobs.sweeps import conclude as finish

    found = finish.find_policy(source, storage, env_id, action)
    if output is None and found.store is not None:
        return finish.make_videos(found.store, seed)
    name = str(source).replace("/", "-").lstrip(".-") or "policy"
    target = _film_path(output, f"{name}-{re.sub('[/:]', '-', found.env_id)}.mp4")
    return finish.make_video(found, target, finish.FRESH_SEED if seed is None else seed)


def _film_path(output: str | Path | None, name: str) -> Path:
    """The file of a film, which is called so where `output` names no file."""
    if output is None:
        return Path(name)
    path = expanded(output)
    if str(output).endswith("/") or path.is_dir():
        return path / name
    # Of another ending, such as that of `cartpole-v0.5`, nothing is cut.
    return path if path.suffix.lower() in (".mp4", ".gif") else path.with_name(f"{path.name}.mp4")


@checked
def restore(source: str | Path, *, storage: str | Path | None = None) -> Algorithm:
    """Restore a checkpoint as an RLlib `Algorithm` that can train on.

    Checkpoints of the rllib engine are pickles: restore only sweeps you trust.

    Args:
        source: A sweep (its best checkpoint), `SWEEP/TRIAL` (the trial's best), or a checkpoint folder.
        storage: Folder for sweeps.

    Raises:
        NotFoundError: There is no such checkpoint.
        CheckpointError: It is damaged, of a baseline, or does not restore to the very weights that were saved.
    """
    from tune_jobs.sweeps.conclude import find_trained_checkpoint
    from tune_jobs.training.registry import restore_checkpoint

    folder, engine = find_trained_checkpoint(source, storage)
    algorithm: Algorithm = restore_checkpoint(folder, engine)
    return algorithm
