"""Typed, frozen hyperparameters of PPO and DQN.

Words: a *hyperparameter* is a value that training is given; *weights* are what training finds. Everything here can be
fixed in a sweep file or searched. Units: env steps are steps of one sub-environment; sizes of batches are in env steps
(PPO) or transitions (DQN).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Activation = Literal["linear", "relu", "tanh", "silu", "elu", "gelu"]
Algorithm = Literal["ppo", "dqn"]
ACTIVATIONS: tuple[str, ...] = ("linear", "relu", "tanh", "silu", "elu", "gelu")

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
PositiveFloat = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
PositiveInt = Annotated[int, Field(ge=1)]


class _Hyperparams(BaseModel):
    """What PPO and DQN share."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    hidden_sizes: tuple[PositiveInt, ...] = Field(
        (64, 64), min_length=1, description="Units of each hidden layer, from input to output."
    )
    activation: Activation = Field("tanh", description="Activation after each hidden layer.")
    lr: PositiveFloat = Field(3e-4, description="Adam's learning rate, > 0.")
    gamma: Fraction = Field(0.99, description="Discount a step, in [0, 1].")
    grad_clip: PositiveFloat | None = Field(
        None, description="Clip the gradient's global L2 norm at this; null: no clipping."
    )
    num_envs: PositiveInt = Field(8, le=512, description="Sub-environments that one env runner steps at once.")


class PPOHyperparams(_Hyperparams):
    """Hyperparameters of PPO (Schulman et al. 2017, "Proximal Policy Optimization Algorithms")."""

    gae_lambda: Fraction = Field(0.95, description="Lambda of generalised advantage estimation, in [0, 1].")
    clip_param: PositiveFloat = Field(0.2, description="Clip the policy ratio to 1 -/+ this.")
    vf_clip_param: PositiveFloat | None = Field(
        None,
        description="Clip the squared value error at this; null: no clipping. RLlib's own default, 10, stops the value "
        "function from learning where returns are larger than a few units.",
    )
    vf_loss_coeff: NonNegativeFloat = Field(0.5, description="Weight of the value loss.")
    vf_share_layers: bool = Field(False, description="One encoder for policy and value function.")
    entropy_coeff: NonNegativeFloat = Field(0.0, description="Weight of the entropy bonus.")
    use_kl_loss: bool = Field(False, description="Add RLlib's adaptive KL penalty to the loss.")
    kl_coeff: NonNegativeFloat = Field(0.2, description="First weight of the KL penalty, if used.")
    kl_target: PositiveFloat = Field(0.01, description="KL divergence the penalty aims at, if used.")
    train_batch_size: PositiveInt = Field(1024, description="Env steps an iteration, over all env runners.")
    minibatch_size: PositiveInt = Field(256, description="Env steps a gradient step; at most train_batch_size.")
    num_epochs: PositiveInt = Field(6, description="Passes over each train batch.")

    @model_validator(mode="after")
    def _minibatch_fits(self) -> Self:
        if self.minibatch_size > self.train_batch_size:
            raise ValueError(
                f"minibatch_size {self.minibatch_size} is larger than train_batch_size {self.train_batch_size}: "
                "lower the one or raise the other"
            )
        return self


class DQNHyperparams(_Hyperparams):
    """Hyperparameters of DQN (Mnih et al. 2015) with its double, dueling and n-step variants."""

    activation: Activation = Field("relu", description="Activation after each hidden layer.")
    lr: PositiveFloat = Field(5e-4, description="Adam's learning rate, > 0.")
    num_envs: PositiveInt = Field(1, le=512, description="Sub-environments that one env runner steps at once.")
    train_batch_size: PositiveInt = Field(32, description="Transitions an update.")
    env_steps_per_iteration: PositiveInt = Field(1000, description="Env steps an iteration, at least.")
    training_intensity: PositiveFloat | None = Field(
        None,
        description="Transitions trained on for each env step sampled; null: one update a sampling step.",
    )
    double_q: bool = Field(True, description="Double Q-learning (van Hasselt et al. 2016).")
    dueling: bool = Field(True, description="Dueling heads (Wang et al. 2016).")
    n_step: PositiveInt = Field(1, description="Steps of reward before bootstrapping.")
    adam_epsilon: PositiveFloat = Field(1e-8, description="Adam's epsilon.")
    target_network_update_freq: PositiveInt = Field(500, description="Env steps between target updates.")
    tau: Fraction = Field(1.0, description="Share of the online weights in a target update; 1: a copy.")
    replay_capacity: PositiveInt = Field(50_000, description="Transitions the replay buffer holds.")
    learning_starts: int = Field(1_000, ge=0, description="Env steps sampled before the first update.")
    prioritized_replay: bool = Field(False, description="Prioritized instead of uniform replay.")
    epsilon_initial: Fraction = Field(1.0, description="Share of random actions at the start.")
    epsilon_final: Fraction = Field(0.05, description="Share of random actions at the end.")
    epsilon_decay_steps: PositiveInt = Field(10_000, description="Env steps from the first share to the last.")

    @model_validator(mode="after")
    def _buffer_holds_a_batch(self) -> Self:
        if self.replay_capacity < self.train_batch_size:
            raise ValueError(
                f"replay_capacity {self.replay_capacity} is smaller than train_batch_size {self.train_batch_size}: "
                "raise the one or lower the other"
            )
        return self


Hyperparams = PPOHyperparams | DQNHyperparams
HYPERPARAMS_BY_ALGORITHM: dict[str, type[PPOHyperparams | DQNHyperparams]] = {
    "ppo": PPOHyperparams,
    "dqn": DQNHyperparams,
}


def make_hyperparams(algorithm: Algorithm, values: dict[str, Any]) -> Hyperparams:
    """Validate values as the hyperparameters of an algorithm.

    Raises:
        pydantic.ValidationError: A name is unknown or a value is of the wrong type or out of range.
    """
    return HYPERPARAMS_BY_ALGORITHM[algorithm].model_validate(values)
