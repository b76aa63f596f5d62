"""Everything one can do with a sweep; the command line and the Python API are this.

Words: *launch* starts a new sweep, *resume* goes on with an interrupted one, *extend* adds trials to one, *stop* ends one
that another process runs. A sweep is named by its folder, or by its name in the storage folder.
"""

from __future__ import annotations

import contextlib
import platform
import shutil
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from analysis.records import FINISHED, BestRecord, EvaluationRecord, SweepRecord, TrialRecord
from policies.errors import CannotRunError, NotFoundError, SpecError, TuneJobsError
from tune_jobs.monitor import SweepMonitor
from tune_jobs.plan import Machine, SweepPlan, TrialPlan, local_machine, make_plan
from tune_jobs.spec import SweepSpec, check_sweep_name
from tune_jobs.spec_file import load_spec
from tune_jobs.store import SweepStore, list_sweep_stores

if TYPE_CHECKING:
    import pandas as pd
    from ray.rllib.algorithms.algorithm import Algorithm

_PACKAGES = ("tune-jobs", "ray", "torch", "gymnasium", "numpy")
Source = str | Path | Mapping[str, Any] | SweepSpec


@dataclass(frozen=True)
class SweepResult:
    """What a launch, resume or extend left."""

    folder: Path
    sweep: SweepRecord
    trials: list[TrialRecord]
    best: BestRecord | None = None
    why_no_best: str | None = None
    artifacts: dict[str, Path] = field(default_factory=dict)
    """Where each result lies: policy, before_mp4, after_mp4, after_gif, before_after_mp4, report."""
    interrupted: bool = False
    notes: tuple[str, ...] = ()
    """What could not be made (a video of an environment that can't be drawn, say), and why."""

    @property
    def exit_code(self) -> int:
        """130 if it was interrupted, 3 if a trial failed, else 0."""
        if self.interrupted:
            return 130
        return 3 if any(trial.status == "failed" for trial in self.trials) else 0


@dataclass(frozen=True)
class SweepStatus:
    """A sweep in a few numbers."""

    sweep: SweepRecord
    counts: dict[str, int]
    """Number of trials by status."""
    alive: bool
    """Whether a process runs it now."""


def launch(
    source: Source,
    *,
    overrides: Sequence[str] = (),
    name: str | None = None,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: str = "auto",
) -> SweepResult:
    """Run a new sweep to its end.

    Args:
        source: A sweep file, a preset's name, a mapping with a sweep file's keys, or a `SweepSpec`.
        overrides: `a.b=value` settings that replace the source's.
        name: Name of the sweep and its folder; None: the spec's, else the source's with a number if it is taken.
        storage: Folder for sweeps; None: $TUNE_JOBS_STORAGE, else ./sweeps.
        address: Ray cluster to run on; None: this machine.
        finish: Also choose and confirm the best, film it and write the report.
        progress: `auto` or `none`.

    Returns:
        The records, and where each result lies. Failed trials are in the records; they raise nothing.

    Raises:
        SpecError: The sweep is wrong, or its name is taken. Nothing was written.
        CannotRunError: It cannot run here. Nothing was written.
    """
    spec = _load(source, overrides)
    store = _new_store(spec, source, name, storage)
    # Here and not only on the cluster's machine, so that a bad env or point is known before Ray starts.
    machine = local_machine() if address is None else None
    plan = make_plan(spec, machine) if machine is not None else None
    with contextlib.ExitStack() as stack:
        if plan is None:
            connection = stack.enter_context(_connected(address, None))
            plan = make_plan(spec, connection.machine)
        store.create()
        try:
            stack.enter_context(store.lock())
            if address is not None:
                from tune_jobs.cluster import check_storage

                check_storage(store.folder)
            _write_new(store, spec, plan, address)
        except BaseException:
            stack.pop_all().close()
            shutil.rmtree(store.folder, ignore_errors=True)
            raise
        return _run(store, plan, address=address, machine=machine, finish=finish, progress=progress)


def resume(
    sweep: str | Path,
    *,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: str = "auto",
    retry_failed: bool = False,
) -> SweepResult:
    """Run what is missing of a sweep: trials that had begun go on from their latest checkpoints.

    Args:
        sweep: Name or folder.
        storage: Folder for sweeps.
        address: Ray cluster to run on; it need not be the one it began on.
        finish: As `launch`.
        progress: As `launch`.
        retry_failed: Run failed trials again too, from their latest checkpoints.

    Raises:
        NotFoundError: No such sweep.
        CannotRunError: It is being run by another process, or cannot run here.
    """
    return _go_on(sweep, storage, address, 0, finish=finish, progress=progress, retry_failed=retry_failed)


def extend(
    sweep: str | Path,
    num_samples: int,
    *,
    storage: str | Path | None = None,
    address: str | None = None,
    finish: bool = True,
    progress: str = "auto",
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
        CannotRunError: It is being run by another process, or cannot run here.
    """
    if num_samples < 1:
        raise SpecError(f"num_samples is {num_samples}.", "Add at least 1 sample.")
    return _go_on(sweep, storage, address, num_samples, finish=finish, progress=progress, retry_failed=False)


def _go_on(
    sweep: str | Path,
    storage: str | Path | None,
    address: str | None,
    num_samples: int,
    *,
    finish: bool,
    progress: str,
    retry_failed: bool,
) -> SweepResult:
    from tune_jobs.finish import find_sweep

    store = find_sweep(sweep, storage)
    with contextlib.ExitStack() as stack:
        stack.enter_context(store.lock())
        record = store.read_record()
        spec = SweepSpec.model_validate(record.spec)
        spec = spec.model_copy(update={"num_samples": spec.num_samples + num_samples})
        machine = local_machine() if address is None else None
        if machine is None:
            connection = stack.enter_context(_connected(address, None))
            from tune_jobs.cluster import check_storage

            check_storage(store.folder)
        plan = make_plan(spec, machine or connection.machine)
        _check_same_trials(store, plan)
        for trial in plan.trials:
            trial_store = store.trial(trial.trial_id)
            if not trial_store.record_path.is_file():
                trial_store.write_record(_pending(trial))
            elif retry_failed and (known := trial_store.read_record()).status == "failed":
                trial_store.write_record(known.model_copy(update={"status": "pending", "error": None}))
        changes = {"spec": spec.model_dump(mode="json"), "num_trials": len(plan.trials), "address": address}
        store.write_record(record.model_copy(update=changes))
        return _run(store, plan, address=address, machine=machine, finish=finish, progress=progress)


def stop(sweep: str | Path, *, storage: str | Path | None = None) -> bool:
    """Ask the process that runs a sweep to stop; its running trials save a checkpoint first.

    Returns:
        Whether a process runs it.
    """
    from tune_jobs.finish import find_sweep

    store = find_sweep(sweep, storage)
    if not store.is_driven():
        return False
    store.request_stop()
    return True


def status(sweep: str | Path, *, storage: str | Path | None = None) -> SweepStatus:
    """How a sweep stands.

    Raises:
        NotFoundError: No such sweep.
    """
    from tune_jobs.finish import find_sweep

    return _status(find_sweep(sweep, storage))


def list_sweeps(storage: str | Path | None = None) -> list[SweepStatus]:
    """How every sweep in a storage folder stands, by name."""
    from tune_jobs.finish import storage_folder

    return [_status(store) for store in list_sweep_stores(storage_folder(storage))]


def _status(store: SweepStore) -> SweepStatus:
    record, alive = store.read_record(), store.is_driven()
    if record.state == "running" and not alive:
        # Its process was killed before it could write so.
        record = record.model_copy(update={"state": "interrupted"})
    return SweepStatus(record, dict(Counter(trial.status for trial in store.read_trials())), alive)


def trials(sweep: str | Path, *, storage: str | Path | None = None) -> list[TrialRecord]:
    """A sweep's trials, by index.

    Raises:
        NotFoundError: No such sweep.
    """
    from tune_jobs.finish import find_sweep, read_trials

    return read_trials(find_sweep(sweep, storage))


def dataframe(sweep: str | Path, *, storage: str | Path | None = None) -> pd.DataFrame:
    """A sweep's trials as a pandas DataFrame, one row a trial.

    Raises:
        NotFoundError: No such sweep.
    """
    from analysis.tables import trials_frame
    from tune_jobs.finish import find_sweep, read_results, read_trials

    store = find_sweep(sweep, storage)
    return trials_frame(read_trials(store), read_results(store))


def best(sweep: str | Path, *, storage: str | Path | None = None, num_episodes: int = 100) -> BestRecord:
    """Choose a sweep's winner, confirm it on fresh seeds, and copy its policy to best/.

    Raises:
        NotFoundError: No such sweep, or no trial of it can win (the message says why).
    """
    from tune_jobs.finish import choose_best, find_sweep

    return choose_best(find_sweep(sweep, storage), num_episodes)


def evaluate(
    source: str | Path,
    *,
    storage: str | Path | None = None,
    num_episodes: int = 100,
    first_seed: int | None = None,
    env_id: str | None = None,
) -> tuple[EvaluationRecord, EvaluationRecord]:
    """Run greedy episodes of a policy, and of a random one on the same seeds.

    Args:
        source: A sweep (its best), `SWEEP/TRIAL`, a checkpoint folder, a policy file, or `random`.
        storage: Folder for sweeps.
        num_episodes: How many.
        first_seed: Seeds are this and the next ones; None: seeds that no training or selection uses.
        env_id: Another environment than the policy's own.

    Returns:
        The policy's record, and the random policy's.

    Raises:
        NotFoundError: There is no such policy.
    """
    from tune_jobs import finish

    if num_episodes < 1:
        raise SpecError(f"num_episodes is {num_episodes}.", "Ask for at least 1 episode.")
    found = finish.find_policy(source, storage, env_id)
    first = finish.FRESH_SEED if first_seed is None else first_seed
    seeds = tuple(range(first, first + num_episodes))
    record = finish.run_evaluation(found.policy, found.env_id, found.env_args, seeds)
    baseline = finish.find_policy(finish.RANDOM, env_id=found.env_id)
    return record, finish.run_evaluation(baseline.policy, found.env_id, found.env_args, seeds)


def video(
    source: str | Path,
    *,
    storage: str | Path | None = None,
    output: str | Path | None = None,
    seed: int | None = None,
    env_id: str | None = None,
) -> dict[str, Path]:
    """Film a policy.

    Args:
        source: As `evaluate`.
        storage: Folder for sweeps.
        output: File to write (its ending is replaced by .mp4 and .gif); None: into a sweep's best/ (with the random
            policy before, and both side by side), else `./<policy>.mp4`.
        seed: Episode to film; None: the first confirmation seed, or one that nothing else uses.
        env_id: Another environment than the policy's own.

    Returns:
        The files.

    Raises:
        NotFoundError: There is no such policy.
        EnvError: The environment cannot be drawn.
    """
    from tune_jobs import finish

    found = finish.find_policy(source, storage, env_id)
    if output is None and found.store is not None:
        return finish.make_videos(found.store, seed)
    name = str(source).replace("/", "-").lstrip(".-") or "policy"
    target = Path(output) if output is not None else Path(f"{name}-{found.env_id.replace('/', '-')}.mp4")
    return finish.make_video(found, target, finish.FRESH_SEED if seed is None else seed)


def report(sweep: str | Path, *, storage: str | Path | None = None) -> Path:
    """Write a sweep's report; returns its index.html.

    Raises:
        NotFoundError: No such sweep.
    """
    from tune_jobs.finish import find_sweep, make_report

    return make_report(find_sweep(sweep, storage))


def restore(source: str | Path, *, storage: str | Path | None = None) -> Algorithm:
    """Restore a checkpoint as an RLlib `Algorithm` that can train on.

    RLlib's checkpoints are pickles: restore only sweeps you trust.

    Args:
        source: A sweep (its best checkpoint), `SWEEP/TRIAL` (the trial's best), or a checkpoint folder.
        storage: Folder for sweeps.

    Raises:
        NotFoundError: There is no such checkpoint.
        CheckpointError: It is damaged, or does not restore to the very weights that were saved.
    """
    from policies.portable import read_policy
    from policies.restore import restore_algorithm
    from tune_jobs import finish
    from tune_jobs.store import MANIFEST, verify_checkpoint

    folder = Path(source).expanduser()
    if not (folder / MANIFEST).is_file():
        store, trial_id = finish._sweep_and_trial(str(source), storage)  # noqa: SLF001 (one package)
        if trial_id is None:
            with contextlib.suppress(NotFoundError):
                folder = store.folder / store.read_best().checkpoint.path
            if not folder.is_dir():
                folder = store.folder / finish.choose_best(store).checkpoint.path
        else:
            folder = store.folder / finish.best_checkpoint(store, trial_id).path
    verify_checkpoint(folder)
    return restore_algorithm(folder / "rllib", read_policy(folder).network)


def machine(address: str) -> Machine:
    """What a Ray cluster has to run on.

    Raises:
        CannotRunError: Nothing answers at the address.
    """
    with _connected(address, None) as connection:
        found: Machine = connection.machine
        return found


def _load(source: Source, overrides: Sequence[str]) -> SweepSpec:
    if isinstance(source, SweepSpec):
        source = source.model_dump(mode="json")
    return load_spec(source, overrides)


def _new_store(spec: SweepSpec, source: Source, name: str | None, storage: str | Path | None) -> SweepStore:
    from tune_jobs.finish import storage_folder

    root = storage_folder(storage)
    chosen = name if name is not None else spec.name
    if chosen is not None:
        store = SweepStore(root / check_sweep_name(chosen))
        if store.folder.exists():
            raise SpecError(
                f"A sweep {chosen!r} is already in {root}.",
                f"Choose another name with --name, or go on with it: `tune-jobs resume {chosen}`.",
            )
        return store
    stem = Path(source).stem if isinstance(source, str | Path) else "sweep"
    # Only the folder's own creation decides who has a name; this finds one that is likely free.
    number = 1
    while (root / (candidate := stem if number == 1 else f"{stem}-{number}")).exists():
        number += 1
    return SweepStore(root / check_sweep_name(candidate))


def _write_new(store: SweepStore, spec: SweepSpec, plan: SweepPlan, address: str | None) -> None:
    for trial in plan.trials:
        store.trial(trial.trial_id).write_record(_pending(trial))
    # Last: a folder without it is no sweep, so nobody sees half of one.
    store.write_record(
        SweepRecord(
            name=store.name,
            state="running",
            spec=spec.model_copy(update={"name": store.name}).model_dump(mode="json"),
            evaluation_seeds=plan.evaluation_seeds,
            confirmation_seeds=plan.confirmation_seeds,
            num_trials=len(plan.trials),
            created_at=time.time(),
            versions=_versions(),
            git_commit=_git_commit(),
            address=address,
        )
    )


def _pending(trial: TrialPlan) -> TrialRecord:
    return TrialRecord(
        trial_id=trial.trial_id,
        index=trial.index,
        point_index=trial.point_index,
        seed_index=trial.seed_index,
        seed=trial.seed,
        point=trial.point,
        hyperparams=trial.hyperparams,
    )


def _check_same_trials(store: SweepStore, plan: SweepPlan) -> None:
    """Planning again must give the trials that are there: else a resumed trial would train with other values."""
    planned = {trial.trial_id: trial for trial in plan.trials}
    for record in store.read_trials():
        trial = planned.get(record.trial_id)
        if trial is None or trial.seed != record.seed or trial.hyperparams != record.hyperparams:
            raise CannotRunError(
                f"Trial {record.trial_id} of sweep {store.name} is not the one its spec gives: sweep.json was changed, "
                "or was written by a version that draws other points.",
                "Restore sweep.json, or launch a new sweep.",
            )


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _git_commit() -> str | None:
    """The commit of the working directory's repository, so that a sweep can be traced to a user's own code."""
    try:
        done = subprocess.run(  # noqa: S603 (fixed arguments)
            ["git", "rev-parse", "HEAD"],  # noqa: S607 (git as the user has it)
            capture_output=True, text=True, timeout=5, check=False,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None


def _connected(address: str | None, here: Machine | None) -> Any:
    from tune_jobs.cluster import connect

    return connect(address, here)


def _run(
    store: SweepStore,
    plan: SweepPlan,
    *,
    address: str | None,
    machine: Machine | None,
    finish: bool,
    progress: str,
) -> SweepResult:
    """Run the unfinished trials of a sweep whose lock is held, then what comes after."""
    started = time.time()
    store.clear_stop_request()
    record = store.read_record()
    store.write_record(
        record.model_copy(
            update={"state": "running", "started_at": record.started_at or started, "ended_at": None}
        )
    )
    todo = tuple(trial.trial_id for trial in store.read_trials() if trial.status not in FINISHED)
    spec = SweepSpec.model_validate(record.spec)
    monitor = SweepMonitor(
        store.name,
        store.read_trials(),
        max_env_steps_per_trial=spec.stop.num_env_steps,
        max_concurrent=plan.max_concurrent,
    )
    if todo:
        _run_trials(store, plan, todo, monitor, address=address, machine=machine, progress=progress)
    interrupted = _close(store, started)
    records = trials(store.folder)
    result = SweepResult(store.folder, store.read_record(), records, interrupted=interrupted)
    return result if interrupted or not finish else _finished(store, result)


def _run_trials(
    store: SweepStore,
    plan: SweepPlan,
    todo: tuple[str, ...],
    monitor: SweepMonitor,
    *,
    address: str | None,
    machine: Machine | None,
    progress: str,
) -> None:
    from tune_jobs.live import shown

    with shown(monitor, progress, store.folder / "driver.log"), _stopping_on_signals(store, monitor):
        from tune_jobs.runner import RunJob, run_trials

        job = RunJob(store.folder, todo, plan.cpus_per_trial, plan.gpus_per_trial, plan.max_concurrent)
        with contextlib.suppress(KeyboardInterrupt), _connected(address, machine) as connection:
            if connection.is_client:
                from tune_jobs.remote_driver import run_trials_remotely

                run_trials_remotely(job, monitor.update)
            else:
                run_trials(job, monitor.update)


def _close(store: SweepStore, started: float) -> bool:
    """Write down how the run ended; returns whether it was interrupted."""
    interrupted = False
    for trial in store.read_trials():
        if trial.status not in FINISHED:
            interrupted = True
            if trial.status == "running":
                store.trial(trial.trial_id).write_record(trial.model_copy(update={"status": "paused"}))
    record = store.read_record()
    now = time.time()
    store.write_record(
        record.model_copy(
            update={
                "state": "interrupted" if interrupted else "completed",
                "ended_at": now,
                "run_time_s": record.run_time_s + now - started,
            }
        )
    )
    store.clear_stop_request()
    return interrupted


def _finished(store: SweepStore, result: SweepResult) -> SweepResult:
    """Choose, confirm and film the winner, and write the report; what can't be made is noted, not raised."""
    from tune_jobs import finish

    chosen: BestRecord | None = None
    why: str | None = None
    notes: list[str] = []
    artifacts: dict[str, Path] = {}
    try:
        chosen = finish.choose_best(store)
        artifacts["policy"] = store.best_folder / "policy.json"
    except TuneJobsError as error:
        why = str(error)

    def attempt(what: str, make: Callable[[], dict[str, Path]]) -> None:
        try:
            artifacts.update(make())
        except TuneJobsError as error:
            notes.append(f"No {what}: {error}")

    if chosen is not None:
        attempt("video", lambda: finish.make_videos(store))
    attempt("report", lambda: {"report": finish.make_report(store)})
    return SweepResult(
        result.folder, result.sweep, result.trials, chosen, why, artifacts, result.interrupted, tuple(notes)
    )


@contextlib.contextmanager
def _stopping_on_signals(store: SweepStore, monitor: SweepMonitor) -> Iterator[None]:
    """Let the first Ctrl-C (or SIGTERM) ask the trials to save and stop, and the second end them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ask(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 (the signature of a handler)
        if monitor.stopping:
            raise KeyboardInterrupt
        monitor.stopping = True
        store.request_stop()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
