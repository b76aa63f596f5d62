"""The Ray Tune Trainable: one warm process that runs one trial after another.

Tune gives it a sweep folder and a trial id and nothing else; what to run is read from the sweep folder, so a trial
that is started again anywhere goes on from what is on disk there.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import socket
import sys
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import ray
from ray import tune

from policies.acting.evaluate import Evaluator
from policies.envs.faults import note_signals
from policies.envs.modules import allow_modules
from policies.envs.tallies import end_tally
from policies.errors import CheckpointError, fit, tellable
from policies.files import open_to_append
from policies.parents import end_with_parent, is_gone
from tune_jobs.ray_tune.early_stopping import METRIC, grace_env_steps
from tune_jobs.ray_tune.scheduling import score_of
from tune_jobs.spec.engines import engine_on_record
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.contract import Ownership
from tune_jobs.store.local_storage import open_sweep
from tune_jobs.store.logs import begin_log
from tune_jobs.store.progress import Progress
from tune_jobs.training.protocol import TrainingEngine, TrialTask
from tune_jobs.training.registry import make_engine
from tune_jobs.training.trial_loop import TrialLoop

# Reporting every iteration of a fast env costs more than the iteration.
REPORT_INTERVAL_S = 1.0
_POINTER = "pointer.json"
_LONGEST_WATCH_S = 1e9
"""Thirty years; the fault handler's clock overflows at 300."""


class TrialLog:
    """Sends everything this process prints, C++ included, to a trial's log, appended."""

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
        """Send them where they went before."""
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        if self._file is not None:
            for number, original in enumerate(self._original, start=1):
                os.dup2(original, number)
            self._file.close()
            self._file = None


class TaskReader:
    """Reads from a sweep folder what to run; the sweep's own record once.

    Args:
        sweep_folder: The sweep's folder.

    Raises:
        NotFoundError: There is no sweep there.
    """

    def __init__(self, sweep_folder: Path) -> None:
        self.store = open_sweep(sweep_folder)
        self.sweep = self.store.read_record()
        self.spec = stored_spec(self.sweep)

    def read(self, trial_id: str) -> TrialTask:
        """What to run as a trial.

        Raises:
            NotFoundError: There is no such trial.
            CheckpointError: Its record is damaged, or names an engine that there is none of.
        """
        spec, trial = self.spec, self.store.trial(trial_id).read_record()
        return TrialTask(
            sweep_folder=self.store.folder,
            trial_id=trial_id,
            seed=trial.seed,
            algorithm=spec.algorithm,
            hyperparams=trial.hyperparams,
            env_id=spec.env.id,
            env_args=spec.env.wrapped_args,
            stop=spec.stop,
            evaluation=spec.evaluation,
            checkpoints=spec.checkpoints,
            evaluation_seeds=self.sweep.evaluation_seeds,
            num_env_runners=spec.resources.num_env_runners,
            num_gpus=spec.resources.num_gpus,
            iteration_timeout_s=spec.iteration_timeout_s,
            failure_penalty=spec.env.failure_penalty,
            rl_module=spec.rl_module,
            changes=trial.changes,
            engine=engine_on_record(trial.engine, spec.algorithm).name,
        )


@contextlib.contextmanager
def watchdog(timeout_s: float, file: IO[bytes]) -> Iterator[None]:
    """End this process, with a traceback in the log, if the block hangs: not even a thread could interrupt it.

    A hung `env.step` has no time-out of its own with RLlib; Tune then starts a new process.
    """
    faulthandler.dump_traceback_later(min(timeout_s, _LONGEST_WATCH_S), exit=True, file=file)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def this_node() -> str:
    """The node this process runs on, as records name it."""
    return f"{ray.util.get_node_ip_address()}/{ray.get_runtime_context().get_node_id()[:8]}"


def compared_by(progress: Progress, grace: int) -> dict[str, Any]:
    """What Tune's schedulers compare a trial by.

    Args:
        progress: Where it stands.
        grace: Env steps of a grace period.
    """
    return {
        "evaluated": progress.evaluated,
        "num_env_steps": progress.num_env_steps,
        "grace_periods": progress.num_env_steps / grace,
        METRIC: score_of(progress),
    }


def owner_of_run(config: Mapping[str, Any]) -> Ownership | None:
    """The run that a process was started for; None: it was started for none."""
    return open_sweep(Path(config["sweep_folder"])).owner(config["run"]) if config.get("run") else None


def end_with_driver(config: Mapping[str, Any], *owners: Ownership | None) -> None:
    """End this process when its driver has gone, however it went, or another process owns what it works for.

    A driver that is killed takes its Ray along, whose processes this one is a child of. In a Ray that stays there, it
    is seen itself; on another machine Ray ends this process.

    Args:
        config: What the process was started with: `driver` is `this_process` of the driver.
        owners: Of what it works for.
    """
    driver = str(config.get("driver", ""))
    lost = [lambda owner=owner: not owner.is_current() for owner in owners if owner is not None]
    end_with_parent([lambda: is_gone(driver), *lost])


class TrialTrainable(tune.Trainable):  # type: ignore[misc]
    """Runs trials; `config` holds `sweep_folder`, `trial_id`, and of the driver `run` and `driver`."""

    def setup(self, config: dict[str, Any]) -> None:
        """Remember the trial; it is built in the first step, so that every error comes from there."""
        note_signals()
        self._log = TrialLog()
        self._engine: TrainingEngine | None = None
        self._engine_name = ""
        self._loop: TrialLoop | None = None
        self._evaluators: dict[str, Evaluator] = {}
        self._node = this_node()
        self._run = owner_of_run(config)
        end_with_driver(config, self._run)
        self._take(config)

    def reset_config(self, new_config: Mapping[str, Any]) -> bool:
        """Take the next trial in the same warm process."""
        self._take(new_config)
        return True

    def _take(self, config: Mapping[str, Any]) -> None:
        if self._loop is not None:
            end_tally(self._loop.task.trial_id)
        self._trial = (Path(config["sweep_folder"]), str(config["trial_id"]))
        self._loop = None
        self._grace = 1

    def step(self) -> dict[str, Any]:
        """Train until the next report.

        Raises:
            Exception: Whatever went wrong; it is in the trial's log too.
        """
        folder, trial_id = self._trial
        try:
            if self._loop is None:
                self._loop = self._open(folder, trial_id)
            progress = self._watched(self._loop)
        except Exception as error:
            # Not by print_exc: standard error of Ray's processes fails at what is no text.
            print(fit(traceback.format_exc()), file=sys.stderr, flush=True)
            if self._loop is not None:
                # Files that are gone under its hands are no failure of a trial that another process has.
                self._loop.check_owned()
            if (told := tellable(error)) is not error:
                raise told from None
            raise
        if progress.status != "running":
            self._log.close()
        return self._report(progress)

    def _open(self, folder: Path, trial_id: str) -> TrialLoop:
        reader = TaskReader(folder)
        self._file = self._log.open(reader.store.trial(trial_id).log_path)
        begin_log(f"trial {trial_id}")
        task = reader.read(trial_id)
        allow_modules(reader.sweep.allowed_modules)
        key = json.dumps([task.env_id, task.env_args, task.evaluation_seeds], sort_keys=True)
        if key not in self._evaluators:
            with watchdog(task.iteration_timeout_s, self._file):
                self._evaluators[key] = Evaluator(task.env_id, task.env_args, task.evaluation_seeds)
        self._grace = grace_env_steps(reader.spec.scheduler, reader.spec.stop.num_env_steps)
        loop = TrialLoop(task, self._engine_of(task), self._evaluators[key], under=self._run)
        with watchdog(task.iteration_timeout_s, self._file):
            loop.open()
        return loop

    def _engine_of(self, task: TrialTask) -> TrainingEngine:
        """The engine of a trial, warm if the trial before it had the same."""
        if self._engine is None or self._engine_name != task.engine:
            if self._engine is not None:
                self._engine.close()
            self._engine, self._engine_name = make_engine(task.engine), task.engine
        return self._engine

    def _watched(self, loop: TrialLoop) -> Progress:
        with watchdog(loop.task.iteration_timeout_s + REPORT_INTERVAL_S, self._file):
            return loop.advance(REPORT_INTERVAL_S)

    def _report(self, progress: Progress) -> dict[str, Any]:
        return {
            "done": progress.status != "running",
            **compared_by(progress, self._grace),
            # Tune looks into results, and takes them apart.
            "progress": progress.model_dump(),
            "node": self._node,
            "host": socket.gethostname(),
        }

    def save_checkpoint(self, checkpoint_dir: str) -> None:
        """For Tune's pauses: the checkpoint itself goes to the sweep folder, Tune gets a pointer to it."""
        folder, trial_id = self._trial
        if self._loop is not None:
            self._loop.pause()
        pointer = {"sweep_folder": str(folder), "trial_id": trial_id, "iteration": _latest_iteration(folder, trial_id)}
        (Path(checkpoint_dir) / _POINTER).write_text(json.dumps(pointer), encoding="utf-8")

    def load_checkpoint(self, checkpoint: str) -> None:
        """Check that the sweep folder holds what Tune paused, or newer; the next step goes on from it.

        A pointer to another trial's checkpoint comes from population based training; what it points to has been
        copied into this trial's folder.

        Raises:
            CheckpointError: The checkpoint Tune wants is not there.
        """
        pointer = json.loads((Path(checkpoint) / _POINTER).read_text(encoding="utf-8"))
        folder, trial_id = self._trial
        latest = _latest_iteration(folder, trial_id)
        # Newer where the trial went on after a pause and its process died: Tune goes back to the pause's pointer.
        # Older where the one it points to was damaged, and the trial has gone on from the one before.
        known = max(latest, open_sweep(folder).trial(trial_id).latest_damaged())
        if pointer["trial_id"] == trial_id and known < pointer["iteration"]:
            raise CheckpointError(
                f"Trial {trial_id} was paused at iteration {pointer['iteration']}, its latest checkpoint is {latest}.",
                "Resume the sweep: its trials go on from their latest checkpoints.",
            )
        self._loop = None

    def cleanup(self) -> None:
        """Free the trial; the process may end."""
        if self._engine is not None:
            self._engine.close()
        for evaluator in self._evaluators.values():
            evaluator.close()
        self._log.close()


def _latest_iteration(folder: Path, trial_id: str) -> int:
    """Of a trial's checkpoints on disk, damaged or not; 0: it has none."""
    return max(open_sweep(folder).trial(trial_id).checkpoint_iterations(), default=0)
