"""Find out when the end of an episode is a failure, for which a failure penalty is given.

Termination alone is not enough: CartPole terminates when the pole falls, but MountainCar when the car has arrived. For
Gymnasium's own environments the rule is looked up by their class; a user's own environment declares it with
`metadata = {"failure": "terminated"}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from policies.errors import EnvError

_METADATA_KEY = "failure"
_TERMINATED = "terminated"


@dataclass(frozen=True)
class FailureRule:
    """Says which steps end an episode by failure: those that terminate it, and have a certain reward if one is set."""

    reward: float | None = None

    def failed(self, rewards: NDArray[Any], terminated: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Whether each step failed.

        Args:
            rewards: The env's own rewards, shape (num_envs,).
            terminated: Whether each step terminated its episode, shape (num_envs,).

        Returns:
            An array of shape (num_envs,).
        """
        if self.reward is None:
            return np.asarray(terminated, dtype=np.bool_)
        failed: NDArray[np.bool_] = np.logical_and(terminated, np.asarray(rewards) == self.reward)
        return failed


# Maps the class of an environment of Gymnasium's to its rule, as its source code in Gymnasium 1.2 has it.
_TERMINATION = FailureRule()
# The reward of a crash of the lander and of the walker; a lander at rest terminates too, with a reward of 100.
_CRASH = FailureRule(reward=-100.0)
_KNOWN = {
    "CartPoleEnv": _TERMINATION,
    "InvertedPendulumEnv": _TERMINATION,
    "InvertedDoublePendulumEnv": _TERMINATION,
    "HopperEnv": _TERMINATION,
    "Walker2dEnv": _TERMINATION,
    "HumanoidEnv": _TERMINATION,
    "AntEnv": _TERMINATION,
    "LunarLander": _CRASH,
    "BipedalWalker": _CRASH,
}
_SWITCH = "terminate_when_unhealthy"  # an argument of MuJoCo's walkers


def failure_rule(
    env_id: str, spec: EnvSpec, metadata: Mapping[str, Any], env_args: Mapping[str, Any]
) -> FailureRule | None:
    """Return the rule by which an environment's episodes end by failure; None if they never do, or it is not known.

    Args:
        env_id: The env's id, for messages.
        spec: The entry of Gymnasium's registry that the environment is made from.
        metadata: The environment's metadata.
        env_args: The arguments of its constructor.

    Raises:
        EnvError: The metadata says something other than "terminated".
    """
    said = metadata.get(_METADATA_KEY)
    if said == _TERMINATED:
        return _TERMINATION
    if said is not None:
        raise EnvError(
            f"{env_id} has metadata['{_METADATA_KEY}'] = {said!r}; the only kind of failure is {_TERMINATED!r}.",
            f"Set it to {_TERMINATED!r} if termination is failure, or leave it out.",
        )
    entry = spec.entry_point
    path = entry if isinstance(entry, str) else f"{getattr(entry, '__module__', '')}:{getattr(entry, '__name__', '')}"
    module, _, name = path.partition(":")
    if not module.startswith("gymnasium.envs.") or not {**spec.kwargs, **env_args}.get(_SWITCH, True):
        return None
    return _KNOWN.get(name)


def check_failure_penalty(env_id: str, rule: FailureRule | None, penalty: float) -> FailureRule:
    """Return the rule, if there is one.

    Raises:
        EnvError: There is no rule, so the penalty would never be given.
    """
    if rule is None:
        raise EnvError(
            f"failure_penalty is {penalty:g}, but {env_id} has no failure: its episodes never end by one, as far as is "
            "known, so nothing would be penalised.",
            f"Leave failure_penalty out; an env of your own whose termination is failure says so with "
            f"metadata = {{'{_METADATA_KEY}': '{_TERMINATED}'}}.",
        )
    return rule
