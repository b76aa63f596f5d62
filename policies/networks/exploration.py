"""Epsilon-greedy exploration with the schedules of `DQNHyperparams`."""

from __future__ import annotations

from typing import Any

import torch
from ray.rllib.core.columns import Columns
from torch import Tensor

from policies.networks.epsilon import EpsilonSchedule

QF_PREDS = "qf_preds"
"""RLlib's key for Q-values in the output of `compute_q_values`."""


class EpsilonGreedy:
    """Mixin for a DQN RLModule: acts randomly with the probability that its schedule gives, else greedily.

    `model_config["exploration"]` holds the schedule, as `EpsilonSchedule.as_config` gives it.
    """

    model_config: Any
    _schedule: EpsilonSchedule | None = None

    @property
    def exploration_schedule(self) -> EpsilonSchedule:
        """The epsilon schedule of this module."""
        if self._schedule is None:
            self._schedule = EpsilonSchedule(**self.model_config["exploration"])
        return self._schedule

    @property
    def epsilon_unit(self) -> str:
        """The unit that `t` counts: env_step or episode."""
        return self.exploration_schedule.unit

    def _forward_exploration(self, batch: dict[str, Tensor], t: float = 0.0, **_: Any) -> dict[str, Tensor]:
        """Return the actions for a batch of observations.

        Args:
            batch: Holds observations, shape (N, ...).
            t: Env steps or episodes so far, in the schedule's unit.
        """
        q_values = self.compute_q_values(batch)[QF_PREDS]  # type: ignore[attr-defined]
        actions = q_values.argmax(dim=-1)
        epsilon = self.exploration_schedule.at(t)
        if epsilon > 0.0:
            random_actions = self._draw(batch[Columns.OBS], actions.shape, q_values.shape[-1])
            actions = torch.where(torch.rand(actions.shape, device=actions.device) < epsilon, random_actions, actions)
        return {Columns.ACTIONS: actions}

    def _draw(self, observations: Tensor, shape: torch.Size, num_actions: int) -> Tensor:
        """Draw random actions, of those that a mask allows if there is one."""
        # A module that derives from another of our classes knows of masks.
        num_masked = getattr(self, "_num_masked", 0)
        if not num_masked:
            return torch.randint(num_actions, shape, device=observations.device)
        return torch.multinomial(observations[..., :num_masked].float(), 1).squeeze(-1)
