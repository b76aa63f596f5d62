"""The cases of PPO's hyperparameters in a pack: each changes an iteration as it should, or fails.

Most compare a pack of two members, one with the hyperparameter changed, with RLlib's Learner: see `packed_rllib`. Those
that say what a batch is, and in which rows updates see it, are in `packed_ppo_batches`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from packed_rllib import ROUNDING, ROWS, Learned, Sampled, compare, differences, make_stack

from policies.activations import ACTIVATIONS
from policies.packed.networks import with_ones
from tests.narrowing import present

Case = Callable[[], object]
CASES: dict[str, Case] = {}
FIRST_LAYER = "encoder.actor_encoder.mlp.0.weight"


def arrives(check: Case) -> Case:
    """Make a function the case of the field that its name says."""
    field = check.__name__.removeprefix("check_")
    assert field not in CASES
    CASES[field] = check
    return check


def updates(shared: dict[str, Any] | None = None, **values: Any) -> tuple[Learned, Learned, Sampled]:
    """Two updates of two members, the second one with these values, which are those of RLlib's Learner.

    Returns:
        What became of each, and what was sampled.
    """
    shared = shared or {}
    pairs, _, sampled = compare("CartPole-v1", [shared, {**shared, **values}], seeds=[3, 3], num_epochs=2)
    for ours, theirs in pairs:
        for what, value in differences(ours, theirs).items():
            assert value < ROUNDING, what
    (plain, _), (changed, _) = pairs
    return plain, changed, sampled


def assert_other_gradients(plain: Learned, changed: Learned, at_least: float = 1e-3) -> None:
    scale = max(np.abs(value).max() for value in plain.last_gradients.values())
    found = max(np.abs(changed.last_gradients[name] - value).max() for name, value in plain.last_gradients.items())
    assert found > at_least * scale


# -- the network


@arrives
def check_hidden_sizes() -> None:
    for sizes in ((7,), (5, 9)):
        pairs, stack, _ = compare("CartPole-v1", [{"hidden_sizes": (8,) * len(sizes)}, {"hidden_sizes": sizes}])
        assert len(stack._groups) == (1 if len(sizes) == 1 else 2)
        for ours, theirs in pairs:
            assert max(differences(ours, theirs).values()) < ROUNDING
        layers = [
            weight.shape[0] for name, weight in pairs[1][0].weights.items() if "actor" in name and "weight" in name
        ]
        assert tuple(layers) == sizes


@arrives
def check_activation() -> None:
    pairs, stack, _ = compare("CartPole-v1", [{"activation": name} for name in ACTIVATIONS], seeds=[3] * 6)
    # Together, each with its own.
    assert len(stack._groups) == 1
    for ours, theirs in pairs:
        assert max(differences(ours, theirs).values()) < ROUNDING
    assert len({ours.losses["vf_loss"] for ours, _ in pairs}) == 6


@arrives
def check_initializer() -> None:
    names = ("torch", "he_uniform", "orthogonal")
    stack = make_stack("CartPole-v1", [{"initializer": name} for name in names], seeds=[3] * 3)
    torchs, he_uniform, orthogonal = (member.weights for member in stack.members)
    matrix, bias = FIRST_LAYER, FIRST_LAYER.replace("weight", "bias")
    assert np.abs(torchs[matrix]).max() <= 0.5  # 1 / sqrt(4 inputs)
    assert np.abs(torchs[bias]).max() > 0
    assert 0.9 * np.sqrt(6 / 4) < np.abs(he_uniform[matrix]).max() <= np.sqrt(6 / 4)
    np.testing.assert_allclose(orthogonal[matrix].T @ orthogonal[matrix], (5 / 3) ** 2 * np.eye(4), atol=1e-5)
    assert not he_uniform[bias].any()
    assert not orthogonal[bias].any()
    stack.envs.close()


@arrives
def check_conv_filters() -> None:
    """Members of other filters are in other groups; that each learns as in RLlib is in `test_packed_images`."""
    stack = make_stack("TestShades-v0", [{"conv_filters": ((5, 4, 2),)}, {"conv_filters": ((3, 2, 1), (4, 3, 2))}])
    stack.train_iteration()
    assert [len(group.members) for group in stack._groups] == [1, 1]
    for name, shapes in (("m0", [(5, 2, 4, 4)]), ("m1", [(3, 2, 2, 2), (4, 3, 3, 3)])):
        weights = stack.member(name).weights
        for encoder in ("actor_encoder", "critic_encoder"):
            kernels = {key: value.shape for key, value in weights.items() if f"{encoder}.conv" in key}
            assert [shape for key, shape in kernels.items() if key.endswith("weight")] == shapes
    stack.envs.close()


@arrives
def check_free_log_std() -> None:
    """A free one learns as RLlib's; its rows of the weights stay 0, where a member beside it moves its own."""
    pairs, stack, _ = compare("Pendulum-v1", [{"entropy_coeff": 0.3}, {"entropy_coeff": 0.3, "free_log_std": True}])
    assert len(stack._groups) == 1
    for ours, theirs in pairs:
        assert max(differences(ours, theirs).values()) < ROUNDING
    (plain, _), (free, _) = pairs
    assert np.abs(plain.last_gradients["pi.weight"][1]).max() > 1e-4
    for values in (free.last_gradients, free.weights, *free.moments.values()):
        np.testing.assert_array_equal(values["pi.weight"][1], 0.0)
    assert abs(free.last_gradients["pi.bias"][1]) > 1e-3


@arrives
def check_vf_share_layers() -> None:
    _, changed, _ = updates(shared={"vf_share_layers": True}, vf_loss_coeff=2.0)
    assert {name.split(".")[1] for name in changed.weights if name.startswith("encoder")} == {"encoder"}
    plain, _, _ = updates()
    assert {name.split(".")[1] for name in plain.weights if name.startswith("encoder")} == {
        "actor_encoder",
        "critic_encoder",
    }


@arrives
def check_normalize_observations() -> None:
    # compare() trains one iteration before the one it looks at.
    plain, _, sampled = updates(shared={"normalize_observations": True})
    assert int(plain.weights["obs_count"]) == 2 * ROWS
    ((_, batch),) = sampled.groups
    seen, raw = batch.observations[0], sampled.observations[0]
    assert np.abs(seen).max(axis=0).min() > 1.0
    assert np.abs(raw).max(axis=0).min() < 0.5
    # By the statistics of the rows before, which are about those of these.
    np.testing.assert_allclose(seen.std(axis=0), 1.0, atol=0.7)


# -- the optimizer


@arrives
def check_lr() -> None:
    """Adam's first step moves each weight by its learning rate."""
    for lr in (1e-4, 3e-2):
        stack = make_stack("CartPole-v1", [{}, {"lr": lr}])
        before = {name: value.copy() for name, value in stack.members[1].weights.items()}
        stack.train_iteration()
        moved = [np.abs(value - before[name]).max() for name, value in stack.member("m1").weights.items()]
        assert max(moved) == pytest.approx(lr, rel=1e-2)
        stack.envs.close()


@arrives
def check_lr_final() -> None:
    """The value at the env steps so far, this iteration's among them."""
    stack = make_stack("CartPole-v1", [{}, {"lr": 4e-3, "lr_final": 1e-3, "lr_decay_steps": 150}])
    for num_env_steps in (ROWS, 2 * ROWS, 3 * ROWS):
        share = min(1.0, num_env_steps / 150)
        assert stack.train_iteration()["m1"].learner["lr"] == pytest.approx(4e-3 - share * 3e-3, rel=1e-5)
    stack.envs.close()
    _, changed, _ = updates(lr=4e-3, lr_final=1e-3, lr_decay_steps=150)
    assert changed.losses["lr"] == pytest.approx(4e-3 - 128 / 150 * 3e-3, rel=1e-5)


@arrives
def check_lr_decay_steps() -> None:
    values: dict[str, Any] = {"lr": 4e-3, "lr_final": 0.0, "lr_decay_steps": 2 * ROWS}
    stack = make_stack("CartPole-v1", [{}, values])
    stack.train_iteration()
    before = {name: value.copy() for name, value in stack.member("m1").weights.items()}
    stack.train_iteration()
    for name, value in stack.member("m1").weights.items():
        np.testing.assert_array_equal(value, before[name])
    stack.envs.close()
    _, changed, _ = updates(**{**values, "lr_decay_steps": 4 * ROWS})
    assert changed.losses["lr"] == pytest.approx(2e-3)


@arrives
def check_grad_clip() -> None:
    plain, changed, _ = updates(grad_clip=0.25)
    norms = [np.sqrt(sum((g**2).sum() for g in found.last_gradients.values())) for found in (plain, changed)]
    assert norms[0] > 1
    assert norms[1] == pytest.approx(0.25, rel=1e-4)
    assert changed.losses["gradient_norm"] > 1
    # The member beside it, whose gradient is not clipped, does not report what was computed for this one.
    assert "gradient_norm" not in plain.losses


# -- the loss


@arrives
def check_clip_param() -> None:
    plain, changed, _ = updates(clip_param=0.01)
    assert_other_gradients(plain, changed)
    assert changed.losses["policy_loss"] > plain.losses["policy_loss"]


@arrives
def check_clip_param_final() -> None:
    """The way is gone before the phase that is looked at: the clip is that of a member that had it from the first."""
    _, there, _ = updates(clip_param=0.01)
    plain, moved, _ = updates(clip_param=0.5, clip_param_final=0.01, clip_decay_steps=2 * ROWS)
    assert_other_gradients(plain, moved)
    assert moved.losses == there.losses


@arrives
def check_clip_decay_steps() -> None:
    """Half of the way is gone."""
    _, there, _ = updates(clip_param=0.01)
    _, moved, _ = updates(clip_param=0.02, clip_param_final=0.0, clip_decay_steps=4 * ROWS)
    assert moved.losses == there.losses


@arrives
def check_vf_clip_param() -> None:
    plain, changed, _ = updates(vf_clip_param=2.5)
    assert_other_gradients(plain, changed)
    assert changed.losses["vf_loss"] <= 2.5 < plain.losses["vf_loss"]


@arrives
def check_vf_clip_range() -> None:
    plain, changed, sampled = updates(vf_clip_range=0.01)
    assert_other_gradients(plain, changed)
    assert changed.losses["vf_loss"] > plain.losses["vf_loss"]
    ((group, batch),) = sampled.groups
    values = group.values(torch.from_numpy(with_ones(batch.observations)))
    # This group has the weights that sampled, not those that were moved since.
    np.testing.assert_allclose(present(batch.values), values.detach().numpy(), rtol=1e-5, atol=1e-6)
    # The rows of packs with one env each do not lie in one piece.
    updates(shared={"num_envs": 1}, vf_clip_range=0.01)
    # Nothing is kept where no member has a range.
    _, _, sampled = updates()
    assert sampled.groups[0][1].values is None


@arrives
def check_vf_loss_coeff() -> None:
    plain, changed, _ = updates(vf_loss_coeff=2.0)
    assert_other_gradients(plain, changed)
    for found, coefficient in ((plain, 0.5), (changed, 2.0)):
        parts = found.losses["policy_loss"] + coefficient * found.losses["vf_loss"]
        assert found.losses["total_loss"] == pytest.approx(parts, rel=1e-5)


def assert_entropy_weight(found: Learned, weight: float) -> None:
    losses = found.losses
    parts = losses["policy_loss"] + 0.5 * losses["vf_loss"] - weight * losses["entropy"]
    assert losses["total_loss"] == pytest.approx(parts, rel=1e-5)


@arrives
def check_entropy_coeff() -> None:
    plain, changed, _ = updates(entropy_coeff=5.0)
    assert_other_gradients(plain, changed)
    assert_entropy_weight(plain, 0.0)
    assert_entropy_weight(changed, 5.0)


@arrives
def check_entropy_coeff_final() -> None:
    values: dict[str, Any] = {"entropy_coeff": 5.0, "entropy_coeff_final": 3.0, "entropy_decay_steps": 2 * ROWS}
    _, changed, _ = updates(**values)
    assert_entropy_weight(changed, 3.0)


@arrives
def check_entropy_decay_steps() -> None:
    values: dict[str, Any] = {"entropy_coeff": 5.0, "entropy_coeff_final": 1.0, "entropy_decay_steps": 4 * ROWS}
    _, changed, _ = updates(**values)
    assert_entropy_weight(changed, 3.0)


@arrives
def check_use_kl_loss() -> None:
    plain, changed, _ = updates(shared={"use_kl_loss": True, "kl_target": 1e3}, kl_coeff=40.0)
    assert_other_gradients(plain, changed)
    for found, first in ((plain, 0.2), (changed, 40.0)):
        losses = found.losses
        # Halved after the iteration before, for the divergence is far below the target.
        parts = losses["policy_loss"] + 0.5 * losses["vf_loss"] + first / 2 * losses["kl"]
        assert losses["total_loss"] == pytest.approx(parts, rel=1e-5)
        assert losses["kl"] > 0
        assert found.kl_coeff == pytest.approx(first / 4)
    plain, _, _ = updates()
    assert "kl" not in plain.losses


@arrives
def check_kl_coeff() -> None:
    stack = make_stack("CartPole-v1", [{"use_kl_loss": True}, {"use_kl_loss": True, "kl_coeff": 0.7}])
    assert [member.kl_coeff for member in stack.members] == [0.2, 0.7]
    stack.envs.close()
    plain, changed, _ = updates(shared={"use_kl_loss": True}, kl_coeff=40.0)
    assert_other_gradients(plain, changed)


@arrives
def check_kl_target() -> None:
    for target, factor in ((1e-6, 1.5), (1e3, 0.5)):
        base = {"use_kl_loss": True, "lr": 1e-2, "num_epochs": 4}
        stack = make_stack("CartPole-v1", [base, {**base, "kl_target": target}])
        for number in (1, 2):
            stack.train_iteration()
            assert stack.member("m1").kl_coeff == pytest.approx(0.2 * factor**number)
        stack.envs.close()
    # As RLlib's Learner does it, of what the last update has found.
    _, changed, _ = updates(shared={"use_kl_loss": True}, kl_target=1e-9)
    assert changed.kl_coeff >= 0.2 * 1.5
