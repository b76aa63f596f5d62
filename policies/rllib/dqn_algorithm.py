"""RLlib's DQN with a training step of its own: arrays of the env runners, an array replay memory, and `DQNLearner`.

RLlib's own training step makes an episode object of each env step and samples its replay buffer in Python: it makes 480
env steps/s on CartPole where this one makes several thousand. The Algorithm, its env runners, learner group,
checkpoints and results stay RLlib's.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.dqn import DQN, DQNConfig
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    EPISODE_LEN_MAX,
    EPISODE_LEN_MEAN,
    EPISODE_LEN_MIN,
    EPISODE_RETURN_MAX,
    EPISODE_RETURN_MEAN,
    EPISODE_RETURN_MIN,
    LEARNER_RESULTS,
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    NUM_EPISODES_LIFETIME,
)
from torch import Tensor
from typing_extensions import override

from policies.errors import CannotRunError
from policies.hyperparams import DQNHyperparams
from policies.replay import ReplayBuffer, make_replay
from policies.rllib.dqn_learner import DQNLearner
from policies.rllib.env_runner import ArrayEnvRunner, Sample

_COUNTERS = "tune_jobs_counters"


class ReplayDQNConfig(DQNConfig):  # type: ignore[misc]
    """RLlib's config, which also carries our hyperparameters to the learner and the env runners."""

    hyperparams: DQNHyperparams | None = None

    def __init__(self, algo_class: Any = None) -> None:
        super().__init__(algo_class=algo_class or ReplayDQN)


class ReplayDQN(DQN):  # type: ignore[misc]
    """DQN with the variants of `DQNHyperparams`.

    Attributes:
        replay: The replay memory. It is not in checkpoints: after a restore it is filled before anything is learnt.
        num_env_steps: Env steps so far.
        num_episodes: Whole episodes so far.
        num_updates: Updates so far.
    """

    replay: ReplayBuffer

    @classmethod
    @override
    def get_default_config(cls) -> ReplayDQNConfig:
        return ReplayDQNConfig()

    @override
    def setup(self, config: Any) -> None:
        super().setup(config)
        self.num_env_steps = self.num_episodes = self.num_updates = 0
        # Updates that are due but not made: `updates_per_env_step` may be a fraction.
        self._due = 0.0
        # Env steps at which a restored Algorithm's replay memory is as full as it was when learning began.
        self._refilled_at = 0
        self._copies: tuple[list[Tensor], list[Tensor]] | None = None
        self._new_observations: list[NDArray[Any]] = []
        self._last_episodes: deque[tuple[float, int]] = deque(maxlen=self.config.metrics_num_episodes_for_smoothing)
        self.seed_replay(self.config.seed or 0)

    def _create_local_replay_buffer_if_necessary(self, _config: Any) -> None:
        """Make no replay buffer of RLlib's."""

    def seed_replay(self, seed: int) -> None:
        """Begin with an empty replay memory that draws its batches from this seed."""
        self.replay = make_replay(self.hyperparams, seed)

    def learn_after_refilling(self) -> None:
        """After a restore, wait with learning until the replay memory is as full as it was when learning began."""
        hyperparams = self.hyperparams
        # Without replay, the next steps fill it; one that has not learnt yet waits as it did.
        if self.num_updates and hyperparams.replay != "none":
            self._refilled_at = self.num_env_steps + max(hyperparams.learning_starts, hyperparams.train_batch_size)

    @property
    def hyperparams(self) -> DQNHyperparams:
        """The trial's hyperparameters."""
        hyperparams: DQNHyperparams = self.config.hyperparams
        return hyperparams

    @property
    def learner(self) -> DQNLearner:
        """The only learner, which is in this process."""
        learner: DQNLearner = self.learner_group._learner  # noqa: SLF001 - RLlib has no public way to the local one
        return learner

    def training_step(self) -> None:
        """Make one iteration: at least `env_steps_per_iteration` env steps, and the updates that are due for them."""
        hyperparams = self.hyperparams
        start, num_episodes = self.num_env_steps, self.num_episodes
        stats: dict[str, float] = {}
        while self.num_env_steps - start < hyperparams.env_steps_per_iteration:
            num_new_steps = self._sample()
            begins_at = max(hyperparams.learning_starts, self._refilled_at)
            if self.num_env_steps < begins_at or len(self.replay) < hyperparams.train_batch_size:
                if self._learn_statistics():
                    self._send_weights()
                continue
            self._due += num_new_steps * hyperparams.updates_per_env_step
            # 10 x 0.1 is slightly less than 1 in binary.
            num_updates = math.floor(self._due + 1e-9)
            if num_updates:
                self._due -= num_updates
                self.num_updates += num_updates
                stats = self.learner.update_from_replay(
                    self.replay,
                    num_updates,
                    num_env_steps=self.num_env_steps,
                    num_new_steps=num_new_steps,
                    num_episodes=self.num_episodes,
                )
            if self._learn_statistics() or num_updates:
                self._send_weights()
        self._log_episodes(self.num_env_steps - start, self.num_episodes - num_episodes)
        if stats:
            self.metrics.log_dict(stats, key=(LEARNER_RESULTS, DEFAULT_MODULE_ID), window=1)

    def _log_episodes(self, num_steps: int, num_episodes: int) -> None:
        """Log what env runners of RLlib's own log of episodes, once an iteration: each value takes some 20 us."""
        for name, number in ((NUM_ENV_STEPS_SAMPLED_LIFETIME, num_steps), (NUM_EPISODES_LIFETIME, num_episodes)):
            self.metrics.log_value((ENV_RUNNER_RESULTS, name), number, reduce="lifetime_sum")
        if not self._last_episodes:
            return
        returns, lengths = np.array(self._last_episodes).T
        found = {
            EPISODE_RETURN_MEAN: returns.mean(), EPISODE_RETURN_MIN: returns.min(), EPISODE_RETURN_MAX: returns.max(),
            EPISODE_LEN_MEAN: lengths.mean(), EPISODE_LEN_MIN: lengths.min(), EPISODE_LEN_MAX: lengths.max(),
        }  # fmt: skip
        self.metrics.log_dict({name: float(value) for name, value in found.items()}, key=ENV_RUNNER_RESULTS, window=1)

    def _sample(self) -> int:
        """Let the env runners explore for `train_freq` env steps, and return how many they made."""
        num_runners = max(1, self.config.num_env_runners)
        share = math.ceil(self.hyperparams.train_freq / num_runners)
        steps, episodes = self.num_env_steps, self.num_episodes

        def explore(runner: ArrayEnvRunner) -> Sample:
            return runner.sample_transitions(share, num_env_steps=steps, num_episodes=episodes)

        if self.config.num_env_runners:
            samples = self.env_runner_group.foreach_env_runner(explore, local_env_runner=False)
        else:
            samples = [explore(self.env_runner)]
        if len(samples) < num_runners:
            raise CannotRunError(
                f"An env runner died: only {len(samples)} of {num_runners} returned samples.",
                "Read the trial's log for the cause; a retry continues the trial from its latest checkpoint.",
            )
        for sample in samples:
            self.replay.add(sample.transitions)
            self.num_env_steps += sample.num_env_steps
            self.num_episodes += sample.num_episodes
            self._last_episodes.extend(sample.episodes)
            self._new_observations.append(sample.observations)
        return self.num_env_steps - steps

    def _learn_statistics(self) -> bool:
        """Merge the observations since the last call into the statistics; return whether there are any."""
        new, self._new_observations = self._new_observations, []
        # Those that refill the replay memory are in them already, as far as a policy goes on as it did.
        if not self.hyperparams.normalize_observations or self.num_env_steps <= self._refilled_at:
            return False
        module = self.learner.module[DEFAULT_MODULE_ID]
        if not hasattr(module, "update_observation_statistics"):
            return False  # a user's own module, which normalises as it likes, as with PPO
        for observations in new:
            module.update_observation_statistics(observations)
        return True

    def _send_weights(self) -> None:
        """Send the learner's weights to the env runners."""
        if self.config.num_env_runners:
            self.env_runner_group.sync_weights(from_worker_or_learner_group=self.learner_group, inference_only=True)
            return
        if self._copies is None:
            theirs = dict(self.env_runner.module.state_dict())
            ours = self.learner.module[DEFAULT_MODULE_ID].state_dict()
            self._copies = [ours[name] for name in theirs], list(theirs.values())
        ours_now, theirs_now = self._copies
        with torch.no_grad():
            torch._foreach_copy_(theirs_now, ours_now)  # RLlib's own way converts to NumPy and takes ten times as long

    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Return RLlib's state and our counters."""
        state: dict[str, Any] = super().get_state(*args, **kwargs)
        state[_COUNTERS] = {
            "num_env_steps": self.num_env_steps,
            "num_episodes": self.num_episodes,
            "num_updates": self.num_updates,
            "due": self._due,
            "target_updates_at": self.learner.target_updates_at,
            "num_target_updates": self.learner.num_target_updates,
        }
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Set RLlib's state and our counters."""
        super().set_state(state)
        if _COUNTERS not in state:
            return  # the state of a single component
        counters = state[_COUNTERS]
        self.num_env_steps, self.num_episodes = counters["num_env_steps"], counters["num_episodes"]
        self.num_updates, self._due = counters["num_updates"], counters["due"]
        self.learner.target_updates_at = counters["target_updates_at"]
        self.learner.num_target_updates = counters["num_target_updates"]
        self.learn_after_refilling()
