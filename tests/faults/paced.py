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
            `exit` (`os._exit`) or `memory SHARE` (it allocates until so much of the machine's memory is used).
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


class Alike(Paced):
    """All episodes begin alike, whatever their seeds, and none ends before its last step.

    So a trial that goes on with new episodes has the numbers of one that was not disturbed, if an iteration is whole
    episodes and nothing else was lost.
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self.state = np.array([0.01, -0.02, 0.03, -0.04], np.float64)
        return self.state.astype(np.float32), {}

    def step(self, action: Any) -> Any:
        observation, _, fell, truncated, info = super().step(action)
        # CartPole warns of each step after a fall.
        self.steps_beyond_terminated = None
        return observation, float(not fell), False, truncated, info


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
    kept: list[Any] = []
    until = time.monotonic() + 10_000
    while time.monotonic() < until:
        # What others free meanwhile is taken, too.
        if how.startswith("memory") and used_memory() < float(how.split()[1]):
            kept.append(np.ones(_PIECE_BYTES, np.uint8))
        time.sleep(_PIECE_S)


def used_memory() -> float:
    """The share of this machine's memory that is used."""
    lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    sizes = {line.partition(":")[0]: int(line.split()[1]) for line in lines}
    return 1.0 - sizes["MemAvailable"] / sizes["MemTotal"]


_PIECE_BYTES, _PIECE_S = 2**26, 0.02


gym.register("FaultsPaced-v0", entry_point="tests.faults.paced:Paced", max_episode_steps=200)
gym.register("FaultsAlike-v0", entry_point="tests.faults.paced:Alike", max_episode_steps=16)
