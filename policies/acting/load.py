"""Load policies from their portable files."""

from __future__ import annotations

from pathlib import Path

from policies.acting.baselines import ConstantPolicy
from policies.acting.policy import NetworkPolicy, Policy, RandomPolicy
from policies.arguments import checked
from policies.files import expanded
from policies.portable.file import (
    BASELINE_KINDS,
    PortablePolicy,
    read_policy,
    space_from_description,
)


def policy_from_portable(portable: PortablePolicy, description: str | None = None) -> Policy:
    """Return the policy that a portable policy describes: a network or a baseline.

    Args:
        portable: Read from a file, or made in memory.
        description: Shown in captions and messages; None: made from kind, algorithm and env.
    """
    network = portable.network
    policy: Policy
    if network.kind == "module":
        from policies.acting.module_policy import ModulePolicy  # torch and RLlib, which no other policy needs

        return ModulePolicy(portable, description)
    if network.kind not in BASELINE_KINDS:
        return NetworkPolicy(portable, description)
    spaces = (space_from_description(portable.observation_space), space_from_description(portable.action_space))
    if network.kind == "random":
        policy = RandomPolicy(*spaces, env_id=portable.env_id, env_args=portable.env_args)
    else:
        assert network.action is not None  # read_policy and save_policy have checked it
        policy = ConstantPolicy(*spaces, network.action, env_id=portable.env_id, env_args=portable.env_args)
    if description is not None:
        policy.description = description
    return policy


@checked
def load_policy(path: str | Path) -> Policy:
    """Read a policy from its portable file; this needs neither Ray nor torch, and executes nothing in the file.

    A policy whose network is an RLModule of the user's own needs both, and its class has to be in an allowed module.

    Args:
        path: `policy.json`, `policy.safetensors`, or the folder that holds them; a ~ at its beginning is a home folder.

    Raises:
        NotFoundError: There is no such file.
        CheckpointError: The file is incomplete, altered, or of another format.
        SpecError: It needs a class from a module that is not allowed.
    """
    return policy_from_portable(read_policy(expanded(path)))
