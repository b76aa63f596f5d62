"""Step classic control for all members of a pack in one object, as a loop over their environments would."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies.envs.checked import is_sound
from policies.envs.classic_rows import ClassicRows
from policies.errors import EnvError
from policies.packed.envs.sub_envs import SubStep, find_unsound


class ClassicSubEnvs:
    """`SubEnvs` that are rows: seeds, episodes and errors are the same, to the last bit.

    Args:
        rows: The rows, none yet; they belong to this object from here on.
        env_id: Gymnasium id, for messages.
    """

    def __init__(self, rows: ClassicRows, env_id: str) -> None:
        self._rows, self._env_id = rows, env_id
        self._owners: list[str] = []
        self._generators: list[np.random.Generator] = []

    def add(self, member_id: str, seeds: Sequence[int]) -> list[NDArray[np.float32]]:
        """Add sub-environments of a member, one for each seed, and return their first observations."""
        rows = self._rows
        generators = [rows.generator(seed) for seed in seeds]
        starts = [rows.start(generator) for generator in generators]
        rows.put(
            np.concatenate([rows.states, [start.state for start in starts]]),
            np.concatenate([rows.lengths, np.zeros(len(seeds), dtype=np.int64)]),
        )
        self._owners += [member_id] * len(seeds)
        self._generators += generators
        return [start.observation for start in starts]

    def remove(self, member_id: str) -> None:
        """Remove a member's sub-environments, if it has any here."""
        kept = [row for row, owner in enumerate(self._owners) if owner != member_id]
        self._rows.put(self._rows.states[kept], self._rows.lengths[kept])
        self._owners = [self._owners[row] for row in kept]
        self._generators = [self._generators[row] for row in kept]

    def step(self, actions: NDArray[Any]) -> SubStep:
        """Step all sub-environments; where an episode ends, begin the next.

        Args:
            actions: One action for each, as the env takes them.
        """
        rows = self._rows
        stepped = rows.step(actions)
        errors: dict[str, EnvError] = {}
        if not (is_sound(stepped.rewards) and is_sound(stepped.observations)):
            lengths = rows.lengths.tolist()
            errors = find_unsound(self._owners, stepped.rewards, stepped.observations, lengths, env_id=self._env_id)
        firsts: dict[int, NDArray[Any]] = {}
        for row in np.flatnonzero(stepped.terminated | stepped.truncated).tolist():
            start = rows.start(self._generators[row])
            rows.restart(row, start.state)
            firsts[row] = start.observation
        rewards = stepped.rewards.astype(np.float32)
        return SubStep(stepped.observations, firsts, rewards, stepped.terminated, stepped.truncated, errors)

    def close(self) -> None:
        """Close the environment that draws the starts."""
        self._rows.close()
