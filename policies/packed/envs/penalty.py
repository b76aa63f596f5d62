"""The failure penalty of a pack's environments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies.envs.failures import FailureRule
from policies.envs.faults import close_env
from policies.envs.make import make_vector_env
from policies.envs.wrappers import FailurePenalty


@dataclass(frozen=True)
class Penalty:
    """The reward of steps that end an episode by failure."""

    rule: FailureRule
    reward: float

    @classmethod
    def find(cls, env_id: str, env_args: Mapping[str, Any] | None, reward: float | None) -> Penalty | None:
        """Return the penalty with the environment's failure rule, or None if no penalty is given.

        Raises:
            EnvError: There is a penalty, and the env has no failure.
        """
        if reward is None:
            return None
        env = make_vector_env(env_id, env_args, 1, failure_penalty=reward)
        close_env(env)
        assert isinstance(env, FailurePenalty)
        return cls(env.rule, env.penalty)

    def apply(self, rewards: NDArray[np.float32], terminated: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Return the rewards that the learner gets, as a new array."""
        return np.where(self.rule.failed(rewards, terminated), np.float32(self.reward), rewards)
