"""Typed, frozen hyperparameters of PPO and DQN, and of the baselines that do not learn.

Words: a *hyperparameter* is a value that training is given; *weights* are what training finds. Everything here can be
fixed in a sweep file or searched. Units: env steps are steps of one sub-environment; sizes of batches are in env steps
(PPO) or transitions (DQN).
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema, model_validator

from policies.activations import Activation

Algorithm = Literal["ppo", "dqn", "random", "constant"]
Initializer = Literal["torch", "he_uniform", "orthogonal"]

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
PositiveFloat = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
PositiveInt = Annotated[int, Field(ge=1)]


def as_sizes(value: Any) -> Any:
    """Turn a single number into the list of one number that it stands for."""
    return (value,) if _is_number(value) else value


def _as_action(value: Any) -> Any:
    """Return an action as a number or as a list, so that pydantic reports a wrong one only once."""
    if _is_number(value):
        return int(value) if float(value).is_integer() else (float(value),)
    if isinstance(value, list | tuple) and value and all(map(_is_number, value)):
        return tuple(map(float, value))
    raise ValueError(f"{value!r} is not allowed: it should be a number, or a list of numbers for continuous actions")


def _is_number(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return isinstance(value, int) and not isinstance(value, bool)


_SIZE = {"type": "integer", "minimum": 1}
_SIZES = {"anyOf": [_SIZE, {"type": "array", "items": _SIZE, "minItems": 1}]}
_ACTION = {"anyOf": [{"type": "number"}, {"type": "array", "items": {"type": "number"}, "minItems": 1}]}
Sizes = Annotated[tuple[PositiveInt, ...], BeforeValidator(as_sizes), WithJsonSchema(_SIZES)]
"""A list of whole numbers; a single number stands for a list of one."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    def __setstate__(self, state: dict[Any, Any]) -> None:
        """Take over what was pickled, as in checkpoints of RLlib, with the defaults of fields that are newer."""
        super().__setstate__(state)
        for name, field in type(self).model_fields.items():
            self.__dict__.setdefault(name, field.get_default(call_default_factory=True))


class _Hyperparams(_Frozen):
    """The hyperparameters that PPO and DQN share."""

    hidden_sizes: Sizes = Field(
        (64, 64),
        min_length=1,
        description="Units of each hidden layer, from input to output; a single number stands for one layer.",
    )
    activation: Activation = Field("tanh", description="Activation after each hidden layer.")
    initializer: Initializer = Field(
        "torch",
        description="First weights: torch's default, he_uniform (He et al. 2015) or orthogonal (Saxe et al. 2014), "
        "the last two with zero biases.",
    )
    conv_filters: tuple[tuple[PositiveInt, PositiveInt, PositiveInt], ...] | None = Field(
        None,
        min_length=1,
        description="Convolutions before the hidden layers, for images, also for one among other members; each is "
        "[channels, kernel, stride].",
    )
    normalize_observations: bool = Field(
        False, description="Shift and scale observations by their running mean and deviation in training."
    )
    lr: PositiveFloat = Field(3e-4, description="The optimizer's learning rate, > 0.")
    lr_final: NonNegativeFloat | None = Field(
        None, description="Move lr linearly to this over lr_decay_steps; null: lr stays."
    )
    lr_decay_steps: PositiveInt | None = Field(None, description="Env steps from lr to lr_final.")
    gamma: Fraction = Field(0.99, description="Discount factor per env step, in [0, 1].")
    grad_clip: PositiveFloat | None = Field(
        None, description="Clip the gradient's global L2 norm at this; null: no clipping."
    )
    num_envs: PositiveInt = Field(8, le=512, description="Sub-environments that one env runner steps at once.")

    @model_validator(mode="after")
    def _schedules_are_whole(self) -> Self:
        _check_schedule("lr_final", self.lr_final, "lr_decay_steps", self.lr_decay_steps)
        return self


class PPOHyperparams(_Hyperparams):
    """Hyperparameters of PPO (Schulman et al. 2017, "Proximal Policy Optimization Algorithms")."""

    gae_lambda: Fraction = Field(0.95, description="Lambda of generalised advantage estimation, in [0, 1].")
    clip_param: PositiveFloat = Field(0.2, description="Clip the policy ratio to 1 -/+ this.")
    clip_param_final: NonNegativeFloat | None = Field(
        None, description="Move clip_param linearly to this over clip_decay_steps; null: it stays."
    )
    clip_decay_steps: PositiveInt | None = Field(None, description="Env steps from clip_param to clip_param_final.")
    vf_clip_param: PositiveFloat | None = Field(
        None,
        description="Clip the squared value error at this; null: no clipping. RLlib's own default, 10, stops the value "
        "function from learning where returns are larger than a few units.",
    )
    vf_clip_range: PositiveFloat | None = Field(
        None,
        description="Count the larger of two squared value errors: the value's, and that of the value moved by at most "
        "this since the batch was sampled; null: the value's alone. vf_clip_param then limits the one that counts.",
    )
    vf_loss_coeff: NonNegativeFloat = Field(0.5, description="Weight of the value loss.")
    vf_share_layers: bool = Field(False, description="One encoder for policy and value function.")
    free_log_std: bool = Field(
        False,
        description="For continuous actions: one log standard deviation for each component, the same for all "
        "observations and 0 at first; false: the policy's network gives them for each observation.",
    )
    entropy_coeff: NonNegativeFloat = Field(0.0, description="Weight of the entropy bonus.")
    entropy_coeff_final: NonNegativeFloat | None = Field(
        None, description="Move entropy_coeff linearly to this over entropy_decay_steps; null: it stays."
    )
    entropy_decay_steps: PositiveInt | None = Field(
        None, description="Env steps from entropy_coeff to entropy_coeff_final."
    )
    use_kl_loss: bool = Field(False, description="Add RLlib's adaptive KL penalty to the loss.")
    kl_coeff: NonNegativeFloat = Field(0.2, description="First weight of the KL penalty, if used.")
    kl_target: PositiveFloat = Field(0.01, description="KL divergence the penalty aims at, if used.")
    normalize_advantages: bool = Field(
        True, description="Shift and scale advantages to mean 0 and deviation 1 over each train batch."
    )
    normalize_rewards: bool = Field(
        False,
        description="Divide rewards in training by the running deviation of the discounted return, and clip them at "
        "-/+ 10; returns are reported as the environment gives them.",
    )
    train_batch_size: PositiveInt = Field(1024, description="Env steps per iteration, over all env runners.")
    minibatch_size: PositiveInt = Field(256, description="Env steps per gradient step; at most train_batch_size.")
    num_epochs: PositiveInt = Field(6, description="Passes over each train batch.")

    @model_validator(mode="after")
    def _minibatch_fits(self) -> Self:
        if self.minibatch_size > self.train_batch_size:
            raise ValueError(
                f"minibatch_size {self.minibatch_size} is larger than train_batch_size {self.train_batch_size}: "
                "lower the one or raise the other"
            )
        _check_schedule("clip_param_final", self.clip_param_final, "clip_decay_steps", self.clip_decay_steps)
        _check_schedule(
            "entropy_coeff_final", self.entropy_coeff_final, "entropy_decay_steps", self.entropy_decay_steps
        )
        return self


class DQNHyperparams(_Hyperparams):
    """Hyperparameters of DQN (Mnih et al. 2015) with its double, dueling, n-step and prioritized variants.

    A training phase follows every `train_freq` env steps; it makes `updates_per_env_step` updates for each of them.
    """

    activation: Activation = Field("relu", description="Activation after each hidden layer.")
    lr: PositiveFloat = Field(5e-4, description="The optimizer's learning rate, > 0.")
    num_envs: PositiveInt = Field(1, le=512, description="Sub-environments that one env runner steps at once.")
    train_batch_size: PositiveInt = Field(32, description="Transitions per update.")
    env_steps_per_iteration: PositiveInt = Field(1000, description="Env steps per iteration, at least.")
    train_freq: PositiveInt = Field(4, description="Env steps sampled between two training phases, at least num_envs.")
    updates_per_env_step: PositiveFloat = Field(
        0.25, description="Updates for each env step sampled (training intensity); may be a fraction."
    )
    double_q: bool = Field(True, description="Double Q-learning (van Hasselt et al. 2016).")
    dueling: bool = Field(True, description="Dueling heads (Wang et al. 2016).")
    n_step: PositiveInt = Field(1, description="Steps of reward before bootstrapping.")
    reward_scale: PositiveFloat = Field(
        1.0, description="Factor of the rewards that are learned from; returns are told without it."
    )
    td_loss: Literal["huber", "mse"] = Field("huber", description="Loss of the TD error: Huber (delta 1) or squared.")
    optimizer: Literal["adam", "rmsprop"] = Field("adam", description="Adam or RMSprop.")
    optimizer_epsilon: PositiveFloat = Field(1e-8, description="Epsilon of Adam or RMSprop.")
    adam_beta1: Fraction = Field(0.9, lt=1.0, description="Adam's decay of the mean gradient.")
    adam_beta2: Fraction = Field(0.999, lt=1.0, description="Adam's decay of the squared gradient.")
    rmsprop_rho: Fraction = Field(0.99, description="RMSprop's decay of the squared gradient.")
    rmsprop_momentum: NonNegativeFloat = Field(0.0, description="RMSprop's momentum.")
    target_network: bool = Field(True, description="Bootstrap from a target network; false: from the online one.")
    target_update_freq: PositiveInt | None = Field(
        None,
        description="Env steps or episodes (target_update_unit) between target updates; null: 500 if hard, each update "
        "if soft.",
    )
    target_update_unit: Literal["env_step", "episode"] = Field(
        "env_step", description="What target_update_freq counts."
    )
    tau: Annotated[float, Field(gt=0.0, le=1.0)] = Field(
        1.0, description="Share of the online weights in a target update; 1: hard, a copy; less: soft."
    )
    replay: Literal["uniform", "prioritized", "none"] = Field(
        "uniform",
        description="Batches drawn from a replay buffer uniformly or by priority (Schaul et al. 2016); none: the last "
        "train_batch_size transitions.",
    )
    replay_capacity: PositiveInt = Field(50_000, description="Transitions the replay buffer holds.")
    prioritized_alpha: Fraction = Field(0.6, description="Exponent of the priorities; 0: uniform.")
    prioritized_beta: Fraction = Field(0.4, description="Exponent of the importance weights.")
    prioritized_epsilon: PositiveFloat = Field(
        1e-6, description="Added to a transition's |TD error|, of which prioritized_alpha makes its priority."
    )
    learning_starts: int = Field(1_000, ge=0, description="Env steps sampled before the first update.")
    epsilon_schedule: Literal["linear", "exponential", "geometric"] = Field(
        "linear",
        description="How epsilon moves with t units: linear, from initial to final in epsilon_decay; exponential: "
        "final + (initial - final) exp(-t / epsilon_decay); geometric: initial exp(-t / epsilon_decay), never < final.",
    )
    epsilon_unit: Literal["env_step", "episode"] = Field("env_step", description="What the schedule counts.")
    epsilon_initial: Fraction = Field(1.0, description="Share of random actions at the start.")
    epsilon_final: Fraction = Field(0.05, description="Share of random actions at the end.")
    epsilon_decay: PositiveFloat = Field(
        10_000, description="Length or scale of the decay, in env steps or episodes (epsilon_unit)."
    )
    epsilon_start: int = Field(0, ge=0, description="Env steps or episodes (epsilon_unit) before the decay begins.")

    @property
    def target_update_interval(self) -> int | None:
        """Env steps or episodes (`target_update_unit`) between target updates; None: one follows every update."""
        if self.target_update_freq is not None:
            return self.target_update_freq
        return 500 if self.tau == 1.0 else None

    @model_validator(mode="after")
    def _buffer_holds_a_batch(self) -> Self:
        if self.replay != "none" and self.replay_capacity < self.train_batch_size:
            raise ValueError(
                f"replay_capacity {self.replay_capacity} is smaller than train_batch_size {self.train_batch_size}: "
                "raise the one or lower the other"
            )
        return self

    @model_validator(mode="after")
    def _variants_go_together(self) -> Self:
        if not self.target_network:
            if self.tau != 1.0:
                raise ValueError(
                    f"tau {self.tau:g} makes soft updates of a target network, but target_network is false: "
                    "set target_network: true, or leave tau out"
                )
            if self.double_q:
                raise ValueError(
                    "double_q is true, which needs a target network, but target_network is false: set double_q: false, "
                    "or target_network: true"
                )
        if self.replay == "none" and self.n_step > 1:
            raise ValueError(
                f"n_step {self.n_step} needs a replay buffer, but replay is none: set replay: uniform, or n_step: 1"
            )
        return self


class RandomHyperparams(_Frozen):
    """Hyperparameters of the baseline that draws its actions uniformly."""

    num_envs: PositiveInt = Field(1, le=512, description="Sub-environments stepped at once.")
    env_steps_per_iteration: PositiveInt = Field(1000, description="Env steps per iteration, at least.")


class ConstantHyperparams(RandomHyperparams):
    """Hyperparameters of the baseline that repeats one action."""

    action: Annotated[int | tuple[float, ...], BeforeValidator(_as_action), WithJsonSchema(_ACTION)] = Field(
        0, description="The action: a number, or a list for continuous actions."
    )


def _check_schedule(final_name: str, final: float | None, steps_name: str, steps: int | None) -> None:
    if (final is None) is not (steps is None):
        given, missing = (final_name, steps_name) if steps is None else (steps_name, final_name)
        raise ValueError(f"{given} is given without {missing}: a schedule needs both; leave out both for none")


TrainedHyperparams = PPOHyperparams | DQNHyperparams
Hyperparams = TrainedHyperparams | RandomHyperparams
HYPERPARAMS_BY_ALGORITHM: dict[str, type[Hyperparams]] = {
    "ppo": PPOHyperparams,
    "dqn": DQNHyperparams,
    "random": RandomHyperparams,
    "constant": ConstantHyperparams,
}
"""The hyperparameter class of every algorithm, baselines last."""


def make_hyperparams(algorithm: Algorithm, values: dict[str, Any]) -> Hyperparams:
    """Validate values as the hyperparameters of an algorithm.

    Raises:
        pydantic.ValidationError: A name is unknown, or a value has the wrong type or is out of range.
    """
    return HYPERPARAMS_BY_ALGORITHM[algorithm].model_validate(values)
