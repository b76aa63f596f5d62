"""Epsilon-greedy exploration with the schedules of `DQNHyperparams`."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Self

import torch
from ray.rllib.core.columns import Columns
from torch import Tensor

from policies.hyperparams import DQNHyperparams

QF_PREDS = "qf_preds"
"""RLlib's key of Q-values in the output of `compute_q_values`."""


@dataclass(frozen=True)
class EpsilonSchedule:
    """The share of random actions as a function of env steps or episodes; see `DQNHyperparams`."""

    kind: str
    unit: str
    initial: float
    final: float
    decay: float
    start: int

    @classmethod
    def of(cls, hyperparams: DQNHyperparams) -> Self:
        """The schedule that the hyperparameters describe."""
        return cls(
            kind=hyperparams.epsilon_schedule,
            unit=hyperparams.epsilon_unit,
            initial=hyperparams.epsilon_initial,
            final=hyperparams.epsilon_final,
            decay=hyperparams.epsilon_decay,
            start=hyperparams.epsilon_start,
        )

    def as_config(self) -> dict[str, Any]:
        """As plain data, for an RLModule's `model_config`."""
        return asdict(self)

    def at(self, num_units: float) -> float:
        """Epsilon after so many env steps or episodes."""
        share = max(0.0, num_units - self.start) / self.decay
        if self.kind == "linear":
            return self.initial + (self.final - self.initial) * min(1.0, share)
        if self.kind == "exponential":
            return self.final + (self.initial - self.final) * math.exp(-share)
        return max(self.final, self.initial * math.exp(-share))


class EpsilonGreedy:
    """Mixin for a DQN RLModule: draws a random action with the probability its schedule gives, else the greedy one.

    `model_config["exploration"]` holds the schedule, as `EpsilonSchedule.as_config` gives it.
    """

    model_config: Any
    _schedule: EpsilonSchedule | None = None

    @property
    def exploration_schedule(self) -> EpsilonSchedule:
        """The schedule of this module."""
        if self._schedule is None:
            self._schedule = EpsilonSchedule(**self.model_config["exploration"])
        return self._schedule

    @property
    def epsilon_unit(self) -> str:
        """What `t` counts: env_step or episode."""
        return self.exploration_schedule.unit

    def _forward_exploration(self, batch: dict[str, Tensor], t: float = 0.0, **_: Any) -> dict[str, Tensor]:
        """Actions for a batch of observations.

        Args:
            batch: Holds observations, shape (N, ...).
            t: Env steps or episodes so far, in the schedule's unit.
        """
        q_values = self.compute_q_values(batch)[QF_PREDS]  # type: ignore[attr-defined]
        actions = q_values.argmax(dim=-1)
        epsilon = self.exploration_schedule.at(t)
        if epsilon > 0.0:
            random_actions = torch.randint(q_values.shape[-1], actions.shape, device=actions.device)
            actions = torch.where(torch.rand(actions.shape, device=actions.device) < epsilon, random_actions, actions)
        return {Columns.ACTIONS: actions}
