"""The peer: plain RLlib DQN with the settings of `cartpole-dqn-tuned`, one process, one of RLlib's own buffers."""

from __future__ import annotations

import sys
import time
from typing import Any

import ray
import torch
from ray.rllib.algorithms.dqn import DQNConfig

from policies.hyperparams import DQNHyperparams
from tests.benchmarks import dqn

_BUFFERS = {"uniform": "EpisodeReplayBuffer", "prioritized": "PrioritizedEpisodeReplayBuffer"}


def build_config(env_id: str, hyperparams: DQNHyperparams, buffer: str) -> DQNConfig:
    """RLlib's config of the same work: as many env steps between updates, as many updates of as large batches."""
    replay: dict[str, Any] = {"type": _BUFFERS[buffer], "capacity": hyperparams.replay_capacity}
    if buffer == "prioritized":
        replay |= {"alpha": hyperparams.prioritized_alpha, "beta": hyperparams.prioritized_beta}
    lr: Any = hyperparams.lr
    if hyperparams.lr_final is not None:
        lr = [[0, hyperparams.lr], [hyperparams.lr_decay_steps, hyperparams.lr_final]]
    return (
        DQNConfig()
        .environment(env_id)
        .env_runners(
            num_env_runners=0,
            num_envs_per_env_runner=hyperparams.num_envs,
            gym_env_vectorize_mode="vector_entry_point",
            rollout_fragment_length=max(1, hyperparams.train_freq // hyperparams.num_envs),
        )
        .learners(num_learners=0)
        .training(
            lr=lr,
            gamma=hyperparams.gamma,
            grad_clip=hyperparams.grad_clip,
            train_batch_size_per_learner=hyperparams.train_batch_size,
            # Transitions trained on for each env step sampled.
            training_intensity=hyperparams.updates_per_env_step * hyperparams.train_batch_size,
            double_q=hyperparams.double_q,
            dueling=hyperparams.dueling,
            n_step=hyperparams.n_step,
            tau=hyperparams.tau,
            target_network_update_freq=hyperparams.target_update_interval or hyperparams.train_freq,
            td_error_loss_fn=hyperparams.td_loss,
            replay_buffer_config=replay,
            num_steps_sampled_before_learning_starts=hyperparams.learning_starts,
            epsilon=[(0, hyperparams.epsilon_initial), (int(hyperparams.epsilon_decay), hyperparams.epsilon_final)],
        )
        .rl_module(
            model_config={
                "fcnet_hiddens": list(hyperparams.hidden_sizes),
                "fcnet_activation": hyperparams.activation,
                "head_fcnet_hiddens": [],
            }
        )
        .reporting(min_sample_timesteps_per_iteration=hyperparams.env_steps_per_iteration)
        .debugging(seed=0, log_level="ERROR")
    )


def main(buffer: str, num_env_steps: int) -> None:
    """Train for so many env steps and print how many that were a second, the build apart."""
    spec, hyperparams = dqn.settings()
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="error")
    # Small networks are slower on several threads; ours runs on one too.
    torch.set_num_threads(1)
    algorithm = build_config(spec.env.id, hyperparams, buffer).build_algo()
    started, num_steps = time.perf_counter(), 0
    while num_steps < num_env_steps:
        num_steps = int(algorithm.train()["num_env_steps_sampled_lifetime"])
    print(f"env_steps_per_s={num_steps / (time.perf_counter() - started):.1f}", flush=True)
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
