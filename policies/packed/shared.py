"""What the members of a stack have in common, as types: a stack's program reads it here, and nowhere else.

All other hyperparameters may differ between members, and are read of each.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Self

from policies.hyperparams import PPOHyperparams, TrainedHyperparams


@dataclass(frozen=True)
class Shared:
    """Of PPO and of DQN; the fields are hyperparameters."""

    num_envs: int
    normalize_observations: bool
    train_batch_size: int

    @classmethod
    def of(cls, hyperparams: TrainedHyperparams) -> Self:
        """Those of a member."""
        return cls(**{field.name: getattr(hyperparams, field.name) for field in dataclasses.fields(cls)})


@dataclass(frozen=True)
class SharedByPPO(Shared):
    """What shapes PPO's batches and updates."""

    vf_share_layers: bool
    use_kl_loss: bool
    minibatch_size: int
    num_epochs: int


@dataclass(frozen=True)
class SharedByDQN(Shared):
    """What shapes DQN's phases, batches and updates."""

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
    learning_starts: int
    target_update_unit: str
    epsilon_unit: str


def shared_of(hyperparams: TrainedHyperparams) -> SharedByPPO | SharedByDQN:
    """What every other member of a stack has as this one does."""
    if isinstance(hyperparams, PPOHyperparams):
        return SharedByPPO.of(hyperparams)
    return SharedByDQN.of(hyperparams)
