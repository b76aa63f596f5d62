"""The `baseline` engine: it plays episodes with a policy that does not learn, without ray and torch.

Its trials look like any others, with results, evaluations, checkpoints and a portable policy, so that a sweep of random
play is reported, filmed and compared in the same way as a sweep of PPO.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies import random_streams
from policies.acting.baselines import baseline_policy
from policies.acting.evaluate import Resettable
from policies.acting.load import policy_from_portable
from policies.acting.policy import Policy
from policies.envs.checked import CheckedEnvs
from policies.envs.make import make_vector_env
from policies.errors import MALFORMED, CheckpointError
from policies.hyperparams import Algorithm, RandomHyperparams, make_hyperparams
from policies.portable.file import PortablePolicy
from tune_jobs.training.protocol import IterationStats, TrialTask

STATE_FILE = "baseline.json"


class BaselineEngine:
    """The engine of trials that do not learn; implements `TrainingEngine`."""

    def __init__(self) -> None:
        self._env: gym.vector.VectorEnv[Any, Any, Any] | None = None

    def build(self, task: TrialTask, checkpoint: Path | None) -> None:
        """Make the policy and the environments of a trial, fresh or with the counters of a checkpoint."""
        self.close()
        hyperparams = make_hyperparams(cast("Algorithm", task.algorithm), task.hyperparams)
        assert isinstance(hyperparams, RandomHyperparams)
        self._task, self._hyperparams = task, hyperparams
        self._iteration = self._num_env_steps = 0
        seed = task.seed
        if checkpoint is not None:
            self._iteration, self._num_env_steps = _read_state(checkpoint / STATE_FILE)
            # New seeds, so that it does not repeat the episodes it has played already.
            seed, _ = random_streams.seeds_after(task.seed, self._iteration)
        # The failure penalty is only for learning: returns are sums of the env's own rewards.
        env = make_vector_env(task.env_id, task.env_args, hyperparams.num_envs)
        self._env = CheckedEnvs(env, task.env_id)
        self._policy: Policy = policy_from_portable(self.policy())
        if isinstance(self._policy, Resettable):
            self._policy.reset(seed)
        self._observations, _ = self._env.reset(seed=seed)
        self._returns: NDArray[np.float64] = np.zeros(hyperparams.num_envs)  # returns of the running episodes so far
        self._lengths: NDArray[np.int64] = np.zeros(hyperparams.num_envs, dtype=np.int64)
        self._ended: NDArray[np.bool_] = np.zeros(hyperparams.num_envs, dtype=np.bool_)

    def train_iteration(self) -> IterationStats:
        """Play for one iteration; nothing is trained."""
        assert self._env is not None
        goal = self._num_env_steps + self._hyperparams.env_steps_per_iteration
        finished: list[tuple[float, int]] = []
        while self._num_env_steps < goal:
            actions = self._policy.act_on_rows(self._observations)
            self._observations, rewards, terminated, truncated, _ = self._env.step(actions)
            # NEXT_STEP autoreset: the step after an episode's last one only resets; it is no env step.
            running = ~self._ended
            self._returns[running] += rewards[running]
            self._lengths[running] += 1
            self._num_env_steps += int(running.sum())
            self._ended = running & (terminated | truncated)
            for index in np.flatnonzero(self._ended):
                finished.append((float(self._returns[index]), int(self._lengths[index])))
                self._returns[index], self._lengths[index] = 0.0, 0
        self._iteration += 1
        return IterationStats(num_env_steps=self._num_env_steps, episodes=tuple(finished))

    def policy(self) -> PortablePolicy:
        """Return the policy, which never changes."""
        assert self._env is not None
        task = self._task
        return baseline_policy(
            self._hyperparams,
            env_id=task.env_id,
            env_args=task.env_args,
            observation_space=self._env.single_observation_space,
            action_space=self._env.single_action_space,
            training={
                "trial_id": task.trial_id,
                "seed": task.seed,
                "hyperparams": task.hyperparams,
                "iteration": self._iteration,
            },
        )

    def save(self, folder: Path) -> None:
        """Write the counters into an empty folder; a restored trial begins new episodes."""
        state = {"iteration": self._iteration, "num_env_steps": self._num_env_steps}
        (folder / STATE_FILE).write_text(json.dumps(state) + "\n", encoding="utf-8")

    def close(self) -> None:
        """Close the environments."""
        if self._env is not None:
            self._env.close()
            self._env = None


def _read_state(path: Path) -> tuple[int, int]:
    try:
        state = json.loads(path.read_text(encoding="utf-8"))
        return int(state["iteration"]), int(state["num_env_steps"])
    except (OSError, *MALFORMED) as error:
        raise CheckpointError(
            f"{path} cannot be read: {error!r}.",
            "Use another checkpoint of the trial; training cannot continue from this one.",
        ) from error
