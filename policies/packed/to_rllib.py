"""Turn a member of a pack into an RLlib `Algorithm` that can continue training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED_LIFETIME
from ray.rllib.utils.metrics.metrics_logger import MetricsLogger

from policies import random_streams
from policies.errors import CheckpointError
from policies.packed.member import AnyMember
from policies.packed.state import STATE_FOLDER, load_member
from policies.portable.file import read_policy
from policies.portable.network import PolicyNetwork
from policies.rllib.config import build_algorithm_config
from policies.rllib.dqn_algorithm import ReplayDQN
from policies.rllib.restore import check_weights


def algorithm_from_checkpoint(checkpoint: Path, *, num_env_runners: int = 0, num_gpus: float = 0.0) -> Algorithm:
    """Restore a checkpoint of the packed engine as an RLlib Algorithm that can continue training.

    Weights, target networks, observation statistics, the optimizer's moments and the counters are the checkpoint's.
    Random numbers differ from those the pack would have drawn, and a replay memory is empty, and filled before anything
    is learnt.

    Args:
        checkpoint: A checkpoint folder of a trial.
        num_env_runners: The same as for `build_algorithm_config`.
        num_gpus: The same as for `build_algorithm_config`.

    Raises:
        NotFoundError: There is no such checkpoint.
        CheckpointError: It is damaged, or the Algorithm does not hold the checkpoint's weights afterwards.
    """
    saved = read_policy(checkpoint)
    member = load_member(checkpoint / STATE_FOLDER, checkpoint.name)
    return to_algorithm(
        member,
        env_id=saved.env_id,
        env_args=saved.env_args,
        expected=saved.network,
        failure_penalty=member.failure_penalty,
        atari_training=member.atari_training,
        num_env_runners=num_env_runners,
        num_gpus=num_gpus,
    )


def to_algorithm(
    member: AnyMember, *, env_id: str, env_args: dict[str, Any], expected: PolicyNetwork | None = None, **settings: Any
) -> Algorithm:
    """Return a member as an RLlib Algorithm.

    Args:
        member: A member of PPO or DQN whose weights were written back.
        env_id: Its environment.
        env_args: The arguments of the environment.
        expected: The network that the Algorithm has to act with.
        settings: Further arguments of `build_algorithm_config`.

    Raises:
        CheckpointError: The weights are not those of the network the hyperparameters describe, or not the expected
            ones.
    """
    later, _ = random_streams.seeds_after(member.seed, member.num_iterations)
    seed = later % 2**31 if member.num_iterations else member.seed
    algorithm = build_algorithm_config(
        member.hyperparams, env_id=env_id, env_args=env_args, seed=seed, **settings
    ).build_algo()
    try:
        _take_over(algorithm, member)
        if expected is not None:
            check_weights(algorithm, expected)
    except CheckpointError:
        algorithm.stop()
        raise
    except Exception as error:
        algorithm.stop()
        raise CheckpointError(
            f"The state of {member.member_id} cannot be loaded into RLlib's networks: {error!r}.",
            "Use another checkpoint of the trial; training cannot continue from this one.",
        ) from error
    return algorithm


def _take_over(algorithm: Algorithm, member: AnyMember) -> None:
    learner = algorithm.learner_group._learner  # noqa: SLF001 - RLlib has no public way to the local one
    module = learner.module[DEFAULT_MODULE_ID].unwrapped()
    module.load_state_dict({name: torch.as_tensor(value) for name, value in member.weights.items()})
    params = dict(module.named_parameters())
    for _, optimizer in learner.get_optimizers_for_module(DEFAULT_MODULE_ID):
        for name, param in params.items():
            moments = {
                moment: torch.as_tensor(weights[name]).to(param.device)
                for moment, weights in member.moments.items()
                if name in weights
            }
            if moments:
                optimizer.state[param] = {"step": torch.tensor(float(member.num_optimizer_steps)), **moments}
    algorithm.env_runner_group.sync_weights(from_worker_or_learner_group=algorithm.learner_group, inference_only=True)
    algorithm._iteration = member.num_iterations  # noqa: SLF001 - RLlib sets it only from its own checkpoints
    _count_env_steps(algorithm, member.num_env_steps)
    if isinstance(algorithm, ReplayDQN):
        algorithm.num_env_steps, algorithm.num_episodes = member.num_env_steps, member.num_episodes
        algorithm.num_updates, algorithm._due = member.num_updates, member.due  # noqa: SLF001
        learner.target_updates_at = member.target_updates_at
        learner.num_target_updates = member.num_target_updates
        algorithm.learn_after_refilling()
    else:
        # This dict makes its values when they are first asked for, so there are none to loop over yet.
        learner.curr_kl_coeffs_per_module[DEFAULT_MODULE_ID].data.fill_(member.kl_coeff)
        learner.return_statistics = replace(member.return_statistics)


def _count_env_steps(algorithm: Algorithm, num_env_steps: int) -> None:
    """Have the Algorithm continue its count of env steps from this number, in RLlib 2.60's own way."""
    if isinstance(algorithm, ReplayDQN):
        key = (ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED_LIFETIME)
        algorithm.metrics.log_value(key, num_env_steps, reduce="lifetime_sum")
        return
    # Env runners' reports are merged, and nothing can be merged into a logged value, so this acts as such a report.
    reported = MetricsLogger(root=False)
    reported.log_value(NUM_ENV_STEPS_SAMPLED_LIFETIME, num_env_steps, reduce="lifetime_sum", with_throughput=True)
    algorithm.metrics.aggregate([reported.reduce()], key=ENV_RUNNER_RESULTS)
