"""What tests of stacked replay memories and of their sums over n steps share: rows of two numbers each."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies.hyperparams import DQNHyperparams
from policies.replay import Transitions

D = 2
BATCH = 6


def make_hyperparams(**values: Any) -> DQNHyperparams:
    return DQNHyperparams(**{"train_batch_size": BATCH, "replay_capacity": 10, **values})


def as_rows(found: Transitions) -> NDArray[np.float32]:
    """The same as a stacked memory's rows, (B, columns)."""
    ones = np.ones((len(found.actions), 1), dtype=np.float32)
    numbers = np.stack([found.actions, found.rewards, found.discounts], axis=1)
    return np.concatenate([found.obs, ones, found.next_obs, ones, numbers], axis=1).astype(np.float32)
