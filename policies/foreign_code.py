"""A setting as a program for Stable-Baselines3 or RLlib, and what of it they have no name for.

The names are those of `policies.foreign_names`; the values are computed where they mean something else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from policies.foreign_envs import env_kwargs, known_env, rllib_env, sb3_env
from policies.foreign_phases import rllib_phase, rllib_target, sb3_phase, sb3_target
from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams
from policies.schedules import linear

_TORCH = {"linear": "Identity", "relu": "ReLU", "tanh": "Tanh", "silu": "SiLU", "elu": "ELU", "gelu": "GELU"}
_FITS = 100
"""Columns that a call may take in one line."""
_TORCHS_ADAM = {"optimizer_epsilon": 1e-8, "adam_beta1": 0.9, "adam_beta2": 0.999}
"""Adam as RLlib makes it."""


@dataclass(frozen=True)
class ForeignProgram:
    """A program for another library."""

    code: str
    notes: tuple[str, ...]
    """What it leaves out or does otherwise, each a sentence."""


@dataclass(frozen=True)
class _Code:
    """Python code as an argument's value."""

    text: str

    def __repr__(self) -> str:
        return self.text


_NO_CLIPPING = _Code('float("inf")')


def stable_baselines3_program(
    values: TrainedHyperparams,
    *,
    env_id: str,
    env_args: Mapping[str, Any],
    num_env_steps: int,
    flattens: bool = False,
    may_be_continuous: bool = False,
) -> ForeignProgram:
    """Return a program that trains with a setting in Stable-Baselines3 2.7 or later.

    Args:
        values: The setting, all hyperparameters of it.
        env_id: A registered Gymnasium id, or `module:Class`, which is registered first.
        env_args: Keyword arguments of the environment.
        num_env_steps: Env steps to train.
        flattens: Whether the env's own observations, neither vectors nor images, are to be made such.
        may_be_continuous: Whether a note on continuous actions is wanted.
    """
    is_ppo = isinstance(values, PPOHyperparams)
    env = known_env(env_id)
    made = sb3_env(values, env, env_args, flattens=flattens)
    arguments, notes = _sb3_ppo(values) if isinstance(values, PPOHyperparams) else _sb3_dqn(values, num_env_steps)
    learning_rate: Any = values.lr
    if values.lr_final is not None and values.lr_decay_steps is not None:
        # SB3 gives the share of total_timesteps that is left.
        change = f"({values.lr_final!r} - {values.lr!r})"
        done = f"min(1.0, (1.0 - left) * {num_env_steps} / {values.lr_decay_steps})"
        learning_rate = _Code(f"lambda left: {values.lr!r} + {change} * {done}")
    network: dict[str, Any] = {
        "net_arch": list(values.hidden_sizes),
        "activation_fn": _Code(f"torch.nn.{_TORCH[values.activation]}"),
    }
    if is_ppo:
        network["ortho_init"] = values.initializer == "orthogonal"
    network |= _sb3_optimizer(values)
    if values.initializer == "he_uniform" or (values.initializer == "orthogonal" and not is_ppo):
        notes.append(f"initializer {values.initializer} is left out: it takes a policy class of your own.")
    if values.conv_filters is not None:
        # Three convolutions of 8, 4 and 3 pixels, each 4, 2 and 1 apart.
        notes.append(
            "conv_filters are left out: CnnPolicy has its own, for images of bytes of 36 x 36 pixels or more; others "
            "take a features extractor that you write."
        )
    if may_be_continuous and isinstance(values, PPOHyperparams):
        notes.append(_sb3_continuous(values))
    name = "PPO" if is_ppo else "DQN"
    imports = [*env.imports, "import torch", f"from stable_baselines3 import {name}", *made.imports]
    call = {
        "learning_rate": learning_rate,
        "gamma": values.gamma,
        "max_grad_norm": _NO_CLIPPING if values.grad_clip is None else values.grad_clip,
        **arguments,
        "policy_kwargs": network,
    }
    policy = "MlpPolicy" if values.conv_filters is None else "CnnPolicy"
    model = _call(f"model = {name}", [repr(policy), "env"], call)
    lines = [*env.registration, *made.lines, model, f"model.learn(total_timesteps={num_env_steps})"]
    return ForeignProgram("\n".join([*imports, "", *lines]), (*env.notes, *notes, *made.notes))


def rllib_program(
    values: TrainedHyperparams, *, env_id: str, env_args: Mapping[str, Any], flattens: bool = False
) -> ForeignProgram:
    """Return a program that makes RLlib's algorithm (Ray 2.60, new API stack) with a setting.

    Args:
        values: The setting, all hyperparameters of it.
        env_id: A registered Gymnasium id, or `module:Class`, which is registered first.
        env_args: Keyword arguments of the environment.
        flattens: Whether the env's own observations, neither vectors nor images, are to be made such.
    """
    env = rllib_env(values, known_env(env_id), flattens=flattens)
    arguments, notes = _rllib_ppo(values) if isinstance(values, PPOHyperparams) else _rllib_dqn(values)
    name = "PPO" if isinstance(values, PPOHyperparams) else "DQN"
    activation = "GELU" if values.activation == "gelu" else values.activation
    model: dict[str, Any] = {"fcnet_hiddens": list(values.hidden_sizes), "fcnet_activation": activation}
    if isinstance(values, PPOHyperparams):
        model["vf_share_layers"] = values.vf_share_layers
        if values.free_log_std:
            model["free_log_std"] = True
    if values.conv_filters is not None:
        model["conv_filters"] = [list(item) for item in values.conv_filters]
        model["conv_activation"] = activation
        # RLlib's fcnet_hiddens are for vectors: after convolutions, dense layers are those of the heads.
        del model["fcnet_hiddens"], model["fcnet_activation"]
        model |= {"head_fcnet_hiddens": list(values.hidden_sizes), "head_fcnet_activation": activation}
        notes.append("RLlib pads the convolutions of conv_filters, which we don't.")
        if values.vf_share_layers if isinstance(values, PPOHyperparams) else values.dueling:
            notes.append("Each head has hidden_sizes of its own: RLlib's heads share the convolutions alone.")
    if values.initializer != "torch":
        notes.append(f"initializer {values.initializer} is left out: fcnet_kernel_initializer takes torch's functions.")
    runners: dict[str, Any] = {"num_env_runners": 0, "num_envs_per_env_runner": values.num_envs}
    if isinstance(values, DQNHyperparams):
        runners["rollout_fragment_length"] = rllib_phase(values).num_vector_steps
    if values.normalize_observations:
        notes.append("normalize_observations is left out: RLlib's is a connector, MeanStdFilter.")
    schedule = values.lr if values.lr_final is None else [[0, values.lr], [values.lr_decay_steps, values.lr_final]]
    # RLlib's DQN clips at 40 if it isn't told.
    training = {"lr": schedule, "gamma": values.gamma, "grad_clip": values.grad_clip, **arguments}
    chain = [
        f".environment({env.env_id!r}{env_kwargs('env_config', env_args)})",
        _call(".env_runners", [], runners),
        ".learners(num_learners=0)",
        _call(".training", [], training),
        f".rl_module(model_config={_call('DefaultModelConfig', [], model)})",
    ]
    body = "\n".join(f"    {line}" for part in chain for line in part.splitlines())
    imports = [
        *env.imports,
        f"from ray.rllib.algorithms.{name.lower()} import {name}Config",
        "from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig",
    ]
    made = f"config = (\n    {name}Config()\n{body}\n)\nalgorithm = config.build_algo()"
    code = "\n".join([*imports, "", *env.registration, made])
    return ForeignProgram(code, (*env.notes, *notes))


def _sb3_ppo(values: PPOHyperparams) -> tuple[dict[str, Any], list[str]]:
    # Ours samples whole vector steps too, and the batch at least.
    n_steps = math.ceil(values.train_batch_size / values.num_envs)
    notes = _sb3_minibatches(values, n_steps * values.num_envs)
    if values.entropy_coeff_final is not None:
        notes.append("entropy_coeff stays at its first value: SB3 has no schedule for ent_coef.")
    if values.clip_param_final is not None:
        notes.append(
            "clip_param stays at its first value: SB3's clip_range takes a function of the share that is left."
        )
    if values.vf_clip_param is not None:
        notes.append("vf_clip_param is left out: clip_range_vf means something else.")
    if values.vf_clip_range is not None:
        notes.append("clip_range_vf counts the limited value's error alone, vf_clip_range the larger of two.")
    if values.use_kl_loss:
        notes.append("The KL penalty is left out: target_kl means something else.")
    if values.vf_share_layers:
        notes.append("vf_share_layers is left out: SB3 shares its features extractor alone.")
    return {
        "n_steps": n_steps,
        "batch_size": values.minibatch_size,
        "n_epochs": values.num_epochs,
        "gae_lambda": values.gae_lambda,
        "clip_range": values.clip_param,
        "ent_coef": values.entropy_coeff,
        "vf_coef": values.vf_loss_coeff,
        **({} if values.vf_clip_range is None else {"clip_range_vf": values.vf_clip_range}),
        **({} if values.normalize_advantages else {"normalize_advantage": False}),
    }, notes


def _sb3_minibatches(values: PPOHyperparams, num_rows: int) -> list[str]:
    """Return notes on what SB3 does otherwise with minibatches of a train batch of so many env steps."""
    size, notes = values.minibatch_size, []
    if values.normalize_advantages and size < num_rows:
        notes.append("SB3 standardises advantages over each minibatch, ours over the whole train batch.")
    if rest := num_rows % size:
        theirs = values.num_epochs * math.ceil(num_rows / size)
        ours = math.ceil(values.num_epochs * num_rows / size)
        notes.append(
            f"Updates per train batch: SB3 {theirs}, the last of each epoch with {rest} env steps, "
            f"ours {ours}, each with {size}."
        )
    return notes


def _sb3_continuous(values: PPOHyperparams) -> str:
    """Return what SB3 does otherwise with actions of a Box; RLlib does as we do where all bounds are finite."""
    note = (
        "If actions are continuous, SB3 clips them to their bounds, over which ours stretch -1 to 1 "
        "(Gymnasium's RescaleAction does that)"
    )
    if values.free_log_std:
        return f"{note}."
    return f"{note}, and its deviation is one for all observations, of which ours has one for each."


def _sb3_optimizer(values: TrainedHyperparams) -> dict[str, Any]:
    """Return the arguments of SB3's policy that make our optimizer."""
    if isinstance(values, PPOHyperparams):
        # Torch's default; SB3's PPO has 1e-5.
        return {"optimizer_kwargs": {"eps": _TORCHS_ADAM["optimizer_epsilon"]}}
    epsilon = {"eps": values.optimizer_epsilon}
    if values.optimizer == "adam":
        return {"optimizer_kwargs": {**epsilon, "betas": (values.adam_beta1, values.adam_beta2)}}
    moving = {"alpha": values.rmsprop_rho, "momentum": values.rmsprop_momentum}
    return {"optimizer_class": _Code("torch.optim.RMSprop"), "optimizer_kwargs": {**epsilon, **moving}}


def _sb3_dqn(values: DQNHyperparams, num_env_steps: int) -> tuple[dict[str, Any], list[str]]:
    lacks = {
        "double_q": values.double_q,
        "dueling": values.dueling,
        "replay " + values.replay: values.replay != "uniform",
        "td_loss mse": values.td_loss == "mse",
    }
    phase = sb3_phase(values)
    target, target_notes = sb3_target(values, phase)
    exploration, exploration_notes = _sb3_exploration(values, num_env_steps)
    return {
        "buffer_size": values.replay_capacity,
        "learning_starts": values.learning_starts,
        "batch_size": values.train_batch_size,
        "train_freq": phase.num_vector_steps,
        "gradient_steps": phase.num_updates,
        "n_steps": values.n_step,
        **target,
        **exploration,
    }, [*_dqn_notes("SB3", lacks | _lacking_in_both(values)), *phase.notes, *target_notes, *exploration_notes]


def _sb3_exploration(values: DQNHyperparams, num_env_steps: int) -> tuple[dict[str, Any], list[str]]:
    final, notes = values.epsilon_final, []
    end = values.epsilon_decay
    if values.epsilon_schedule == "linear" and values.epsilon_unit == "env_step":
        end += values.epsilon_start
        if end > num_env_steps:
            decayed = max(0, num_env_steps - values.epsilon_start)
            final = linear(values.epsilon_initial, values.epsilon_final, values.epsilon_decay, decayed)
    if values.epsilon_start:
        notes.append("epsilon_start is left out: SB3's epsilon falls from the first env step, to the same end.")
    if values.learning_starts and (values.epsilon_initial < 1.0 or values.epsilon_start < values.learning_starts):
        notes.append("SB3's actions are all random until learning_starts, ours as epsilon says.")
    return {
        "exploration_fraction": min(1.0, end / max(1, num_env_steps)),
        "exploration_initial_eps": values.epsilon_initial,
        "exploration_final_eps": final,
    }, notes


def _rllib_ppo(values: PPOHyperparams) -> tuple[dict[str, Any], list[str]]:
    entropy: Any = values.entropy_coeff
    if values.entropy_coeff_final is not None:
        entropy = [[0, values.entropy_coeff], [values.entropy_decay_steps, values.entropy_coeff_final]]
    notes = []
    if values.clip_param_final is not None:
        notes.append("clip_param stays at its first value: RLlib has no schedule for it.")
    if values.normalize_rewards:
        notes.append("normalize_rewards is left out: RLlib has none.")
    if values.vf_clip_range is not None:
        notes.append("vf_clip_range is left out: RLlib has none.")
    if not values.normalize_advantages:
        notes.append("normalize_advantages is left out: RLlib always standardises them.")
    kl = {"kl_coeff": values.kl_coeff, "kl_target": values.kl_target} if values.use_kl_loss else {}
    return {
        "lambda_": values.gae_lambda,
        "clip_param": values.clip_param,
        "vf_clip_param": _NO_CLIPPING if values.vf_clip_param is None else values.vf_clip_param,
        "vf_loss_coeff": values.vf_loss_coeff,
        "entropy_coeff": entropy,
        "use_kl_loss": values.use_kl_loss,
        **kl,
        "train_batch_size_per_learner": values.train_batch_size,
        "minibatch_size": values.minibatch_size,
        "num_epochs": values.num_epochs,
    }, notes


def _rllib_dqn(values: DQNHyperparams) -> tuple[dict[str, Any], list[str]]:
    replay: dict[str, Any] = {"type": "EpisodeReplayBuffer", "capacity": values.replay_capacity}
    if values.replay == "prioritized":
        replay = replay | {
            "type": "PrioritizedEpisodeReplayBuffer",
            "alpha": values.prioritized_alpha,
            "beta": values.prioritized_beta,
        }
    # The default is too little to be missed.
    adds = values.prioritized_epsilon != DQNHyperparams.model_fields["prioritized_epsilon"].default
    lacks = {
        "replay none": values.replay == "none",
        "prioritized_epsilon": values.replay == "prioritized" and adds,
        "optimizer rmsprop": values.optimizer == "rmsprop",
    }
    notes = _dqn_notes("RLlib", lacks | _lacking_in_both(values))
    changed = [name for name, default in _TORCHS_ADAM.items() if getattr(values, name) != default]
    if values.optimizer == "adam" and changed:
        # The new API stack doesn't read adam_epsilon.
        are = "is" if len(changed) == 1 else "are"
        notes.append(f"{', '.join(changed)} {are} left out: RLlib makes Adam with torch's defaults.")
    phase = rllib_phase(values)
    target_update_freq, target_notes = rllib_target(values, phase)
    start, initial = values.epsilon_start, values.epsilon_initial
    decay = max(1, round(values.epsilon_decay))
    return {
        "train_batch_size_per_learner": values.train_batch_size,
        "training_intensity": values.updates_per_env_step * values.train_batch_size,
        "double_q": values.double_q,
        "dueling": values.dueling,
        "n_step": values.n_step,
        "td_error_loss_fn": values.td_loss,
        "tau": values.tau,
        "target_network_update_freq": target_update_freq,
        "num_steps_sampled_before_learning_starts": values.learning_starts,
        "epsilon": [[0, initial], *([[start, initial]] if start else []), [start + decay, values.epsilon_final]],
        "replay_buffer_config": replay,
    }, [*notes, *phase.notes, *target_notes]


def _lacking_in_both(values: DQNHyperparams) -> dict[str, bool]:
    """Return what neither library's DQN has, by its name, with whether the values ask for it."""
    return {
        "target_network false": not values.target_network,
        "the schedule of epsilon": values.epsilon_schedule != "linear" or values.epsilon_unit != "env_step",
        "reward_scale": values.reward_scale != 1.0,
        "updates of the target by episodes": values.target_update_unit == "episode",
    }


def _dqn_notes(library: str, lacks: Mapping[str, bool]) -> list[str]:
    lacking = [name for name, is_wanted in lacks.items() if is_wanted]
    return [f"{library}'s DQN lacks {', '.join(lacking)}."] if lacking else []


def _call(function: str, positional: list[str], arguments: Mapping[str, Any]) -> str:
    parts = [*positional, *(f"{name}={value!r}" for name, value in arguments.items())]
    line = f"{function}({', '.join(parts)})"
    if len(line) <= _FITS and len(parts) <= 3:
        return line
    return f"{function}(\n" + "".join(f"    {part},\n" for part in parts) + ")"
