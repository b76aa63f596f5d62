"""CartPole that steps slowly while a file is there, so that a fault comes while something trains."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv


class Paced(CartPoleEnv):
    """The numbers are CartPole's, however slow.

    Args:
        slow: A file; while it is there, every step takes `pace_s`.
        pace_s: Seconds.
        fault: A file; while it is there, the first process that steps removes it and meets what it names: `hang`,
            `exit` (`os._exit`) or `memory` (it allocates until it is stopped).
    """

    def __init__(self, slow: str, pace_s: float = 0.004, fault: str = "") -> None:
        super().__init__()
        self._slow, self._pace_s, self._fault = slow, pace_s, fault

    def step(self, action: Any) -> Any:
        if Path(self._slow).exists():
            time.sleep(self._pace_s)
        if self._fault and (how := _take(Path(self._fault))):
            _meet(how)
        return super().step(action)  # type: ignore[no-untyped-call]


def _take(path: Path) -> str:
    taken = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        path.rename(taken)
    except OSError:
        return ""
    return taken.read_text(encoding="utf-8")


def _meet(how: str) -> None:
    if how == "exit":
        os._exit(3)
    if how == "hang":
        time.sleep(10_000)
    kept = []
    while True:
        kept.append(np.ones(2**24))


gym.register("FaultsPaced-v0", entry_point="tests.faults.paced:Paced", max_episode_steps=200)
