"""The Ray Tune Trainable of single trials: one warm process that runs one trial after another.

Tune gives it only a sweep's place and a trial id; everything else is read from the sweep, so a trial that is
started again on any node continues from what is on disk.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import socket
import sys
import tempfile
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import ray
from ray import tune
from ray.train._internal.checkpoint_manager import _TrainingResult

from policies.acting.evaluate import Evaluator
from policies.envs.faults import note_signals
from policies.envs.modules import allow_modules, look_in
from policies.envs.tallies import end_tally
from policies.errors import CheckpointError, fit, tellable
from policies.files import open_to_append
from policies.parents import end_with_parent, is_gone
from tune_jobs.ray_tune.joined_nodes import refusal
from tune_jobs.ray_tune.lean import Sealed
from tune_jobs.ray_tune.lost_nodes import DrainNotice, NodeRefusedError
from tune_jobs.ray_tune.pointers import POINTER, latest_iteration, pointer_to, result_of
from tune_jobs.ray_tune.scheduling import score_of
from tune_jobs.ray_tune.tune_scheduler import METRIC
from tune_jobs.spec.engines import engine_on_record
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.training_length import as_trained
from tune_jobs.store.contract import Ownership
from tune_jobs.store.logs import begin_log
from tune_jobs.store.opening import open_sweep
from tune_jobs.store.progress import Progress
from tune_jobs.training.protocol import TrainingEngine, TrialTask
from tune_jobs.training.registry import make_engine
from tune_jobs.training.scoring import judging_of
from tune_jobs.training.trial_loop import TrialLoop

# Reporting every iteration of a fast env would take longer than the iteration.
REPORT_INTERVAL_S = 1.0
_LONGEST_WATCH_S = 1e9
"""Thirty years, in seconds; the fault handler's clock overflows at 300 years."""


class TrialLog:
    """Appends everything this process prints, including C++ code, to a trial's log."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._original = [os.dup(1), os.dup(2)]

    def open(self, path: Path) -> IO[bytes]:
        """Send standard output and error to this file from now on."""
        self.close()
        self._file = open_to_append(path)
        for number in (1, 2):
            os.dup2(self._file.fileno(), number)
        return self._file

    def close(self) -> None:
        """Send standard output and error where they went before."""
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        if self._file is not None:
            for number, original in enumerate(self._original, start=1):
                os.dup2(original, number)
            self._file.close()
            self._file = None


class TaskReader:
    """Reads trials to run from a sweep folder; it reads the sweep's own record only once.

    Args:
        sweep_place: The sweep's place.

    Raises:
        NotFoundError: There is no sweep there.
    """

    def __init__(self, sweep_place: str) -> None:
        self.store = open_sweep(sweep_place)
        self.sweep = self.store.read_record()
        self.spec = stored_spec(self.sweep)

    def read(self, trial_id: str) -> TrialTask:
        """Return what to run for a trial.

        Raises:
            NotFoundError: There is no such trial.
            CheckpointError: Its record is damaged, or names an unknown engine.
        """
        spec, trial = self.spec, self.store.trial(trial_id).read_record()
        return TrialTask(
            sweep_place=self.store.place,
            trial_id=trial_id,
            seed=trial.seed,
            algorithm=spec.algorithm,
            hyperparams=trial.hyperparams,
            env_id=spec.env.id,
            env_args=spec.env.wrapped_args,
            stop=as_trained(spec, trial.point).stop,
            evaluation=spec.evaluation,
            checkpoints=spec.checkpoints,
            evaluation_seeds=self.sweep.evaluation_seeds,
            num_env_runners=spec.resources.num_env_runners,
            num_gpus=spec.resources.num_gpus,
            iteration_timeout_s=spec.iteration_timeout_s,
            failure_penalty=spec.env.failure_penalty,
            atari_training=None if spec.env.atari is None else spec.env.atari.training,
            rl_module=spec.rl_module,
            changes=trial.changes,
            in_step=spec.scheduler.waits_for_others and trial.seed_index < spec.seeds_per_point,
            judging=judging_of(spec, self.sweep, trial.point, trial.hyperparams),
            engine=engine_on_record(trial.engine, spec.algorithm).name,
        )


@contextlib.contextmanager
def watchdog(timeout_s: float, file: IO[bytes]) -> Iterator[None]:
    """End this process, with a traceback in the log, if the block hangs, because not even a thread could interrupt it.

    RLlib has no time-out for an `env.step` that hangs. Tune then starts a new process.
    """
    faulthandler.dump_traceback_later(min(timeout_s, _LONGEST_WATCH_S), exit=True, file=file)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def this_node() -> str:
    """Return the node that this process runs on, as records name it."""
    return f"{ray.util.get_node_ip_address()}/{ray.get_runtime_context().get_node_id()[:8]}"


def compared_by(progress: Progress) -> dict[str, Any]:
    """Return the numbers by which schedulers compare a trial."""
    return {"evaluated": progress.evaluated, "num_env_steps": progress.num_env_steps, METRIC: score_of(progress)}


def owner_of_run(config: Mapping[str, Any]) -> Ownership | None:
    """Return the ownership of the run that a process was started for; None if it was started for none."""
    return open_sweep(config["sweep_place"]).owner(config["run"]) if config.get("run") else None


def look_in_folders(config: Mapping[str, Any]) -> None:
    """Let this process find the user's own modules where the driver did; Ray itself passes on no path of Python's."""
    look_in(json.loads(config.get("folders", "[]")))


def end_with_driver(config: Mapping[str, Any], *owners: Ownership | None) -> None:
    """End this process when its driver has ended, for whatever reason, or another process owns its work.

    The Ray of a driver that is killed ends with it, and this process is a child of Ray's processes. If Ray stays, this
    process watches the driver itself; on another machine Ray ends this process.

    Args:
        config: The settings that the process was started with; `driver` is the driver's `this_process`.
        owners: The ownerships of its work.
    """
    driver = str(config.get("driver", ""))
    lost = [lambda owner=owner: not owner.is_current() for owner in owners if owner is not None]
    end_with_parent([lambda: is_gone(driver), *lost])


class TrialTrainable(tune.Trainable):  # type: ignore[misc]
    """Runs trials; `config` holds `sweep_place` and `trial_id`, and from the driver `run` and `driver`.

    On a cluster it holds `versions` too, see `joined_nodes.refusal`; in a user's Ray it may hold `folders`.
    """

    _refusal: NodeRefusedError | None = None

    def setup(self, config: dict[str, Any]) -> None:
        """Remember the trial; it is built in the first step, so that every error is raised there."""
        note_signals()
        self._log = TrialLog()
        self._engine: TrainingEngine | None = None
        self._engine_name = ""
        self._loop: TrialLoop | None = None
        self._evaluators: dict[str, Evaluator] = {}
        self._node = this_node()
        self._notice = DrainNotice()
        self._take(config)
        look_in_folders(config)
        self._refusal = refusal(config)
        if self._refusal is None:
            self._run = owner_of_run(config)
            end_with_driver(config, self._run)

    def reset_config(self, new_config: Mapping[str, Any]) -> bool:
        """Take the next trial in the same warm process."""
        self._take(new_config)
        return True

    def _take(self, config: Mapping[str, Any]) -> None:
        if self._loop is not None:
            end_tally(self._loop.task.trial_id)
        self._trial = (str(config["sweep_place"]), str(config["trial_id"]))
        self._loop = None

    def step(self) -> dict[str, Any]:
        """Train until the next report.

        Raises:
            Exception: Any error of the trial; it is in the trial's log too.
            NodeLeavesError: The node is taken away; the trial is saved.
            NodeRefusedError: The node joined later, and can't take part; nothing was begun.
        """
        if self._refusal is not None:
            raise self._refusal
        place, trial_id = self._trial
        try:
            if self._loop is None:
                self._loop = self._open(place, trial_id)
            progress = self._watched(self._loop)
            if progress.status == "running" and self._notice.came:
                self._leave(self._loop)
        except Exception as error:
            # print_exc would fail where standard error of Ray's processes cannot encode the text.
            print(fit(traceback.format_exc()), file=sys.stderr, flush=True)
            if self._loop is not None:
                # If another process has taken the trial over, missing files are no failure of it.
                self._loop.check_owned()
            if (told := tellable(error)) is not error:
                raise told from None
            raise
        if progress.status != "running":
            self._log.close()
        return self._report(progress)

    def _open(self, place: str, trial_id: str) -> TrialLoop:
        reader = TaskReader(place)
        self._file = self._log.open(reader.store.trial(trial_id).log_path)
        begin_log(f"trial {trial_id}")
        task = reader.read(trial_id)
        allow_modules(reader.sweep.allowed_modules)
        key = json.dumps([task.env_id, task.env_args, task.evaluation_seeds], sort_keys=True)
        if key not in self._evaluators:
            with watchdog(task.iteration_timeout_s, self._file):
                self._evaluators[key] = Evaluator(task.env_id, task.env_args, task.evaluation_seeds)
        loop = TrialLoop(task, self._engine_of(task), self._evaluators[key], under=self._run)
        with watchdog(task.iteration_timeout_s, self._file):
            loop.open()
        return loop

    def _engine_of(self, task: TrialTask) -> TrainingEngine:
        """Return the engine of a trial; it is warm if the previous trial had the same engine."""
        if self._engine is None or self._engine_name != task.engine:
            if self._engine is not None:
                self._engine.close()
            self._engine, self._engine_name = make_engine(task.engine), task.engine
        return self._engine

    def _watched(self, loop: TrialLoop) -> Progress:
        with watchdog(loop.task.iteration_timeout_s + REPORT_INTERVAL_S, self._file):
            return loop.advance(REPORT_INTERVAL_S)

    def _leave(self, loop: TrialLoop) -> None:
        """Save the trial and end it here, as the node is taken away."""
        with watchdog(loop.task.iteration_timeout_s, self._file):
            loop.pause()
        raise self._notice.error()

    def _report(self, progress: Progress) -> dict[str, Any]:
        return {
            "done": progress.status != "running",
            **compared_by(progress),
            "progress": Sealed(progress),
            "node": self._node,
            "host": socket.gethostname(),
        }

    def save(self, checkpoint_dir: str | None = None) -> _TrainingResult:
        """Save when Tune pauses the trial, and return its pointer to the checkpoint."""
        with tempfile.TemporaryDirectory() as folder:
            self.save_checkpoint(folder)
            pointer = (Path(folder) / POINTER).read_text(encoding="utf-8")
        return result_of(pointer, self._last_result, checkpoint_dir)

    def restore(self, checkpoint_path: _TrainingResult) -> None:
        """Be given what `save` returned, of this trial or of another one.

        Raises:
            CheckpointError: The checkpoint of the pause is not there.
        """
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / POINTER).write_text(checkpoint_path.metrics[POINTER], encoding="utf-8")
            super().restore(_TrainingResult(tune.Checkpoint.from_directory(folder), checkpoint_path.metrics))

    def save_checkpoint(self, checkpoint_dir: str) -> None:
        """Save when Tune pauses the trial: the checkpoint goes to the sweep folder, and Tune gets a pointer to it."""
        place, trial_id = self._trial
        if self._loop is not None:
            self._loop.pause()
        pointer = pointer_to(place, open_sweep(place).trial(trial_id))
        (Path(checkpoint_dir) / POINTER).write_text(pointer, encoding="utf-8")

    def load_checkpoint(self, checkpoint: str) -> None:
        """Check that the sweep folder has the checkpoint of Tune's pause or a newer one, for the next step.

        A pointer to another trial's checkpoint comes from population based training; that checkpoint has been copied
        into this trial's folder.

        Raises:
            CheckpointError: The checkpoint of the pause is not there.
        """
        if self._refusal is not None:
            # The next step says so.
            return
        pointer = json.loads((Path(checkpoint) / POINTER).read_text(encoding="utf-8"))
        place, trial_id = self._trial
        trial = open_sweep(place).trial(trial_id)
        latest = latest_iteration(trial)
        # It is newer if the trial continued after a pause and its process died: Tune uses the pause's pointer again.
        # It is older if that checkpoint was damaged, and the trial has continued from the one before.
        known = max(latest, trial.latest_damaged())
        if pointer["trial_id"] == trial_id and known < pointer["iteration"]:
            raise CheckpointError(
                f"Trial {trial_id} was paused at iteration {pointer['iteration']}; its latest checkpoint is {latest}.",
                "Resume the sweep: its trials continue from their latest checkpoints.",
            )
        self._loop = None

    def cleanup(self) -> None:
        """Free the trial, as the process may end."""
        if self._engine is not None:
            self._engine.close()
        for evaluator in self._evaluators.values():
            evaluator.close()
        self._log.close()
