"""What an engine is: the one thing that knows how a trial's iterations are computed.

Everything else about a trial (stop rules, evaluation, checkpoints, results, logs) is `tune_jobs.training.trial_loop`'s
and the same for all engines. There are two kinds: those that train one trial at a time, and those that train a pack
of them together (`tune_jobs.training.pack_loop`). This module imports no ray, so that both sides can import it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from analysis.records import ChangeRecord
from policies.portable.file import PortablePolicy
from tune_jobs.spec.sections import CheckpointSpec, EvaluationSpec, StopSpec


@dataclass(frozen=True)
class TrialTask:
    """Everything a process needs to run one trial, or to go on with it."""

    sweep_folder: Path
    trial_id: str
    seed: int
    algorithm: str
    hyperparams: dict[str, Any]
    env_id: str
    env_args: dict[str, Any]
    """With `frame_stack` and `pixels`, if the spec sets them: evaluation and videos need them too."""
    stop: StopSpec
    evaluation: EvaluationSpec
    checkpoints: CheckpointSpec
    evaluation_seeds: tuple[int, ...]
    num_env_runners: int = 0
    num_gpus: float = 0.0
    iteration_timeout_s: float = 600.0
    failure_penalty: float | None = None
    """For training only; see `EnvSpec`."""
    rl_module: str | None = None
    """`module:Class` of a user's own RLModule."""
    changes: tuple[ChangeRecord, ...] = ()
    """What population based training changed, oldest first."""
    num_env_steps: int = 0
    """Env steps the trial has done when it is built; the checkpoint it is built from may count another trial's."""
    num_iterations: int = 0
    """The same for iterations."""
    engine: str = ""
    """Name of the engine that trains it, which its checkpoints' manifests name; empty: they name none."""


@dataclass(frozen=True)
class IterationStats:
    """What one iteration gave."""

    num_env_steps: int
    """Env steps of the trial so far."""
    episodes: tuple[tuple[float, int], ...] = ()
    """(undiscounted return, env steps) of each whole episode that ended in it."""
    learner: dict[str, float] = field(default_factory=dict)
    """Losses, entropy, learning rate and the like, of the last update."""


class TrainingEngine(Protocol):
    """Trains one trial at a time; reused for the next by another `build`."""

    def build(self, task: TrialTask, checkpoint: Path | None) -> None:
        """Make the networks and environments of a trial, fresh or exactly as a checkpoint folder holds them.

        The checkpoint may be of another trial or other hyperparameters (population based training): then the task's
        hyperparameters act, on the weights, optimizer state and target networks of the checkpoint.

        Raises:
            CheckpointError: The checkpoint cannot be restored. Never starts afresh instead.
        """
        ...

    def train_iteration(self) -> IterationStats:
        """Train for one iteration."""
        ...

    def policy(self) -> PortablePolicy:
        """The current greedy policy."""
        ...

    def save(self, folder: Path) -> None:
        """Write what `build` needs into an empty folder."""
        ...

    def close(self) -> None:
        """Free everything; `build` may follow."""
        ...


class PackEngine(Protocol):
    """Trains many trials together, the members of a pack; they come and go."""

    def add(self, task: TrialTask, checkpoint: Path | None) -> None:
        """Take in a trial, fresh or exactly as a checkpoint folder holds it; the other members do not notice.

        Raises:
            CheckpointError: The checkpoint cannot be restored. Never starts afresh instead.
            Exception: The trial cannot be built; it is no member then.
        """
        ...

    def train_iteration(self) -> dict[str, IterationStats | Exception]:
        """Train every member for one iteration.

        Returns:
            By trial id, of every member: what the iteration gave, or why the member failed. One that failed stays until
            it is removed; the others have been trained.
        """
        ...

    def policy(self, trial_id: str) -> PortablePolicy:
        """The current greedy policy of a member."""
        ...

    def save(self, trial_id: str, folder: Path) -> None:
        """Write what `add` needs into an empty folder."""
        ...

    def remove(self, trial_id: str) -> None:
        """Forget a member; the others do not notice."""
        ...

    def close(self) -> None:
        """Free everything."""
        ...
