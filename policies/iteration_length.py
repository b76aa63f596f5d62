"""How many env steps an iteration of training has."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


def iteration_length(hyperparams: Mapping[str, Any]) -> int | None:
    """Return the env steps of an iteration, at least; None: its hyperparameters don't say, as of another version.

    All sub-environments step together, and DQN's iterations end with a sampling phase. So they are those that were
    asked for, rounded up to whole steps or phases; with several env runners they may be some more.

    Args:
        hyperparams: All of a trial's hyperparameters.
    """
    asked = hyperparams.get("env_steps_per_iteration", hyperparams.get("train_batch_size"))
    at_once, between_updates = hyperparams.get("num_envs", 1), hyperparams.get("train_freq", 1)
    if any(type(number) is not int or number < 1 for number in (asked, at_once, between_updates)):
        return None
    phase = _rounded_up(between_updates, at_once)
    return _rounded_up(asked, phase)


def _rounded_up(number: int, unit: int) -> int:
    return math.ceil(number / unit) * unit
