"""Step classic control for all members of a pack in one object, as a loop over their environments would."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies.envs.checked import check_observation, check_reward, is_sound
from policies.envs.classic_rows import ClassicRows
from policies.errors import EnvError
from policies.packed.envs.sub_envs import SubStep


class ClassicHost:
    """A `Host` whose sub-environments are rows: seeds, episodes and errors are those of `SubEnvs`, to the last bit.

    Args:
        rows: The rows, none yet; they belong to this object from here on.
        env_id: Gymnasium id, for messages.
    """

    def __init__(self, rows: ClassicRows, env_id: str) -> None:
        self._rows, self._env_id = rows, env_id
        self._owners: list[str] = []
        self._generators: list[np.random.Generator] = []
        self._asked: tuple[str, tuple[Any, ...]] = ("close", ())

    @classmethod
    def make(cls, env_id: str, env_args: Mapping[str, Any] | None) -> ClassicHost | None:
        """Return a host, or None if the environment has no such rows.

        Raises:
            EnvError: The environment cannot be made.
        """
        rows = ClassicRows.make(env_id, env_args)
        return None if rows is None else cls(rows, env_id)

    def send(self, method: str, *args: Any) -> None:
        """Remember the method and its arguments, for `receive`."""
        self._asked = method, args

    def receive(self) -> Any:
        """Call the method that was asked for last, and return its result."""
        method, args = self._asked
        return getattr(self, method)(*args)

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
            self._find_unsound(stepped.rewards, stepped.observations, errors)
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

    def _find_unsound(
        self, rewards: NDArray[np.float64], observations: NDArray[np.float32], errors: dict[str, EnvError]
    ) -> None:
        for row, owner in enumerate(self._owners):
            if owner not in errors:
                length = int(self._rows.lengths[row])
                try:
                    check_reward(float(rewards[row]), self._env_id, length)
                    check_observation(observations[row], self._env_id, length)
                except EnvError as error:
                    errors[owner] = error
