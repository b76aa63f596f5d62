"""A helper of the project's environment."""

from typing import SupportsFloat


def reward_of(action: SupportsFloat) -> float:
    return float(action)
