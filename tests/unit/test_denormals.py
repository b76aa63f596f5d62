"""Denormal numbers count as zero while weights are updated, and nowhere else."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from policies.hyperparams import Algorithm, TrainedHyperparams, make_hyperparams
from policies.networks.denormals import denormals_as_zero
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from policies.packed.optimizers import StackedAdam

TINY = float(np.finfo(np.float32).tiny)
SMALL = {"hidden_sizes": [4], "num_envs": 2, "train_batch_size": 8}
SETTINGS: dict[Algorithm, dict[str, Any]] = {
    "ppo": {**SMALL, "minibatch_size": 4},
    "dqn": {**SMALL, "learning_starts": 0, "train_freq": 8, "env_steps_per_iteration": 16},
}


def is_flushing() -> bool:
    """Whether this thread takes denormal numbers for zero."""
    return float((torch.full((9,), float(TINY)) * 0.5).count_nonzero()) == 0


CAN_FLUSH = torch.set_flush_denormal(False)
can_flush = pytest.mark.skipif(not CAN_FLUSH, reason="this processor always computes denormals")


@can_flush
def test_who_calls_gets_back_what_they_had() -> None:
    assert not is_flushing()
    with denormals_as_zero():
        assert is_flushing()
        with denormals_as_zero():
            assert is_flushing()
        assert is_flushing()
    assert not is_flushing()
    with pytest.raises(KeyError), denormals_as_zero():
        raise KeyError
    assert not is_flushing()
    torch.set_flush_denormal(True)
    try:
        with denormals_as_zero():
            pass
        assert is_flushing()
    finally:
        torch.set_flush_denormal(False)
    assert not is_flushing()


def trained(zeros: AbstractContextManager[None]) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights and moments after a thousand updates of Adam, in the last of which half of the gradients are zero."""
    ones = torch.ones(1, 1)
    draws = torch.Generator().manual_seed(0)
    adam = StackedAdam(
        torch.randn(1, 64, generator=draws), lr=1e-3 * ones, beta1=0.9 * ones.double(), beta2=0.99 * ones.double(),
        epsilon=1e-8 * ones,
    )  # fmt: skip
    with zeros:
        for number in range(1000):
            gradients = torch.randn(1, 64, generator=draws)
            gradients[:, 32:] *= number < 10
            adam.step(gradients)
    return adam.weights, adam.state["exp_avg"]


def test_weights_are_the_same() -> None:
    weights, moments = trained(denormals_as_zero())
    others, slow = trained(nullcontext())
    assert torch.equal(weights, others)
    assert (slow[0, 32:].abs() < TINY).all()
    assert slow[0, 32:].count_nonzero() == 32
    if CAN_FLUSH:
        assert moments[0, 32:].count_nonzero() == 0


@can_flush
@pytest.mark.parametrize("algorithm", SETTINGS)
def test_packs_update_so(algorithm: Algorithm, monkeypatch: pytest.MonkeyPatch) -> None:
    found = list[bool]()
    step = StackedAdam.step

    def watched(self: StackedAdam, gradients: torch.Tensor) -> None:
        found.append(is_flushing())
        step(self, gradients)

    monkeypatch.setattr(StackedAdam, "step", watched)
    hyperparams = cast("TrainedHyperparams", make_hyperparams(algorithm, SETTINGS[algorithm]))
    envs = make_packed_envs("CartPole-v1", {}, 2, kind="vectorised")
    stack = make_stack(hyperparams, envs)
    stack.add(new_member("a", hyperparams, 3, envs.observation_space, envs.action_space), 1)
    stack.train_iteration()
    envs.close()
    assert found
    assert all(found)
    assert not is_flushing()


@can_flush
def test_learners_of_rllib_update_so(monkeypatch: pytest.MonkeyPatch) -> None:
    from ray.rllib.core.learner.torch.torch_learner import TorchLearner

    from policies.rllib.dqn_learner import DQNLearner
    from policies.rllib.ppo_learner import PPOLearner

    found = list[bool]()

    def watched(*_: object, **__: object) -> dict[str, torch.Tensor]:
        found.append(is_flushing())
        return {}

    monkeypatch.setattr(TorchLearner, "update", watched)
    object.__new__(PPOLearner).update(batch=None)
    monkeypatch.setattr(DQNLearner, "hyperparams", SimpleNamespace(lr_final=None, train_batch_size=8))
    monkeypatch.setattr(DQNLearner, "get_optimizer", lambda *_: SimpleNamespace(param_groups=[{"lr": 0.1}]))
    monkeypatch.setattr(DQNLearner, "update_from_transitions", watched)
    monkeypatch.setattr(DQNLearner, "_update_target", watched)
    replay = SimpleNamespace(batches=lambda *_: [SimpleNamespace(indices=None)])
    steps = {"num_env_steps": 8, "num_new_steps": 8, "num_episodes": 0}
    object.__new__(DQNLearner).update_from_replay(cast("Any", replay), 1, **steps)
    assert found == [True] * 3
    assert not is_flushing()
