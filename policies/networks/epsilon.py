"""Epsilon, the share of random actions in DQN's exploration, as `DQNHyperparams` describe it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Self

from policies.hyperparams import DQNHyperparams
from policies.schedules import linear


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
        """Return the schedule that the hyperparameters describe."""
        return cls(
            kind=hyperparams.epsilon_schedule,
            unit=hyperparams.epsilon_unit,
            initial=hyperparams.epsilon_initial,
            final=hyperparams.epsilon_final,
            decay=hyperparams.epsilon_decay,
            start=hyperparams.epsilon_start,
        )

    def as_config(self) -> dict[str, Any]:
        """Return the schedule as plain data, for an RLModule's `model_config`."""
        return asdict(self)

    def at(self, num_units: float) -> float:
        """Return epsilon after a number of env steps or episodes."""
        decayed = max(0.0, num_units - self.start)
        if self.kind == "linear":
            return linear(self.initial, self.final, self.decay, decayed)
        share = decayed / self.decay
        if self.kind == "exponential":
            return self.final + (self.initial - self.final) * math.exp(-share)
        return max(self.final, self.initial * math.exp(-share))
