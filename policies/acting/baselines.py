"""The baselines: policies that ignore observations and learn nothing, to compare trained policies with.

`random` draws its actions uniformly (`policies.acting.policy.RandomPolicy`), `constant` repeats one. Both can be
evaluated, filmed, put into a portable policy file and read back like a trained policy.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.acting.policy import Policy, copy_space
from policies.envs.make import check_env
from policies.envs.masks import MaskedBox
from policies.envs.own_actions import sizes_of
from policies.errors import SpecError
from policies.hyperparams import ConstantHyperparams, Hyperparams
from policies.portable.file import PolicyNetwork, PortablePolicy, action_problem, describe_space

BASELINES: tuple[str, ...] = ("random", "constant")
"""Algorithms that do not learn."""


class ConstantPolicy(Policy):
    """A policy that repeats one action, whatever it observes; where a mask forbids it, the first that is allowed.

    Args:
        observation_space: The env's; only its shape, its type and its mask matter.
        action_space: The space that holds the action.
        action: An int (Discrete), or one number for each component (Box).
        env_id: The environment it is for.
        env_args: The arguments of that environment.

    Raises:
        SpecError: The action is not in the action space.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        action: int | tuple[float, ...],
        *,
        env_id: str,
        env_args: Mapping[str, Any] | None = None,
    ) -> None:
        own_space = copy_space(action_space)
        shown = list(action) if isinstance(action, tuple) else action
        super().__init__(
            observation_space, own_space, env_id=env_id, env_args=env_args, description=f"constant action {shown}"
        )
        if problem := action_problem(action, own_space):
            raise SpecError(f"The constant action of {env_id}: {problem}.", "Choose one of the actions.")
        self.action = action
        self._action = np.array(action, dtype=own_space.dtype).reshape(own_space.shape or ())

    @classmethod
    def for_env(
        cls, env_id: str, env_args: Mapping[str, Any] | None, action: int | tuple[float, ...]
    ) -> ConstantPolicy:
        """Return a policy that repeats one action of an environment.

        Raises:
            EnvError: The environment cannot be made, or its spaces are not supported.
            SpecError: The action is not in its action space.
        """
        info = check_env(env_id, env_args)
        return cls(info.observation_space, info.action_space, action, env_id=info.env_id, env_args=info.env_args)

    def _act_batch(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        actions = np.repeat(self._action[None], len(observations), axis=0)
        if isinstance(self.observation_space, MaskedBox):
            return self._allowed(actions, observations[:, : self.observation_space.num_masked])
        return actions

    def _allowed(self, actions: NDArray[Any], masks: NDArray[np.float32]) -> NDArray[Any]:
        """Return the actions, with the first value that is allowed in place of each that a mask forbids."""
        space = self.action_space
        start = int(space.start) if isinstance(space, gym.spaces.Discrete) else 0
        sizes = sizes_of(space)
        columns = actions.reshape(len(actions), -1) - start
        for place, block in enumerate(np.split(masks, np.cumsum(sizes)[:-1], axis=1)):
            chosen = columns[:, place]
            is_allowed = np.take_along_axis(block, chosen[:, None], axis=1)[:, 0] > 0
            columns[:, place] = np.where(is_allowed, chosen, block.argmax(axis=1))
        return (columns + start).reshape(actions.shape)


def baseline_policy(
    hyperparams: Hyperparams,
    *,
    env_id: str,
    env_args: dict[str, Any],
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
    training: dict[str, Any] | None = None,
) -> PortablePolicy:
    """Return a baseline as a portable policy.

    Args:
        hyperparams: Those of `random` or `constant`.
        env_id: The environment it is for.
        env_args: The arguments of that environment.
        observation_space: The environment's.
        action_space: The environment's.
        training: Free metadata, such as the trial's id.
    """
    if isinstance(hyperparams, ConstantHyperparams):
        algorithm, network = "constant", PolicyNetwork("constant", (), action=hyperparams.action)
    else:
        algorithm, network = "random", PolicyNetwork("random", ())
    return PortablePolicy(
        network=network,
        algorithm=algorithm,
        env_id=env_id,
        env_args=env_args,
        observation_space=describe_space(observation_space),
        action_space=describe_space(action_space),
        training=training or {},
    )
