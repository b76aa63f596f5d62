"""A training phase of a DQN pack is that of RLlib's Learner for every member."""

from typing import Any

import numpy as np
import pytest
from packed_dqn import PHASES, ROUNDING, compare, differences

from policies.activations import ACTIVATIONS
from tests.narrowing import present

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

# (what the members share, what each has of its own)
PACKS: dict[str, tuple[dict[str, Any], list[dict[str, Any]]]] = {
    "relu, double, dueling, hard": ({}, [
        {"target_update_freq": 10},
        {"hidden_sizes": (5,), "lr": 5e-3, "target_update_freq": 20},
        {"hidden_sizes": (7,), "grad_clip": 0.5, "target_update_freq": 500},
        {"activation": "tanh", "grad_clip": 20.0, "optimizer_epsilon": 1e-3, "adam_beta2": 0.99999},
    ]),
    "squared, no target network": ({"double_q": False, "dueling": False, "td_loss": "mse", "target_network": False}, [
        {"activation": "silu", "hidden_sizes": (12, 7)},
        {"activation": "silu", "hidden_sizes": (9, 8), "lr": 2e-3, "grad_clip": 3.0},
        {"activation": "linear", "hidden_sizes": (5, 5), "adam_beta1": 0.5, "adam_beta2": 0.9},
    ]),
    "soft every update": ({"dueling": False, "tau": 0.1}, [
        {"tau": 0.4, "hidden_sizes": (8, 8, 8)},
        {"hidden_sizes": (3, 5, 8), "lr": 1e-2},
        {"tau": 0.01, "hidden_sizes": (4, 2, 7), "activation": "elu"},
    ]),
    "soft at times": ({"double_q": False, "tau": 0.1, "target_update_freq": 5}, [
        {"activation": "gelu"},
        {"activation": "gelu", "hidden_sizes": (6,), "tau": 0.7, "target_update_freq": 9},
    ]),
    "hard, by episodes": ({"double_q": False, "target_update_unit": "episode", "td_loss": "mse"}, [
        {"target_update_freq": 2},
        {"hidden_sizes": (5,), "target_update_freq": 1, "grad_clip": 1.0},
    ]),
    "RMSprop": ({"optimizer": "rmsprop", "lr": 1e-3, "optimizer_epsilon": 1e-5}, [
        {"lr_final": 1e-4, "lr_decay_steps": 200},
        {"hidden_sizes": (6,), "rmsprop_momentum": 0.9, "grad_clip": 0.5},
        {"hidden_sizes": (5,), "rmsprop_momentum": 0.3, "rmsprop_rho": 0.8, "activation": "tanh"},
    ]),
    "prioritized": ({"replay": "prioritized", "td_loss": "mse", "target_update_freq": 10}, [
        {"prioritized_alpha": 1.0, "prioritized_beta": 1.0},
        {"hidden_sizes": (5,), "prioritized_beta": 0.2, "lr": 1e-3, "lr_final": 0.0, "lr_decay_steps": 190},
        {"hidden_sizes": (6,), "prioritized_alpha": 0.8, "prioritized_epsilon": 0.3},
    ]),
    "normalised, n-step": ({"normalize_observations": True, "n_step": 3, "tau": 0.2}, [
        {"gamma": 0.9},
        {"hidden_sizes": (5,), "activation": "tanh", "gamma": 1.0},
    ]),
    "no replay": ({"replay": "none", "train_batch_size": 12}, [{}, {"hidden_sizes": (4,), "lr": 1e-2}]),
}  # fmt: skip


MASKED: dict[str, dict[str, Any]] = {
    "double, dueling": {"target_update_freq": 10},
    "plain": {"double_q": False, "dueling": False, "target_network": False, "normalize_observations": True},
    "n-step": {"double_q": False, "n_step": 3, "tau": 0.2},
}


@pytest.mark.parametrize("name", MASKED)
def test_a_mask_is_in_the_targets_as_in_rllibs_learner(name: str) -> None:
    members = [MASKED[name], {**MASKED[name], "hidden_sizes": (5,)}]
    pairs, _ = compare(members, env_id="TestForbidding-v0")
    for ours, theirs in pairs:
        for what, value in differences(ours, present(theirs)).items():
            assert value < ROUNDING, what
        # What is forbidden has no value.
        assert np.abs(np.concatenate(ours.td_errors)).max() < 100


def test_all_activations_and_both_of_each_kind_have_a_pack() -> None:
    members = [{**shared, **values} for shared, several in PACKS.values() for values in several]
    assert {values.get("activation", "relu") for values in members} == set(ACTIVATIONS)
    for name, default in (("double_q", True), ("dueling", True), ("td_loss", "huber"), ("target_network", True)):
        assert len({values.get(name, default) for values in members}) == 2, name


@pytest.mark.parametrize("name", PACKS)
def test_training_phases_are_rllibs_for_every_member(name: str) -> None:
    shared, members = PACKS[name]
    pairs, stack = compare([{**shared, **values} for values in members])
    # Whatever their activations: one of these has layers of another size.
    assert len(stack._groups) == (2 if name == "squared, no target network" else 1)
    for ours, theirs in pairs:
        for what, value in differences(ours, present(theirs)).items():
            assert value < ROUNDING, what
        assert ours.num_target_updates == present(theirs).num_target_updates
        assert len(ours.losses) == sum(num_updates for num_updates, *_ in PHASES)
        # Both sides of Huber's loss.
        errors = np.abs(np.concatenate(ours.td_errors))
        assert errors.max() > 1
        assert errors.min() < 1
