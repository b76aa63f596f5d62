"""The hyperparameters that all members of a stack share, as types that a stack's program reads them from.

All other hyperparameters may differ between members, and are read from each member.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Self

from policies.hyperparams import PPOHyperparams, TrainedHyperparams


@dataclass(frozen=True)
class Shared:
    """The shared hyperparameters of both PPO and DQN."""

    num_envs: int
    normalize_observations: bool
    train_batch_size: int

    @classmethod
    def of(cls, hyperparams: TrainedHyperparams) -> Self:
        """Return the shared ones of a member's hyperparameters."""
        return cls(**{field.name: getattr(hyperparams, field.name) for field in dataclasses.fields(cls)})


@dataclass(frozen=True)
class SharedByPPO(Shared):
    """The shared hyperparameters of PPO, which decide the sizes of batches and the steps of updates."""

    vf_share_layers: bool
    use_kl_loss: bool
    minibatch_size: int
    num_epochs: int


@dataclass(frozen=True)
class SharedByDQN(Shared):
    """The shared hyperparameters of DQN, which decide its phases, batches and updates."""

    env_steps_per_iteration: int
    train_freq: int
    updates_per_env_step: float
    double_q: bool
    dueling: bool
    n_step: int
    td_loss: str
    optimizer: str
    target_network: bool
    replay: str
    target_update_unit: str
    epsilon_unit: str


def shared_of(hyperparams: TrainedHyperparams) -> SharedByPPO | SharedByDQN:
    """Return the hyperparameters that every other member of the same stack has to share with this one."""
    if isinstance(hyperparams, PPOHyperparams):
        return SharedByPPO.of(hyperparams)
    return SharedByDQN.of(hyperparams)
