"""RLlib's PPO learner, with schedules that act from the first update on, and statistics of observations and returns."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.ppo.ppo import (
    LEARNER_RESULTS_VF_EXPLAINED_VAR_KEY,
    LEARNER_RESULTS_VF_LOSS_UNCLIPPED_KEY,
)
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core import COMPONENT_OPTIMIZER
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.learner import VF_LOSS_KEY
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer
from ray.rllib.evaluation.postprocessing import Postprocessing
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME
from ray.rllib.utils.torch_utils import explained_variance
from torch import Tensor

from policies.errors import CheckpointError
from policies.networks.denormals import denormals_as_zero
from policies.return_statistics import ReturnStatistics, discounted_returns
from policies.rllib.ruined import check_gradients, check_outputs
from policies.schedules import linear

CLIP_SCHEDULE = "clip_schedule"
"""The key in an algorithm's `learner_config_dict` of the last clip and the env steps until then."""
NORMALIZE_REWARDS = "normalize_rewards"
"""The key in an algorithm's `learner_config_dict` that is true if rewards are normalised."""
RAW_ADVANTAGES = "raw_advantages"
"""The key in an algorithm's `learner_config_dict` that is true if advantages are not standardised."""
VF_CLIP_RANGE = "vf_clip_range"
"""The key in an algorithm's `learner_config_dict` of the `vf_clip_range`, if there is one."""
_KL_COEFFS, _RETURNS = "kl_coeffs", "return_statistics"


class _Changed:
    """A config with some other values; RLlib's own is frozen, and slow to copy."""

    def __init__(self, config: Any, **values: Any) -> None:
        self._config = config
        vars(self).update(values)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._config, name)


class PPOLearner(PPOTorchLearner):  # type: ignore[misc]
    """A PPO learner whose update phase at t env steps uses the learning rate, entropy weight and ratio clip of t.

    RLlib sets both after a phase, for the next one, and saves only the learning rate: after a restore, its entropy
    weight starts at the schedule's first value again, and its KL weight at the config's (2.60). Here both are set
    before each phase, and the KL weight is part of the learner's state.

    Gradients and outputs that are not finite are errors: see `policies.rllib.ruined`.

    Modules that normalise observations add a phase's observations to their statistics after its updates: a batch is
    trained with the statistics it was sampled with, so that PPO's ratio begins at 1.

    RLlib standardises advantages, always, and forgets the values that they were computed with, which `vf_clip_range`
    is about. So those are computed once more, if something needs them.

    Rewards are normalised here, where the episodes of all env runners come together: see
    `policies.return_statistics`. The episodes that env runners keep for RLlib's own metrics have the rewards as before.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._new_observations: dict[str, Tensor] = {}
        self._num_env_steps = 0
        self.return_statistics = ReturnStatistics()
        self._returns: dict[str, NDArray[np.float64]] = {}
        """The discounted return of each running episode, (1,), by the episode's id."""

    def update(self, *args: Any, **kwargs: Any) -> Any:
        """Make RLlib's updates, in which denormal numbers count as zero."""
        with denormals_as_zero():
            return super().update(*args, **kwargs)

    def compute_loss_for_module(self, *, module_id: str, config: Any, batch: Any, fwd_out: dict[str, Any]) -> Any:
        """Return RLlib's loss, with a range of values where there is one.

        Raises:
            NonFiniteWeightsError: The policy's outputs are not finite.
        """
        limit = config.learner_config_dict.get(VF_CLIP_RANGE)
        config = self._with_clip(config)
        # Without a critic, RLlib leaves the value loss out.
        others = config if limit is None else _Changed(config, use_critic=False)
        try:
            loss = super().compute_loss_for_module(module_id=module_id, config=others, batch=batch, fwd_out=fwd_out)
        except (ValueError, RuntimeError):
            # A distribution's: what it says of its parameters names no cause.
            check_outputs(fwd_out[Columns.ACTION_DIST_INPUTS], self.module[module_id].unwrapped())
            raise
        if limit is None:
            return loss
        return loss + config.vf_loss_coeff * self._value_loss(module_id, limit, config.vf_clip_param, batch, fwd_out)

    def _value_loss(
        self, module_id: str, limit: float, vf_clip_param: float, batch: Any, fwd_out: dict[str, Any]
    ) -> Tensor:
        """Return the value loss with a `vf_clip_range`, and log what RLlib logs of its own value loss."""
        module = self.module[module_id].unwrapped()
        values = module.compute_values(batch, embeddings=fwd_out.get(Columns.EMBEDDINGS))
        old, targets = batch[Columns.VF_PREDS], batch[Postprocessing.VALUE_TARGETS]
        squares = (values - targets) ** 2
        at_end = (old + torch.clamp(values - old, -limit, limit) - targets) ** 2
        rows = torch.clamp(torch.maximum(squares, at_end), 0, vf_clip_param)
        if Columns.LOSS_MASK in batch:
            rows, squares = rows[batch[Columns.LOSS_MASK]], squares[batch[Columns.LOSS_MASK]]
        found = {
            VF_LOSS_KEY: rows.mean(),
            LEARNER_RESULTS_VF_LOSS_UNCLIPPED_KEY: squares.mean(),
            LEARNER_RESULTS_VF_EXPLAINED_VAR_KEY: explained_variance(targets, values),
        }
        self.metrics.log_dict(found, key=module_id, window=1)
        return rows.mean()

    def _with_clip(self, config: Any) -> Any:
        """Return the config with the clip that its schedule has now; RLlib has no schedule for it."""
        schedule = config.learner_config_dict.get(CLIP_SCHEDULE)
        if schedule is None:
            return config
        final, num_env_steps = schedule
        clip_param = linear(config.clip_param, final, num_env_steps, self._num_env_steps)
        return _Changed(config, clip_param=clip_param)

    def compute_gradients(self, loss_per_module: dict[str, Any], **kwargs: Any) -> dict[Any, Tensor]:
        """Return RLlib's gradients.

        Raises:
            NonFiniteWeightsError: One is NaN or infinite.
        """
        gradients: dict[Any, Tensor] = super().compute_gradients(loss_per_module, **kwargs)
        check_gradients(gradients.values(), self.module[next(iter(loss_per_module))].unwrapped())
        return gradients

    def before_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        """Set the scheduled values for the env steps sampled so far, including this phase's batch."""
        super().before_gradient_based_update(timesteps=timesteps)
        num_env_steps = timesteps.get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0)
        self._num_env_steps = num_env_steps
        for optimizer, schedule in self._optimizer_lr_schedules.items():
            self._set_optimizer_lr(optimizer, lr=schedule.update(timestep=num_env_steps))
        for module_id in self.module.keys():  # noqa: SIM118 (an RLlib container, which iterates otherwise)
            self.entropy_coeff_schedulers_per_module[module_id].update(timestep=num_env_steps)

    def after_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        """Let the modules add this phase's observations to their statistics."""
        super().after_gradient_based_update(timesteps=timesteps)
        for module_id, observations in self._new_observations.items():
            self.module[module_id].unwrapped().update_observation_statistics(observations)
        self._new_observations.clear()

    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Return the learner's state, with each module's KL weight and the one it began with."""
        state: dict[str, Any] = super().get_state(*args, **kwargs)
        state[_KL_COEFFS] = {
            module_id: (self._first_kl_coeff(module_id), float(value))
            for module_id, value in self.curr_kl_coeffs_per_module.items()
        }
        if self._normalizes_rewards:
            state[_RETURNS] = dict(vars(self.return_statistics))
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Set a state of `get_state`, but not its KL weight if a search has changed kl_coeff since.

        Raises:
            CheckpointError: Rewards are normalised, and the state of a whole learner has no statistics for that.
        """
        super().set_state(state)
        if self._normalizes_rewards and COMPONENT_OPTIMIZER in state:
            if _RETURNS not in state:
                raise CheckpointError(
                    "the saved learner has no statistics of the return, which normalize_rewards needs.",
                    "Use another checkpoint of the trial; training cannot continue from this one.",
                )
            self.return_statistics = ReturnStatistics(**state[_RETURNS])
            # Environments begin new episodes after a restore.
            self._returns.clear()
        for module_id, (first, value) in state.get(_KL_COEFFS, {}).items():
            if first == self._first_kl_coeff(module_id):
                self.curr_kl_coeffs_per_module[module_id].data.fill_(value)

    def _first_kl_coeff(self, module_id: str) -> float:
        return float(self.config.get_config_for_module(module_id).kl_coeff)

    @property
    def _normalizes_rewards(self) -> bool:
        return bool(self.config.learner_config_dict.get(NORMALIZE_REWARDS))

    def _with_normalized_rewards(self, episodes: list[SingleAgentEpisode]) -> list[SingleAgentEpisode]:
        """Add the discounted returns of episode chunks to the statistics; return copies with normalised rewards."""
        running: dict[str, NDArray[np.float64]] = {}
        found = []
        for episode in episodes:
            rewards = np.asarray(episode.get_rewards(), dtype=np.float32)[:, None]
            ended = np.zeros(rewards.shape, dtype=np.bool_)
            ended[-1:] = episode.is_done
            before = running.get(episode.id_, self._returns.get(episode.id_, np.zeros(1)))
            returns, running[episode.id_] = discounted_returns(rewards, ended, self.config.gamma, before)
            found.append(returns)
        # An episode that goes on has steps in every batch, so that the others are over.
        self._returns = running
        self.return_statistics.add(np.concatenate(found))
        scaled = []
        for episode in episodes:
            new, buffer = copy(episode), episode.rewards
            new.rewards = InfiniteLookbackBuffer(
                self.return_statistics.scale(buffer.data), buffer.lookback, buffer.space
            )
            scaled.append(new)
        return scaled

    def _make_batch_if_necessary(self, training_data: Any) -> Any:
        if self._normalizes_rewards and training_data.episodes is not None:
            training_data = replace(training_data, episodes=self._with_normalized_rewards(training_data.episodes))
        batch = super()._make_batch_if_necessary(training_data)
        for module_id, columns in batch.policy_batches.items():
            if training_data.episodes is not None:
                self._use_old_values(module_id, columns)
            if hasattr(self.module[module_id].unwrapped(), "update_observation_statistics"):
                # RLlib adds a row to each episode chunk, for the value after its end; that row is not a step.
                self._new_observations[module_id] = columns[Columns.OBS][columns[Columns.LOSS_MASK]]
        return batch

    def _use_old_values(self, module_id: str, columns: Any) -> None:
        """Add the values of the policy that has sampled to a new batch, and advantages by them, if they are needed."""
        own = self.config.learner_config_dict
        keeps, is_raw = VF_CLIP_RANGE in own, own.get(RAW_ADVANTAGES)
        if not keeps and not is_raw:
            return
        with torch.no_grad():
            values = self.module[module_id].unwrapped().compute_values(columns)
        if keeps:
            columns[Columns.VF_PREDS] = values
        if is_raw:
            columns[Postprocessing.ADVANTAGES] = columns[Postprocessing.VALUE_TARGETS] - values
