"""Step environments of a pack's members together where there is a way, as a loop over them would."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from policies.envs.checked import is_sound
from policies.envs.copies import Stepper
from policies.envs.together import stepper_of
from policies.errors import EnvError
from policies.packed.envs.game_sub_envs import GameSubEnvs
from policies.packed.envs.sub_envs import SubEnvs, SubStep, find_unsound


def make_sub_envs(env_id: str, env_args: Mapping[str, Any] | None, *, with_lives: bool = False) -> SubEnvs:
    """Return scalar environments of several members, none yet, stepped together if they can be.

    Args:
        env_id: Gymnasium id.
        env_args: The same as for `policies.envs.make.make_env`.
        with_lives: Whether they are games whose lost lives are told.
    """
    if with_lives:
        return GameSubEnvs(env_id, env_args)
    stepper = stepper_of(env_id, env_args)
    return SubEnvs(env_id, env_args) if stepper is None else TogetherSubEnvs(env_id, env_args, stepper)


class TogetherSubEnvs(SubEnvs):
    """`SubEnvs` that are stepped together: seeds, episodes and errors are the same, to the last bit.

    Args:
        env_id: Gymnasium id.
        env_args: The same as for `policies.envs.make.make_env`.
        stepper: Steps them; it belongs to this object from here on.
    """

    def __init__(self, env_id: str, env_args: Mapping[str, Any] | None, stepper: Stepper) -> None:
        super().__init__(env_id, env_args)
        self._stepper = stepper
        self._copies: list[Any] = []

    @override
    def add(self, member_id: str, seeds: Sequence[int]) -> list[NDArray[Any]]:
        observations = super().add(member_id, seeds)
        self._copies += [self._stepper.copy_of(one.env) for one in self._envs[len(self._copies) :]]
        return observations

    @override
    def remove(self, member_id: str) -> None:
        super().remove(member_id)
        self._copies = [self._stepper.copy_of(one.env) for one in self._envs]

    @override
    def step(self, actions: NDArray[Any]) -> SubStep:
        envs, limit = self._envs, self._stepper.limit
        stepped = self._stepper.step(self._copies, actions)
        for one in envs:
            one.num_steps += 1
        lengths = [one.num_steps for one in envs]
        truncated = np.array(lengths) >= (np.inf if limit is None else limit)
        rewards = stepped.rewards.astype(np.float32)
        finals = stepped.observations.astype(np.float32)
        errors: dict[str, EnvError] = {}
        for place, failure in stepped.failures.items():
            errors.setdefault(envs[place].member_id, self._failed("step", failure))
        firsts: dict[int, NDArray[Any]] = {}
        for place in np.flatnonzero(stepped.terminated | truncated).tolist():
            if envs[place].member_id not in errors:
                try:
                    firsts[place] = self._reset(envs[place], None)
                except EnvError as error:
                    errors[envs[place].member_id] = error
        if not (is_sound(rewards) and is_sound(finals)):
            owners = [one.member_id for one in envs]
            space = envs[0].env.observation_space
            errors = find_unsound(owners, rewards, finals, lengths, env_id=self._env_id, space=space) | errors
        return SubStep(finals, firsts, rewards, stepped.terminated, truncated, errors)

    @override
    def close(self) -> None:
        super().close()
        self._stepper.close()
