"""The sweeps whose results are recorded: small ones, which between them go through every way of training and choosing.

Whatever depends on which of two processes is faster is kept from happening: where trials are compared with each other,
one process trains them all (`_ONE_PROCESS`), one after another or as the members of one pack.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Sweep:
    """A sweep to record."""

    name: str
    spec: dict[str, Any]
    """The sweep file."""
    stopped_at: int | None = None
    """Interrupted once every trial has its checkpoint of this iteration, and resumed from there; None: it is not."""

    @property
    def num_trials(self) -> int:
        """Trials it has; known beforehand where it is stopped."""
        return int(self.spec["num_samples"])


_LR = {"lr": {"loguniform": [0.0005, 0.01]}}
_PPO = {"num_envs": 4, "train_batch_size": 256, "minibatch_size": 64, "num_epochs": 2, "hidden_sizes": [16]}
_DQN = {
    "num_envs": 2,
    "env_steps_per_iteration": 200,
    "train_freq": 4,
    "learning_starts": 100,
    "replay_capacity": 600,
    "epsilon_decay": 500,
    "target_update_freq": 100,
    "hidden_sizes": [16, 16],
}
_COMMON = {
    "seed": 11,
    "num_samples": 2,
    "stop": {"num_env_steps": 1500},
    "evaluation": {"every_iterations": 2, "num_episodes": 3},
    # Hashes of checkpoints on the way tell from where on weights differ.
    "checkpoints": {"every_iterations": 2, "keep": 99},
    # What fails is to be seen, not tried again.
    "max_retries": 0,
}
# Only one process with all CPUs fits.
_ONE_PROCESS = {"num_cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1}


def _sweep(
    name: str,
    algorithm: str,
    *,
    env: Any = "CartPole-v1",
    hyperparams: dict[str, Any] | None = None,
    stopped_at: int | None = None,
    **others: Any,
) -> Sweep:
    defaults = {"ppo": _PPO, "dqn": _DQN}.get(algorithm, {})
    space = {} if algorithm == "random" else _LR
    spec = {**_COMMON, "env": env, "algorithm": algorithm, "space": space}
    return Sweep(name, {**spec, "hyperparams": {**defaults, **(hyperparams or {})}, **others}, stopped_at)


_PPO_SPACE = {**_LR, "hidden_sizes": {"choice": [[16], [12]]}, "activation": {"choice": ["tanh", "relu"]}}
_PPO_OTHERS = {key: value for key, value in _PPO.items() if key != "hidden_sizes"}
_TARGETS_AND_REPLAYS = {"target_network": {"grid": [True, False]}, "replay": {"grid": ["uniform", "none"]}}
_PRIORITIZED = {"replay": "prioritized", "n_step": 3, "dueling": True, "optimizer": "rmsprop", "td_loss": "mse"}
_PRIORITIZED_SPACE = {**_LR, "double_q": {"grid": [True, False]}}
_PENDULUM = {"normalize_observations": True, "entropy_coeff": 0.01, "gamma": 0.9, "grad_clip": 0.5}
_PIXELS = {
    **_PPO,
    "conv_filters": [[4, 8, 4], [8, 4, 2]],
    "train_batch_size": 64,
    "minibatch_size": 32,
    "lr_final": 0,
    "lr_decay_steps": 500,
}
# Iterations long enough for an interruption to come before the last.
_LONG_PACKED = {"hyperparams": {"num_epochs": 30, "minibatch_size": 16}, "stop": {"num_env_steps": 256 * 14}}
_LONG_RLLIB = {"hyperparams": {"num_epochs": 15, "minibatch_size": 16}, "stop": {"num_env_steps": 256 * 10}}

_ALL = (
    Sweep(
        "ppo_packed",
        {**_COMMON, "env": "CartPole-v1", "algorithm": "ppo", "engine": "packed", "hyperparams": _PPO_OTHERS,
         "space": _PPO_SPACE, "num_samples": 4},
    ),
    _sweep("ppo_rllib", "ppo", engine="rllib", hyperparams={"use_kl_loss": True, "vf_share_layers": True}),
    _sweep("dqn_packed", "dqn", engine="packed", num_samples=1, hyperparams={"double_q": False, "dueling": False},
           space={**_LR, **_TARGETS_AND_REPLAYS}),
    _sweep("dqn_rllib", "dqn", engine="rllib", num_samples=1, hyperparams={"double_q": False, "dueling": False},
           space={**_LR, **_TARGETS_AND_REPLAYS}, stop={"num_env_steps": 800}),
    _sweep("prioritized_packed", "dqn", engine="packed", num_samples=1, hyperparams=_PRIORITIZED,
           space=_PRIORITIZED_SPACE),
    _sweep("prioritized_rllib", "dqn", engine="rllib", num_samples=1, hyperparams=_PRIORITIZED,
           space=_PRIORITIZED_SPACE, stop={"num_env_steps": 800}),
    _sweep("pendulum_packed", "ppo", engine="packed", env="Pendulum-v1", hyperparams=_PENDULUM),
    _sweep("car_packed", "ppo", engine="packed", env="MountainCarContinuous-v0"),
    _sweep("mountaincar_packed", "dqn", engine="packed", env="MountainCar-v0"),
    _sweep("acrobot_packed", "dqn", engine="packed", env="Acrobot-v1"),
    _sweep("pendulum_rllib", "ppo", engine="rllib", env="Pendulum-v1", hyperparams=_PENDULUM),
    _sweep("pixels_rllib", "ppo", engine="rllib", env={"id": "CartPole-v1", "pixels": True}, hyperparams=_PIXELS,
           stop={"num_env_steps": 128}),
    _sweep("tpe", "ppo", search={"type": "tpe", "num_startup_trials": 2}, num_samples=4,
           resources={"max_concurrent": 1}),
    _sweep("asha", "ppo", scheduler={"type": "asha", "grace_env_steps": 512, "reduction_factor": 2}, num_samples=4,
           resources=_ONE_PROCESS),
    _sweep("median", "dqn", engine="rllib", scheduler={"type": "median", "grace_env_steps": 400}, num_samples=4,
           stop={"num_env_steps": 1200}, resources=_ONE_PROCESS),
    _sweep("hyperband", "ppo", scheduler={"type": "hyperband", "grace_env_steps": 512}, num_samples=4,
           resources=_ONE_PROCESS),
    _sweep("pbt", "ppo", scheduler={"type": "pbt", "perturb_every_env_steps": 512, "quantile_fraction": 0.5},
           resources=_ONE_PROCESS),
    _sweep("seeds_per_point", "ppo", engine="packed", env={"id": "Acrobot-v1", "frame_stack": 2}, seeds_per_point=2),
    _sweep("random_play", "random", num_samples=1, seeds_per_point=2),
    _sweep("stopped_packed", "ppo", engine="packed", stopped_at=2, resources=_ONE_PROCESS, **_LONG_PACKED),
    _sweep("stopped_rllib", "ppo", engine="rllib", stopped_at=2, **_LONG_RLLIB),
)  # fmt: skip
SWEEPS = {sweep.name: sweep for sweep in _ALL}
"""By name."""
