"""What an RLModule class of a user's own must be, for an algorithm and for what hyperparameters ask of its network."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from policies.errors import SpecError

_APIS = "ray.rllib.core.rl_module.apis"
_NEEDED = {"ppo": ("ValueFunctionAPI",), "dqn": ("QNetAPI", "TargetNetworkAPI")}
_EXPLORES = "policies.networks.exploration:EpsilonGreedy"
_OURS = "policies.networks.rl_modules:DQNModule"
_RLLIBS = {"epsilon_schedule": ("linear", "has linear schedules"), "epsilon_unit": ("env_step", "counts env steps")}
"""What RLlib's own exploration does of each."""
ASKED = ("epsilon_schedule", "epsilon_unit", "target_network")
"""DQN's hyperparameters that reach no class but those that derive from ours, beyond RLlib's own values."""


def check_own_module(rl_module: str, found: type, algorithm: str, asked: Mapping[str, Sequence[Any]]) -> None:
    """Check that an algorithm can train a class, and that hyperparameters reach it.

    Nothing is imported: a class derives from none whose module was not imported with it.

    Args:
        rl_module: How the class is named, `module:Class`.
        found: An RLModule class.
        algorithm: `"ppo"` or `"dqn"`.
        asked: The values that a network or its exploration is to have, of the hyperparameters `ASKED`.

    Raises:
        SpecError: It lacks what the algorithm needs, or a value does not reach it.
    """
    for api in _NEEDED[algorithm]:
        if not _derives(found, f"{_APIS}:{api}"):
            raise SpecError(
                f"rl_module {rl_module!r} is not a {api}, which the algorithm needs.",
                "Derive it from policies.networks.PPOModule for PPO, or DQNModule for DQN.",
            )
    if algorithm == "dqn":
        _check_reached(rl_module, found, asked)


def check_stateless(module: Any) -> None:
    """Check that a module which is built needs nothing of the step before but what is in the observation.

    Only the module itself knows, not its class: many classes have the method that gives a state, and give none.

    Args:
        module: An RLModule.

    Raises:
        SpecError: It is recurrent.
    """
    if module.is_stateful():
        named = f"{type(module).__module__}:{type(module).__qualname__}"
        raise SpecError(
            f"rl_module {named!r} is recurrent: its get_initial_state() gives a state, but no state is carried from "
            "one step to the next.",
            "Let get_initial_state() return {}, and give the network earlier observations by env.frame_stack, or by a "
            "wrapper of your own.",
        )


def _check_reached(rl_module: str, found: type, asked: Mapping[str, Sequence[Any]]) -> None:
    for name, (own, why) in _RLLIBS.items():
        others = [value for value in asked.get(name, ()) if value != own]
        if others and not _derives(found, _EXPLORES):
            raise SpecError(
                f"{name} {others[0]} does not reach rl_module {rl_module!r}: RLlib's own exploration {why} only.",
                f"Derive the class from policies.networks.DQNModule, or set {name}: {own}.",
            )
    if not all(asked.get("target_network", ())) and not _derives(found, _OURS):
        raise SpecError(
            f"target_network is false, but rl_module {rl_module!r} always has a target network, like RLlib's own.",
            "Derive the class from policies.networks.DQNModule, or set target_network: true.",
        )


def _derives(found: type, path: str) -> bool:
    module, _, name = path.partition(":")
    owner = sys.modules.get(module)
    return owner is not None and issubclass(found, getattr(owner, name))
