"""The episodes that run while fragments are collected: those of the environment, and those of the learner.

They differ where training alone sees something of an environment (`policies.envs.training_view`).
"""

from __future__ import annotations

import uuid
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

OWN_REWARDS = "own_rewards"
OWN_ENDS = "own_ends"
"""Ends of episodes, where those of the learner are more."""


class Stream:
    """The running episode of one sub-environment, which continues from one fragment to the next.

    Where a life is lost, the learner's episode ends, and the environment's goes on.
    """

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        """Begin a new episode."""
        self.num_steps = 0
        self.episode_return = 0.0
        self.start_next_life()

    def start_next_life(self) -> None:
        """Begin a new episode for the learner alone."""
        self.episode_id = uuid.uuid4().hex
        self.num_learner_steps = 0
        # The last rows of the previous chunk, for RLlib's lookback buffers: column -> (lookback, ...).
        self.tail: dict[str, NDArray[Any]] = {}

    def keep_tail(self, chunk: SingleAgentEpisode, horizon: int) -> None:
        """Keep the last steps of a chunk, so many as the next one looks back."""
        if horizon == 0:
            return
        self.tail = {
            "obs": chunk.observations.data[-horizon - 1 : -1],
            Columns.ACTIONS: chunk.actions.data[-horizon:],
            "rewards": chunk.rewards.data[-horizon:],
            **{key: buffer.data[-horizon:] for key, buffer in chunk.extra_model_outputs.items()},
        }


class Part:
    """What RLlib's metrics (2.60) ask of a chunk of an episode that runs on, in its place.

    A chunk has all observations of its steps, which would be kept until the episode ends, however long it is.
    """

    def __init__(self, chunk: SingleAgentEpisode) -> None:
        self._length = len(chunk)
        self._return = chunk.get_return()
        self._duration_s = chunk.get_duration_s()

    def __len__(self) -> int:
        """Return the chunk's env steps."""
        return self._length

    def get_return(self) -> Any:
        """Return the sum of the chunk's rewards, as RLlib adds them up."""
        return self._return

    def get_duration_s(self) -> Any:
        """Return the seconds that the chunk took, as RLlib has them."""
        return self._duration_s


def own_rewards_of(fragment: dict[str, NDArray[Any]]) -> NDArray[Any]:
    """Return the env's own rewards, whose sums are the returns, without what training alone sees."""
    return fragment.get(OWN_REWARDS, fragment["rewards"])


def own_ends_of(fragment: dict[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return where whole episodes end."""
    ends: NDArray[np.bool_] | None = fragment.get(OWN_ENDS)
    return np.logical_or(fragment["terminated"], fragment["truncated"]) if ends is None else ends
