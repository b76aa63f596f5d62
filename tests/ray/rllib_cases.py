"""What the cases of `test_rllib_config` share: their registry, and ways to look into an Algorithm.

A case is a function that builds an Algorithm and raises AssertionError unless its hyperparameter acts.
"""

from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from torch import nn

from policies.activations import ACTIVATIONS
from policies.hyperparams import Algorithm
from policies.replay import Transitions

MODULE = "default_policy"
Build = Callable[..., Any]
"""An algorithm's name and hyperparameters -> the Algorithm."""
Case = Callable[[Build, Algorithm], None]
# Small, so that a case takes a tenth of a second; a case changes what it is about.
SMALL: dict[str, dict[str, Any]] = {
    "ppo": {"hidden_sizes": (8,), "train_batch_size": 64, "minibatch_size": 32, "num_epochs": 1, "num_envs": 2},
    "dqn": {
        "hidden_sizes": (8,),
        "env_steps_per_iteration": 20,
        "learning_starts": 0,
        "train_batch_size": 8,
        "train_freq": 1,
        "updates_per_env_step": 1.0,
    },
}
CASES: dict[tuple[Algorithm, str], Case] = {}


def reaches(*algorithms: Algorithm, field: str) -> Callable[[Case], Case]:
    """Make a function the case of a field."""

    def add(check: Case) -> Case:
        for algorithm in algorithms:
            assert (algorithm, field) not in CASES
            CASES[algorithm, field] = check
        return check

    return add


# -- what the cases look at


def learner_of(algo: Any) -> Any:
    return algo.learner_group._learner


def module_of(algo: Any) -> Any:
    return learner_of(algo).module[MODULE]


def modules_of(algo: Any) -> tuple[Any, Any]:
    """The network that learns, and the one that acts."""
    return module_of(algo), algo.env_runner.module


def loss_config(algo: Any) -> Any:
    return learner_of(algo).config.get_config_for_module(MODULE)


def linears(module: nn.Module) -> list[nn.Linear]:
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def optimizer_of(algo: Any) -> torch.optim.Optimizer:
    optimizer: torch.optim.Optimizer = learner_of(algo).get_optimizer(MODULE)
    return optimizer


def count_updates(algo: Any) -> list[int]:
    """A list to which each gradient step from now on adds the number of its rows."""
    sizes = []
    learner = learner_of(algo)
    if hasattr(learner, "update_from_transitions"):
        update_one = learner.update_from_transitions

        def counted_rows(rows: Transitions, optimizer: torch.optim.Optimizer) -> Any:
            sizes.append(len(rows.obs))
            return update_one(rows, optimizer)

        learner.update_from_transitions = counted_rows
        return sizes
    update = learner._update

    def counted(batch: Any, *args: Any, **kwargs: Any) -> Any:
        sizes.append(len(batch[MODULE]["obs"]))
        return update(batch, *args, **kwargs)

    learner._update = counted
    return sizes


def sampled_rows(algo: Any, num_iterations: int = 1) -> list[Transitions]:
    """What DQN's loss was computed from, update by update."""
    rows = []
    learner = learner_of(algo)
    update = learner.update_from_transitions

    def spied(batch: Transitions, optimizer: torch.optim.Optimizer) -> Any:
        rows.append(batch)
        return update(batch, optimizer)

    learner.update_from_transitions = spied
    for _ in range(num_iterations):
        algo.train()
    return rows


def env_steps(result: dict[str, Any]) -> int:
    return int(result["env_runners"]["num_env_steps_sampled_lifetime"])


# -- PPO and DQN


@reaches("ppo", "dqn", field="hidden_sizes")
def check_hidden_sizes(build: Build, algorithm: Algorithm) -> None:
    for sizes in ((7,), (12, 5, 9)):
        for module in modules_of(build(algorithm, hidden_sizes=sizes)):
            encoders = [module.encoder]
            if algorithm == "ppo":
                encoders = [module.encoder.actor_encoder]
                if not module.inference_only:
                    encoders.append(module.encoder.critic_encoder)
            for encoder in encoders:
                assert [layer.out_features for layer in linears(encoder)] == list(sizes)
            head = module.pi if algorithm == "ppo" else module.af
            # One linear layer: RLlib would put a hidden layer of its own before DQN's outputs.
            assert [(layer.in_features, layer.out_features) for layer in linears(head)] == [(sizes[-1], 2)]


@reaches("ppo", "dqn", field="activation")
def check_activation(build: Build, algorithm: Algorithm) -> None:
    expected = {"linear": None, "relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU, "elu": nn.ELU, "gelu": nn.GELU}
    assert set(expected) == set(ACTIVATIONS)
    for activation, kind in expected.items():
        for module in modules_of(build(algorithm, hidden_sizes=(8, 6), activation=activation)):
            encoder = module.encoder.actor_encoder if algorithm == "ppo" else module.encoder
            found = [type(layer) for layer in encoder.mlp if not isinstance(layer, nn.Linear)]
            assert found == ([] if kind is None else [kind] * 2), activation
            head = module.pi if algorithm == "ppo" else module.af
            assert type(head) is nn.Linear


@reaches("ppo", "dqn", field="lr")
def check_lr(build: Build, algorithm: Algorithm) -> None:
    algo = build(algorithm, lr=1.7e-3)
    for _ in range(2):
        assert [group["lr"] for group in optimizer_of(algo).param_groups] == [1.7e-3]
        assert isinstance(optimizer_of(algo), torch.optim.Adam)
        algo.train()


@reaches("ppo", field="grad_clip")
def check_grad_clip(build: Build, algorithm: Algorithm) -> None:
    for clip in (None, 0.25):
        learner = learner_of(build(algorithm, grad_clip=clip))
        gradients = {reference: torch.full_like(param, 3.0) for reference, param in learner._params.items()}
        before = torch.sqrt(cast("torch.Tensor", sum((value**2).sum() for value in gradients.values())))
        after = torch.sqrt(sum((value**2).sum() for value in learner.postprocess_gradients(gradients).values()))
        assert float(before) > 10
        assert float(after) == pytest.approx(float(before) if clip is None else clip, rel=1e-3)


@reaches("ppo", "dqn", field="num_envs")
def check_num_envs(build: Build, algorithm: Algorithm) -> None:
    for env_id in ("CartPole-v1", "Acrobot-v1"):  # physics of its own, and a loop over envs
        runner = build(algorithm, env_id, num_envs=5).env_runner
        assert runner.num_envs == runner.env.num_envs == 5
        assert runner.env.observation_space.shape[0] == 5
