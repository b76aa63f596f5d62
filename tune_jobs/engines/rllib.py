"""The `rllib` engine: one RLlib Algorithm a trial, rebuilt in the same warm process for the next."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from ray.rllib.algorithms.algorithm import Algorithm as RLlibAlgorithm
from ray.rllib.core import DEFAULT_MODULE_ID

from policies.env_runner import ArrayEnvRunner
from policies.errors import CannotRunError
from policies.hyperparams import Algorithm, DQNHyperparams, Hyperparams, make_hyperparams
from policies.portable import PortablePolicy, read_policy
from policies.restore import portable_policy, restore_algorithm
from policies.rllib_config import build_algorithm_config
from tune_jobs.engines.protocol import IterationStats, TrialTask

RLLIB_FOLDER = "rllib"
_LIFETIME_STEPS = ("env_runners", "num_env_steps_sampled_lifetime")
# RLlib's name -> ours; the others are timers and counters.
_LEARNER_STATS = {
    "total_loss": "total_loss",
    "policy_loss": "policy_loss",
    "vf_loss": "vf_loss",
    "entropy": "entropy",
    "mean_kl_loss": "kl",
    "qf_loss": "qf_loss",
    "qf_mean": "q_mean",
    "gradients_default_optimizer_global_norm": "gradient_norm",
    "default_optimizer_learning_rate": "lr",
}


class RLlibEngine:
    """See `TrainingEngine`."""

    def __init__(self) -> None:
        self._algorithm: RLlibAlgorithm | None = None
        self._task: TrialTask | None = None
        self._hyperparams: Hyperparams | None = None

    @property
    def algorithm(self) -> RLlibAlgorithm:
        """The Algorithm of the current trial.

        Raises:
            RuntimeError: Nothing has been built.
        """
        if self._algorithm is None:
            raise RuntimeError("build() has not been called")
        return self._algorithm

    def build(self, task: TrialTask, checkpoint: Path | None) -> None:
        """See `TrainingEngine.build`."""
        self.close()
        # Small networks run up to several times slower on more than one thread, and trials share the cores.
        torch.set_num_threads(1)
        # Validated where the values came from, the sweep file; this turns JSON back into the typed object.
        hyperparams = make_hyperparams(cast("Algorithm", task.algorithm), task.hyperparams)
        self._task, self._hyperparams = task, hyperparams
        if checkpoint is not None:
            saved = read_policy(checkpoint)
            self._algorithm = restore_algorithm(checkpoint / RLLIB_FOLDER, saved.network)
            self._continue_streams(checkpoint)
            return
        config = build_algorithm_config(
            hyperparams,
            env_id=task.env_id,
            env_args=task.env_args,
            seed=task.seed,
            num_env_runners=task.num_env_runners,
            num_gpus=task.num_gpus,
        )
        # The learner's weights are drawn from these; a warm process has drawn other numbers before.
        torch.manual_seed(task.seed)
        self._algorithm = config.build_algo()
        self._seed_replay(task.seed)

    def _seed_replay(self, seed: int) -> None:
        """Let DQN draw its batches from the trial's seed; RLlib's buffers use a generator without one (2.60)."""
        if isinstance(self._hyperparams, DQNHyperparams):
            self.algorithm.local_replay_buffer.rng = np.random.default_rng(seed)

    def _continue_streams(self, checkpoint: Path) -> None:
        """After a restore: other random numbers than at the trial's start, and a replay buffer with something in it.

        RLlib saves neither the state of the random generators nor the replay buffer (2.60).
        """
        assert self._task is not None
        iteration = int(checkpoint.name) if checkpoint.name.isdigit() else 0
        words = np.random.SeedSequence([self._task.seed, iteration]).generate_state(2)
        torch.manual_seed(int(words[0]))
        np.random.seed(int(words[0]))  # noqa: NPY002 (RLlib's replay buffers and connectors draw from the global one)
        self._seed_replay(int(words[0]))
        seed = int(words[1])

        def reseed(runner: ArrayEnvRunner) -> None:
            runner.reseed(seed)

        self.algorithm.env_runner_group.foreach_env_runner(reseed)
        if isinstance(self._hyperparams, DQNHyperparams):
            num_steps = max(self._hyperparams.learning_starts, self._hyperparams.train_batch_size)
            share = math.ceil(num_steps / max(1, self._task.num_env_runners))
            # Where env runners of their own sample, the main process has one without environments.
            episodes = self.algorithm.env_runner_group.foreach_env_runner(
                lambda runner: runner.sample(num_timesteps=share) if runner.env is not None else []
            )
            for chunk in episodes:
                self.algorithm.local_replay_buffer.add(chunk)

    def train_iteration(self) -> IterationStats:
        """See `TrainingEngine.train_iteration`.

        Raises:
            CannotRunError: An env runner died; RLlib would go on with fewer, or with none and without learning.
        """
        result = self.algorithm.train()
        group = self.algorithm.env_runner_group
        finished = group.foreach_env_runner(lambda runner: runner.pop_finished_episodes())
        expected = max(1, self._task.num_env_runners if self._task else 0)
        if group.num_remote_env_runners() and group.num_healthy_remote_workers() < expected:
            raise CannotRunError(
                f"An env runner died: {group.num_healthy_remote_workers()} of {expected} are left.",
                "See the trial's log; the trial goes on from its latest checkpoint when it is retried.",
            )
        return IterationStats(
            num_env_steps=int(_at(result, _LIFETIME_STEPS)),
            episodes=tuple(episode for runner in finished for episode in (runner or ())),
            learner=_learner_stats(result),
        )

    def policy(self) -> PortablePolicy:
        """See `TrainingEngine.policy`."""
        assert self._task is not None
        assert self._hyperparams is not None
        task = self._task
        training = {
            "trial_id": task.trial_id,
            "seed": task.seed,
            "hyperparams": task.hyperparams,
            "iteration": self.algorithm.iteration,
        }
        return portable_policy(
            self.algorithm, self._hyperparams, env_id=task.env_id, env_args=task.env_args, training=training
        )

    def save(self, folder: Path) -> None:
        """See `TrainingEngine.save`: RLlib's own checkpoint, in a folder of its own."""
        self.algorithm.save_to_path(str((folder / RLLIB_FOLDER).absolute()))

    def close(self) -> None:
        """See `TrainingEngine.close`."""
        if self._algorithm is not None:
            self._algorithm.stop()
            self._algorithm = None


def _at(result: dict[str, Any], path: tuple[str, ...]) -> Any:
    value: Any = result
    for key in path:
        value = value[key]
    return value


def _learner_stats(result: dict[str, Any]) -> dict[str, float]:
    stats = result.get("learners", {}).get(DEFAULT_MODULE_ID, {})
    found = {ours: float(stats[theirs]) for theirs, ours in _LEARNER_STATS.items() if theirs in stats}
    return {name: value for name, value in found.items() if math.isfinite(value)}
