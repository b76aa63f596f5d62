"""Turn hyperparameters into an RLlib `AlgorithmConfig` on the new API stack (Ray 2.60).

Every field of `policies.hyperparams` is set here exactly once, on the setting that has an effect: several of RLlib's
own names are accepted and do nothing (`DQNConfig.training(hiddens=...)`), or change others silently
(`DefaultModelConfig` shares PPO's value layers).
"""

from __future__ import annotations

import math
from typing import Any

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.algorithms.ppo import PPOConfig

from policies.envs.make import ALLOWED_MODULES, ATARI_TRAINING, FAILURE_PENALTY, MODULE_FOLDERS
from policies.envs.modules import allowed_modules, module_folders
from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams
from policies.networks.rl_modules import module_spec
from policies.rllib.dqn_algorithm import ReplayDQNConfig
from policies.rllib.dqn_learner import DQNLearner
from policies.rllib.env_runner import ArrayEnvRunner
from policies.rllib.ppo_learner import CLIP_SCHEDULE, NORMALIZE_REWARDS, RAW_ADVANTAGES, VF_CLIP_RANGE, PPOLearner


def build_algorithm_config(
    hyperparams: TrainedHyperparams,
    *,
    env_id: str,
    env_args: dict[str, Any] | None = None,
    seed: int,
    num_env_runners: int = 0,
    num_gpus: float = 0.0,
    failure_penalty: float | None = None,
    atari_training: dict[str, bool] | None = None,
    rl_module: str | None = None,
) -> AlgorithmConfig:
    """The RLlib config of one trial; `.build_algo()` makes the Algorithm.

    Args:
        hyperparams: Validated hyperparameters; their type chooses PPO or DQN.
        env_id: A registered Gymnasium id.
        env_args: Keyword arguments of the environment.
        seed: Seed of weights, exploration and environments.
        num_env_runners: The number of processes that sample; 0: the main process samples.
        num_gpus: GPUs of the learner; 0: it runs on the CPU.
        failure_penalty: Reward of steps that end by failure, which the learner gets but returns leave out; None: the
            env's own reward.
        atari_training: The arguments of `AtariTraining`, which the learner alone sees; None: the games as they are.
        rl_module: `module:Class` of an RLModule of the user's own, in an allowed module; None: ours.
    """
    config = _ppo(hyperparams) if isinstance(hyperparams, PPOHyperparams) else _dqn(hyperparams)
    env_config = dict(env_args or {})
    if failure_penalty is not None:
        env_config[FAILURE_PENALTY] = failure_penalty
    if atari_training is not None:
        env_config[ATARI_TRAINING] = atari_training
    if modules := allowed_modules():
        # Env runners in processes of their own do not have the allowed modules yet, nor their places in a user's Ray.
        env_config[ALLOWED_MODULES], env_config[MODULE_FOLDERS] = modules, module_folders()
    return (
        config.environment(env_id, env_config=env_config, disable_env_checking=True)
        .env_runners(
            env_runner_cls=ArrayEnvRunner,
            num_env_runners=num_env_runners,
            num_envs_per_env_runner=hyperparams.num_envs,
            # RLlib drops what an env runner samples for longer than a minute, and goes on without it. How long an
            # iteration may take is watched from outside.
            sample_timeout_s=None,
        )
        .learners(num_learners=0, num_gpus_per_learner=num_gpus)
        .rl_module(rl_module_spec=module_spec(hyperparams, rl_module))
        # Trials evaluate greedily on fixed seeds themselves, in place of RLlib's evaluation.
        .evaluation(evaluation_interval=None)
        # An environment that raises an error ends the trial with it; RLlib would restart it without a limit. An env
        # runner that dies is an error too: PPO would silently continue without it, or without any.
        .fault_tolerance(restart_failed_env_runners=False, restart_failed_sub_environments=False)
        # log_sys_usage starts a thread that takes 0.5 s to join at every `stop()`.
        .debugging(seed=seed, log_level="WARN", log_sys_usage=False)
    )


def _schedule(value: float, final: float | None, num_env_steps: int | None) -> float | list[list[float]]:
    """Return `policies.schedules.linear` in RLlib's form."""
    if final is None or num_env_steps is None:
        return value
    return [[0, value], [num_env_steps, final]]


def _ppo(hyperparams: PPOHyperparams) -> AlgorithmConfig:
    entropy_coeff = _schedule(
        hyperparams.entropy_coeff, hyperparams.entropy_coeff_final, hyperparams.entropy_decay_steps
    )
    config = PPOConfig().training(
        lr=_schedule(hyperparams.lr, hyperparams.lr_final, hyperparams.lr_decay_steps),
        gamma=hyperparams.gamma,
        grad_clip=hyperparams.grad_clip,
        grad_clip_by="global_norm",
        lambda_=hyperparams.gae_lambda,
        clip_param=hyperparams.clip_param,
        vf_clip_param=math.inf if hyperparams.vf_clip_param is None else hyperparams.vf_clip_param,
        vf_loss_coeff=hyperparams.vf_loss_coeff,
        entropy_coeff=entropy_coeff,
        use_kl_loss=hyperparams.use_kl_loss,
        kl_coeff=hyperparams.kl_coeff,
        kl_target=hyperparams.kl_target,
        train_batch_size_per_learner=hyperparams.train_batch_size,
        minibatch_size=hyperparams.minibatch_size,
        num_epochs=hyperparams.num_epochs,
    )
    # What RLlib has no settings for.
    own: dict[str, Any] = {}
    if hyperparams.clip_param_final is not None:
        own[CLIP_SCHEDULE] = (hyperparams.clip_param_final, hyperparams.clip_decay_steps)
    if hyperparams.normalize_rewards:
        own[NORMALIZE_REWARDS] = True
    if not hyperparams.normalize_advantages:
        own[RAW_ADVANTAGES] = True
    if hyperparams.vf_clip_range is not None:
        own[VF_CLIP_RANGE] = hyperparams.vf_clip_range
    if own:
        config.training(learner_config_dict=own)
    return config.learners(learner_class=PPOLearner)


def _dqn(hyperparams: DQNHyperparams) -> AlgorithmConfig:
    config = ReplayDQNConfig()
    config.hyperparams = hyperparams
    config.training(
        lr=hyperparams.lr,
        gamma=hyperparams.gamma,
        train_batch_size_per_learner=hyperparams.train_batch_size,
        double_q=hyperparams.double_q,
        dueling=hyperparams.dueling,
        # The n-step sums are made when sampling: see policies/replay.py.
        n_step=1,
    )
    config.learners(learner_class=DQNLearner)
    # One training step is one iteration.
    return config.reporting(min_sample_timesteps_per_iteration=0, min_train_timesteps_per_iteration=0)
