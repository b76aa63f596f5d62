"""When the end of an episode is a failure: what a failure penalty is for.

Termination alone does not say it. CartPole terminates when the pole falls, MountainCar when the car has arrived. So it
is known for Gymnasium's own environments, by the classes that they are made from, and an environment of somebody's own
says it: `metadata = {"failure": "terminated"}`.
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
    """Which steps end an episode by failure: those that terminate it, with a certain reward if one is given."""

    reward: float | None = None

    def failed(self, rewards: NDArray[Any], terminated: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Whether each step failed.

        Args:
            rewards: The env's own, of shape (num_envs,).
            terminated: Of shape (num_envs,).

        Returns:
            Of shape (num_envs,).
        """
        if self.reward is None:
            return np.asarray(terminated, dtype=np.bool_)
        failed: NDArray[np.bool_] = np.logical_and(terminated, np.asarray(rewards) == self.reward)
        return failed


# Class of the environment, in Gymnasium's packages of them -> its rule. Read in the sources of Gymnasium 1.2.
_TERMINATION = FailureRule()
# The lander's and the walker's crash; a lander that has come to rest terminates too, with 100.
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
_SWITCH = "terminate_when_unhealthy"  # of MuJoCo's walkers


def failure_rule(
    env_id: str, spec: EnvSpec, metadata: Mapping[str, Any], env_args: Mapping[str, Any]
) -> FailureRule | None:
    """When an environment's episodes end by failure; None: never, or it is not known.

    Args:
        env_id: For messages.
        spec: What the environment is made from.
        metadata: The environment's own.
        env_args: What its constructor is given.

    Raises:
        EnvError: Its metadata says something else than "terminated".
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
    """The rule, if there is one.

    Raises:
        EnvError: There is none, so that the penalty would never be given.
    """
    if rule is None:
        raise EnvError(
            f"failure_penalty is {penalty:g}, but {env_id} has no failure: its episodes never end by one, as far as is "
            "known, so nothing would be penalised.",
            f"Leave failure_penalty out; an env of your own whose termination is failure says so with "
            f"metadata = {{'{_METADATA_KEY}': '{_TERMINATED}'}}.",
        )
    return rule
