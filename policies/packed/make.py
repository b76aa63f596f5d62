"""Make the stack of an algorithm."""

from __future__ import annotations

from policies.hyperparams import DQNHyperparams, TrainedHyperparams
from policies.packed.envs.vector import PackedEnvs
from policies.packed.shared import SharedByDQN, SharedByPPO
from policies.packed.stack import AnyStack


def make_stack(hyperparams: TrainedHyperparams, envs: PackedEnvs, device: str = "cpu") -> AnyStack:
    """Return a stack without members, for members that share the values of `shared_of` with these hyperparameters."""
    if isinstance(hyperparams, DQNHyperparams):
        from policies.packed.dqn.stack import DQNStack

        return DQNStack(SharedByDQN.of(hyperparams), envs, device)
    from policies.packed.ppo.stack import PPOStack

    return PPOStack(SharedByPPO.of(hyperparams), envs, device)
