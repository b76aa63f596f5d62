"""The protocol of engines, which compute the iterations of trials.

Everything else about a trial (stop rules, evaluation, checkpoints, results, logs) is the same for all engines, and in
`tune_jobs.training.trial_steps`. There are two kinds: those that train one trial at a time, and those that train a pack
of them together (`tune_jobs.training.pack_loop`). This module imports no ray, so that both sides can import it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from analysis.records import ChangeRecord
from policies.portable.file import PortablePolicy
from tune_jobs.spec.sections import CheckpointSpec, EvaluationSpec, StopSpec
from tune_jobs.training.scoring import Judging


@dataclass(frozen=True)
class TrialTask:
    """Everything a process needs to begin or continue one trial."""

    sweep_place: str
    """The sweep's place, for `open_sweep`."""
    trial_id: str
    seed: int
    algorithm: str
    hyperparams: dict[str, Any]
    env_id: str
    env_args: dict[str, Any]
    """The env's arguments, with `frame_stack`, `pixels` and `atari` if the spec sets them."""
    stop: StopSpec
    evaluation: EvaluationSpec
    checkpoints: CheckpointSpec
    evaluation_seeds: tuple[int, ...]
    num_env_runners: int = 0
    num_gpus: float = 0.0
    iteration_timeout_s: float = 600.0
    failure_penalty: float | None = None
    """The failure penalty, for training only; see `EnvSpec`."""
    atari_training: dict[str, bool] | None = None
    """What training alone sees of an Atari game; see `AtariSpec`."""
    rl_module: str | None = None
    """`module:Class` of a user's own RLModule; None: ours."""
    changes: tuple[ChangeRecord, ...] = ()
    """The changes of population based training, oldest first."""
    num_env_steps: int = 0
    """Env steps of the trial when it is built; its checkpoint may be a copy with the count of another trial."""
    num_iterations: int = 0
    """Iterations of the trial when it is built."""
    in_step: bool = False
    """Whether it waits for other trials at numbers of env steps; in a pack it then shares a stack with such members
    alone as are always as far as it is."""
    judging: Judging | None = None
    """How its score is told to a search method; None: to none."""
    engine: str = ""
    """The engine's name for the manifests of checkpoints; empty: they name none."""

    @property
    def learning_settings(self) -> str:
        """The hyperparameters that bound the steps of weights, for a message."""
        known = [name for name in ("lr", "lr_final", "grad_clip") if name in self.hyperparams]
        return "".join(f", {name} {self.hyperparams[name]}" for name in known)


@dataclass(frozen=True)
class IterationStats:
    """The results of one iteration."""

    num_env_steps: int
    """Env steps of the trial so far."""
    episodes: tuple[tuple[float, int], ...] = ()
    """The undiscounted return and the env steps of each whole episode that ended."""
    learner: dict[str, float] = field(default_factory=dict)
    """Metrics of the last update, such as losses, entropy and learning rate."""


class TrialEngine(Protocol):
    """Holds one trial; another `build` reuses it for the next one. What trains the trial may be a pack."""

    def build(self, task: TrialTask, checkpoint: Path | None) -> None:
        """Make the networks and environments of a trial, fresh or exactly as a checkpoint folder holds them.

        The checkpoint may come from another trial or have other hyperparameters (population based training): then the
        task's hyperparameters are used with the weights, optimizer state and target networks of the checkpoint.

        Raises:
            CheckpointError: The checkpoint cannot be restored. The trial never starts afresh instead.
        """
        ...

    def policy(self) -> PortablePolicy:
        """Return the current greedy policy."""
        ...

    def save(self, folder: Path) -> None:
        """Write the state that `build` restores into an empty folder."""
        ...

    def close(self) -> None:
        """Free everything; `build` may be called again."""
        ...


class TrainingEngine(TrialEngine, Protocol):
    """Trains one trial at a time."""

    def train_iteration(self) -> IterationStats:
        """Train for one iteration."""
        ...


class PackEngine(Protocol):
    """Trains many trials together, the members of a pack, which can be added and removed."""

    @property
    def moved(self) -> Collection[str]:
        """The held members that can't go on as they were after the last iteration, but in new episodes."""
        ...

    def add(self, task: TrialTask, checkpoint: Path | None) -> None:
        """Add a trial, fresh or exactly as a checkpoint folder holds it, without any effect on other members.

        Raises:
            CheckpointError: The checkpoint cannot be restored. The trial never starts afresh instead.
            Exception: The trial cannot be built; then it is not added.
        """
        ...

    def train_iteration(self, held: Collection[str] = ()) -> dict[str, IterationStats | Exception]:
        """Train the members for one iteration.

        Args:
            held: Members that wait for other trials and are not trained.

        Returns:
            For every other member, by trial id, the results of the iteration or the error of the member. A member that
            failed stays until it is removed; the others have been trained.
        """
        ...

    def policy(self, trial_id: str) -> PortablePolicy:
        """Return the current greedy policy of a member."""
        ...

    def save(self, trial_id: str, folder: Path) -> None:
        """Write the state that `add` restores into an empty folder."""
        ...

    def remove(self, trial_id: str) -> None:
        """Forget a member, without any effect on the others."""
        ...

    def close(self) -> None:
        """Free everything."""
        ...
