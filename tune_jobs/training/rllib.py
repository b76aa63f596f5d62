"""The `rllib` engine: it makes one RLlib Algorithm for each trial, one after another in the same warm process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import ray
import torch
from ray.rllib.algorithms.algorithm import Algorithm as RLlibAlgorithm
from ray.rllib.core import DEFAULT_MODULE_ID

from policies import random_streams
from policies.errors import CannotRunError
from policies.hyperparams import Algorithm, DQNHyperparams, PPOHyperparams, TrainedHyperparams, make_hyperparams
from policies.portable.file import PortablePolicy, read_policy
from policies.rllib.config import build_algorithm_config
from policies.rllib.dqn_algorithm import ReplayDQN
from policies.rllib.env_runner import ArrayEnvRunner
from policies.rllib.restore import portable_policy, restore_algorithm, take_over_state
from policies.rllib.runner_errors import as_raised_there
from tune_jobs.plan.estimates import most_env_steps_until
from tune_jobs.plan.machine import usable_cpus
from tune_jobs.training.devices import device_for
from tune_jobs.training.env_runner import EnvRunner
from tune_jobs.training.protocol import IterationStats, TrialTask

RLLIB_FOLDER = "rllib"
_LIFETIME_STEPS = ("env_runners", "num_env_steps_sampled_lifetime")
# RLlib's names of metrics and ours; RLlib's other metrics are timers and counters.
_LEARNER_STATS = {
    "total_loss": "total_loss",
    "policy_loss": "policy_loss",
    "vf_loss": "vf_loss",
    "entropy": "entropy",
    "mean_kl_loss": "kl",
    "qf_mean": "q_mean",
    "gradient_norm": "gradient_norm",
    "lr": "lr",
    "gradients_default_optimizer_global_norm": "gradient_norm",
    "default_optimizer_learning_rate": "lr",
}


def algorithm_from_checkpoint(checkpoint: Path) -> RLlibAlgorithm:
    """Restore a checkpoint of this engine as an RLlib Algorithm that can continue training.

    With more env runners than there are CPUs for, beside one for this process, it samples in this process.
    """
    max_env_runners = max(0, int(_num_cpus()) - 1)
    return restore_algorithm(
        checkpoint / RLLIB_FOLDER, read_policy(checkpoint).network, max_env_runners=max_env_runners
    )


def _num_cpus() -> float:
    """Return the CPUs of the Ray that this process has joined, or of this machine if it has joined none."""
    return float(ray.cluster_resources().get("CPU", 0.0)) if ray.is_initialized() else usable_cpus()


class RLlibEngine:
    """The engine that trains trials with RLlib; implements `TrainingEngine`."""

    def __init__(self) -> None:
        self._algorithm: RLlibAlgorithm | None = None
        self._task: TrialTask | None = None
        self._hyperparams: TrainedHyperparams | None = None
        # Env steps and iterations of the trial that the Algorithm does not count; negative if it counts another's.
        self._before = (0, 0)

    @property
    def algorithm(self) -> RLlibAlgorithm:
        """The Algorithm of the current trial.

        Raises:
            RuntimeError: Nothing has been built.
        """
        if self._algorithm is None:
            raise RuntimeError("build() has not been called")
        return self._algorithm

    @as_raised_there()
    def build(self, task: TrialTask, checkpoint: Path | None) -> None:
        """Make the Algorithm of a trial, fresh or exactly as a checkpoint folder holds it."""
        self.close()
        # Small networks are up to several times slower on more than one thread, and trials share the cores.
        torch.set_num_threads(1)
        # The values were validated with the sweep file; this turns JSON back into the typed object.
        # A baseline has an engine of its own.
        hyperparams = cast("TrainedHyperparams", make_hyperparams(cast("Algorithm", task.algorithm), task.hyperparams))
        # RLlib would say so in its own words, after seconds, or not at all; and a restore would go on on the CPU.
        device_for(task.num_gpus)
        self._task, self._hyperparams = task, hyperparams
        self._before = (0, 0)
        saved = None if checkpoint is None else read_policy(checkpoint)
        if checkpoint is not None and saved is not None and _is_of(task, saved):
            self._algorithm = restore_algorithm(checkpoint / RLLIB_FOLDER, saved.network)
        else:
            self._algorithm = self._new_algorithm(task, hyperparams)
            if checkpoint is not None and saved is not None:
                take_over_state(self._algorithm, checkpoint / RLLIB_FOLDER, saved.network)
        if task.changes:
            self._before = (task.num_env_steps - self._num_env_steps(), task.num_iterations - self._algorithm.iteration)
        if checkpoint is not None:
            self._continue_streams(checkpoint)
        if isinstance(hyperparams, DQNHyperparams):
            self._algorithm.replay.expect(most_env_steps_until(task.stop, hyperparams, task.num_env_runners))

    def _new_algorithm(self, task: TrialTask, hyperparams: TrainedHyperparams) -> RLlibAlgorithm:
        config = build_algorithm_config(
            hyperparams,
            env_id=task.env_id,
            env_args=task.env_args,
            seed=task.seed,
            num_env_runners=task.num_env_runners,
            num_gpus=task.num_gpus,
            failure_penalty=task.failure_penalty,
            atari_training=task.atari_training,
            rl_module=task.rl_module,
        )
        config.env_runners(env_runner_cls=EnvRunner)
        # The learner's weights are drawn from these generators, which a warm process has used before.
        torch.manual_seed(task.seed)
        return config.build_algo()

    def _num_env_steps(self) -> int:
        """Return the Algorithm's own count of env steps; after a copied checkpoint it includes another trial's."""
        algorithm = self.algorithm
        if isinstance(algorithm, ReplayDQN):
            return algorithm.num_env_steps
        return int(algorithm.metrics.peek(_LIFETIME_STEPS, default=0))

    def _continue_streams(self, checkpoint: Path) -> None:
        """Use new random numbers after a restore: RLlib saves no state of the random generators (2.60).

        The replay memory is not in checkpoints, and begins empty. The next iterations fill it: all at once, slow
        environments would take longer than an iteration may.
        """
        assert self._task is not None
        iteration = int(checkpoint.name) if checkpoint.name.isdigit() else 0
        own, seed = random_streams.seeds_after(self._task.seed, iteration)
        torch.manual_seed(own)
        np.random.seed(own)  # noqa: NPY002 (RLlib's connectors draw from the global one)

        def reseed(runner: ArrayEnvRunner) -> None:
            runner.reseed(seed)

        self.algorithm.env_runner_group.foreach_env_runner(reseed)
        if isinstance(self._hyperparams, DQNHyperparams):
            self.algorithm.seed_replay(own)

    @as_raised_there()
    def train_iteration(self) -> IterationStats:
        """Train for one iteration.

        Raises:
            Exception: What an env runner raised, in whichever process.
            CannotRunError: An env runner died; RLlib would continue with fewer, or with none and without learning.
        """
        result = self.algorithm.train()
        group = self.algorithm.env_runner_group
        finished = group.foreach_env_runner(lambda runner: runner.pop_finished_episodes())
        expected = max(1, self._task.num_env_runners if self._task else 0)
        if group.num_remote_env_runners() and group.num_healthy_remote_workers() < expected:
            raise CannotRunError(
                f"An env runner died: {group.num_healthy_remote_workers()} of {expected} are left.",
                "Read the trial's log for the cause; a retry continues the trial from its latest checkpoint.",
            )
        return IterationStats(
            num_env_steps=self._before[0] + self._num_env_steps(),
            episodes=tuple(episode for runner in finished for episode in (runner or ())),
            learner=_learner_stats(result, self._hyperparams),
        )

    def policy(self) -> PortablePolicy:
        """Return the current greedy policy."""
        assert self._task is not None
        assert self._hyperparams is not None
        task = self._task
        training = {
            "trial_id": task.trial_id,
            "seed": task.seed,
            "hyperparams": task.hyperparams,
            "iteration": self._before[1] + self.algorithm.iteration,
        }
        return portable_policy(
            self.algorithm, self._hyperparams, env_id=task.env_id, env_args=task.env_args, training=training
        )

    def save(self, folder: Path) -> None:
        """Write RLlib's own checkpoint into a subfolder of an empty folder."""
        self.algorithm.save_to_path(str((folder / RLLIB_FOLDER).absolute()))

    def close(self) -> None:
        """Stop the Algorithm and free it."""
        if self._algorithm is not None:
            self._algorithm.stop()
            self._algorithm = None


def _is_of(task: TrialTask, saved: PortablePolicy) -> bool:
    """Whether a checkpoint belongs to this trial and has its present hyperparameters."""
    # Only population based training changes hyperparameters or copies checkpoints.
    own = json.loads(json.dumps({"trial_id": task.trial_id, "hyperparams": task.hyperparams}))
    return not task.changes or {name: saved.training.get(name) for name in own} == own


def _learner_stats(result: dict[str, Any], hyperparams: TrainedHyperparams | None) -> dict[str, float]:
    stats = result.get("learners", {}).get(DEFAULT_MODULE_ID, {})
    found = {ours: float(stats[theirs]) for theirs, ours in _LEARNER_STATS.items() if theirs in stats}
    if isinstance(hyperparams, PPOHyperparams) and not hyperparams.use_kl_loss:
        # RLlib measures the divergence for the penalty alone, and says 0 without one.
        found.pop("kl", None)
    return found
