"""Hyperparameters -> RLlib `AlgorithmConfig` on the new API stack (Ray 2.60).

Every field of `policies.hyperparams` is set here exactly once, on the setting that acts: several of RLlib's own names
are accepted and do nothing (`DQNConfig.training(hiddens=...)`), or change others silently (`DefaultModelConfig` shares
PPO's value layers).
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import torch
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.algorithms.dqn import DQNConfig
from ray.rllib.algorithms.dqn.torch.dqn_torch_learner import DQNTorchLearner
from ray.rllib.algorithms.ppo import PPOConfig

from policies.env_runner import ArrayEnvRunner
from policies.hyperparams import DQNHyperparams, Hyperparams, PPOHyperparams

# RLlib resolves an activation by these names (its models/utils.py): a torch.nn class name or one of its own.
RLLIB_ACTIVATIONS = {
    "linear": "linear", "relu": "relu", "tanh": "tanh", "silu": "silu", "elu": "elu", "gelu": "GELU",
}  # fmt: skip

ModelConfig: TypeAlias = dict[str, Any]


class AdamEpsilonDQNLearner(DQNTorchLearner):  # type: ignore[misc]
    """RLlib's DQN learner, whose Adam takes `adam_epsilon`; on the new API stack RLlib ignores it (2.60)."""

    def configure_optimizers_for_module(self, module_id: str, config: Any = None) -> None:
        """Register Adam for a module, with the config's learning rate and epsilon."""
        params = self.get_parameters(self.module[module_id])
        self.register_optimizer(
            module_id=module_id,
            optimizer=torch.optim.Adam(params, eps=config.adam_epsilon),
            params=params,
            lr_or_lr_schedule=config.lr,
        )


def model_config(hyperparams: Hyperparams) -> ModelConfig:
    """RLlib's `model_config` of the network: hidden layers, then one linear layer a head."""
    config: ModelConfig = {
        "fcnet_hiddens": list(hyperparams.hidden_sizes),
        "fcnet_activation": RLLIB_ACTIVATIONS[hyperparams.activation],
        # The heads are one linear layer each: the portable policy counts on it.
        "head_fcnet_hiddens": [],
    }
    if isinstance(hyperparams, PPOHyperparams):
        config["vf_share_layers"] = hyperparams.vf_share_layers
    return config


def build_algorithm_config(
    hyperparams: Hyperparams,
    *,
    env_id: str,
    env_args: dict[str, Any] | None = None,
    seed: int,
    num_env_runners: int = 0,
    num_gpus: float = 0.0,
) -> AlgorithmConfig:
    """The RLlib config of one trial; `.build_algo()` makes the Algorithm.

    Args:
        hyperparams: Validated hyperparameters; their type chooses PPO or DQN.
        env_id: A registered Gymnasium id.
        env_args: Keyword arguments of the environment.
        seed: Seed of weights, exploration and environments.
        num_env_runners: Processes that sample beside the main one; 0: the main process samples.
        num_gpus: GPUs of the learner; 0: the CPU.
    """
    config = _ppo(hyperparams) if isinstance(hyperparams, PPOHyperparams) else _dqn(hyperparams, num_env_runners)
    return (
        config.environment(env_id, env_config=env_args or {}, disable_env_checking=True)
        .env_runners(
            env_runner_cls=ArrayEnvRunner,
            num_env_runners=num_env_runners,
            num_envs_per_env_runner=hyperparams.num_envs,
        )
        .learners(num_learners=0, num_gpus_per_learner=num_gpus)
        .rl_module(model_config=model_config(hyperparams))
        # A greedy evaluation of our own, on fixed seeds, takes the place of RLlib's.
        .evaluation(evaluation_interval=None)
        # An environment that raises ends the trial with its error; RLlib's own restarts have no cap. An env runner
        # that dies is an error too: PPO would go on without it, or without any, and not say so.
        .fault_tolerance(restart_failed_env_runners=False, restart_failed_sub_environments=False)
        # log_sys_usage starts a thread that takes 0.5 s to join at every `stop()`.
        .debugging(seed=seed, log_level="WARN", log_sys_usage=False)
    )


def _ppo(hyperparams: PPOHyperparams) -> AlgorithmConfig:
    return PPOConfig().training(
        lr=hyperparams.lr,
        gamma=hyperparams.gamma,
        grad_clip=hyperparams.grad_clip,
        grad_clip_by="global_norm",
        lambda_=hyperparams.gae_lambda,
        clip_param=hyperparams.clip_param,
        vf_clip_param=math.inf if hyperparams.vf_clip_param is None else hyperparams.vf_clip_param,
        vf_loss_coeff=hyperparams.vf_loss_coeff,
        entropy_coeff=hyperparams.entropy_coeff,
        use_kl_loss=hyperparams.use_kl_loss,
        kl_coeff=hyperparams.kl_coeff,
        kl_target=hyperparams.kl_target,
        train_batch_size_per_learner=hyperparams.train_batch_size,
        minibatch_size=hyperparams.minibatch_size,
        num_epochs=hyperparams.num_epochs,
    )


def _dqn(hyperparams: DQNHyperparams, num_env_runners: int) -> AlgorithmConfig:
    intensity = hyperparams.training_intensity
    if intensity is not None and num_env_runners > 0:
        # RLlib's `calculate_rr_weights` counts the main process as one more that samples, and would train more (2.60).
        intensity *= num_env_runners / (num_env_runners + 1)
    buffer: dict[str, Any] = {"type": "EpisodeReplayBuffer", "capacity": hyperparams.replay_capacity}
    if hyperparams.prioritized_replay:
        buffer = {**buffer, "type": "PrioritizedEpisodeReplayBuffer", "alpha": 0.6, "beta": 0.4}
    epsilon = [(0, hyperparams.epsilon_initial), (hyperparams.epsilon_decay_steps, hyperparams.epsilon_final)]
    config = DQNConfig().training(
        lr=hyperparams.lr,
        gamma=hyperparams.gamma,
        grad_clip=hyperparams.grad_clip,
        grad_clip_by="global_norm",
        train_batch_size_per_learner=hyperparams.train_batch_size,
        training_intensity=intensity,
        double_q=hyperparams.double_q,
        dueling=hyperparams.dueling,
        n_step=hyperparams.n_step,
        adam_epsilon=hyperparams.adam_epsilon,
        target_network_update_freq=hyperparams.target_network_update_freq,
        tau=hyperparams.tau,
        replay_buffer_config=buffer,
        num_steps_sampled_before_learning_starts=hyperparams.learning_starts,
        epsilon=epsilon,
    )
    config.learners(learner_class=AdamEpsilonDQNLearner)
    return config.reporting(min_sample_timesteps_per_iteration=hyperparams.env_steps_per_iteration)
