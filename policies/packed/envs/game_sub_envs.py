"""Find where Atari games lose lives among a host's sub-environments; see `policies.envs.atari.AtariTraining`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from policies.envs.atari import lives_of
from policies.packed.envs.sub_envs import SubEnvs, SubStep


class GameSubEnvs(SubEnvs):
    """`SubEnvs` of games whose lost lives are told beside their ends.

    Args:
        env_id: Gymnasium id of a game.
        env_args: The same as for `policies.envs.make.make_env`.
    """

    def __init__(self, env_id: str, env_args: Mapping[str, Any] | None) -> None:
        super().__init__(env_id, env_args)
        self._lives = self._lives_now()

    def _lives_now(self) -> NDArray[np.int64]:
        return np.array([lives_of(one.env) for one in self._envs], np.int64)

    @override
    def add(self, member_id: str, seeds: Sequence[int]) -> list[NDArray[Any]]:
        observations = super().add(member_id, seeds)
        self._lives = self._lives_now()
        return observations

    @override
    def remove(self, member_id: str) -> None:
        super().remove(member_id)
        self._lives = self._lives_now()

    @override
    def step(self, actions: NDArray[Any]) -> SubStep:
        before, found = self._lives, super().step(actions)
        self._lives = self._lives_now()
        # Where a game ended, these are already the lives of the next one.
        lost = (self._lives < before) & ~found.terminated & ~found.truncated
        return replace(found, lost_lives=lost)
