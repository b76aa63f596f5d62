"""One update of a pack is RLlib's Learner's for every member; advantages and first weights are RLlib's too.

What may differ is `packed_rllib.ROUNDING`.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from packed_rllib import MODULE, ROUNDING, PPOMember, compare, differences, episodes_of, learner_of, make_stack, sample

from policies.activations import ACTIVATIONS
from policies.packed.ppo import stack as ppo_stack
from tests.narrowing import present

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

# (env, what the members share, what each has of its own)
PACKS: dict[str, tuple[str, dict[str, Any], list[dict[str, Any]]]] = {
    "tanh": ("CartPole-v1", {}, [
        {},
        {"hidden_sizes": (5,), "clip_param": 0.03, "entropy_coeff": 0.1, "lr": 1e-3},
        {"hidden_sizes": (7,), "vf_clip_param": 3.0, "grad_clip": 0.5, "vf_loss_coeff": 1.5},
        {"hidden_sizes": (6,), "vf_clip_range": 0.02, "normalize_advantages": False},
        {"vf_clip_range": 0.1, "vf_clip_param": 30.0},
    ]),
    "relu, shared layers, KL": ("CartPole-v1", {"activation": "relu", "vf_share_layers": True, "use_kl_loss": True}, [
        {"kl_coeff": 0.7, "kl_target": 1e-4},
        {"hidden_sizes": (6,), "kl_coeff": 0.0, "entropy_coeff": 0.02},
        {"hidden_sizes": (5,), "kl_coeff": 2.0, "kl_target": 0.5, "clip_param": 0.05, "grad_clip": 10.0,
         "vf_clip_range": 1e-3},
    ]),
    "silu, normalised, schedules": (
        "CartPole-v1", {"activation": "silu", "normalize_observations": True, "hidden_sizes": (12, 7)}, [
        {"lr": 1e-3, "lr_final": 0.0, "lr_decay_steps": 500},
        {"hidden_sizes": (9, 8), "entropy_coeff": 0.3, "entropy_coeff_final": 0.1, "entropy_decay_steps": 100},
    ]),
    "elu, three layers, three actions": ("Acrobot-v1", {"activation": "elu", "hidden_sizes": (8, 8, 8)}, [
        {"grad_clip": 0.1},
        {"hidden_sizes": (3, 5, 8), "clip_param": 0.05, "entropy_coeff": 0.05},
        {"hidden_sizes": (4, 2, 7), "vf_clip_param": 0.3, "gamma": 0.5, "gae_lambda": 0.3},
    ]),
    "gelu, gaussian": ("Pendulum-v1", {"activation": "gelu"}, [
        {"vf_clip_param": 2000.0, "clip_param": 0.05},
        {"hidden_sizes": (5,), "entropy_coeff": 0.2, "grad_clip": 2.0, "vf_clip_range": 0.05},
        {"hidden_sizes": (6,), "normalize_advantages": False, "vf_clip_param": 3000.0, "vf_clip_range": 0.1},
        {"hidden_sizes": (7,), "free_log_std": True, "entropy_coeff": 0.3, "grad_clip": 0.5},
    ]),
    "linear, gaussian, shared layers, normalised": (
        "Pendulum-v1", {"activation": "linear", "vf_share_layers": True, "normalize_observations": True}, [
        {"entropy_coeff": 0.1},
        {"hidden_sizes": (6,), "clip_param": 0.05, "lr": 1e-3, "lr_final": 1e-4, "lr_decay_steps": 1000},
        {"hidden_sizes": (5,), "free_log_std": True, "grad_clip": 1.0},
    ]),
    "tanh, gaussian, KL": ("Pendulum-v1", {"use_kl_loss": True}, [
        {"kl_target": 1e-4, "grad_clip": 0.3},
        {"hidden_sizes": (4,), "free_log_std": True, "initializer": "orthogonal"},
        {"hidden_sizes": (3,), "kl_coeff": 1.5},
    ]),
    "several choices": ("TestReply-v0", {"entropy_coeff": 0.1}, [
        {"clip_param": 0.05}, {"hidden_sizes": (5,), "grad_clip": 0.3},
    ]),
    "several choices, shared layers, KL": ("TestReply-v0", {"vf_share_layers": True, "use_kl_loss": True}, [
        {"kl_coeff": 1.5, "entropy_coeff": 0.05}, {"hidden_sizes": (5,), "kl_target": 1e-4},
    ]),
    "masked, KL, normalised": (
        "TestForbidding-v0", {"use_kl_loss": True, "normalize_observations": True, "entropy_coeff": 0.1}, [
        {"kl_coeff": 1.5}, {"hidden_sizes": (5,), "clip_param": 0.05, "grad_clip": 0.3},
    ]),
    "several choices, masked, shared layers": ("TestForbiddingTwo-v0", {"vf_share_layers": True}, [
        {"entropy_coeff": 0.1}, {"hidden_sizes": (5,), "clip_param": 0.05},
    ]),
}  # fmt: skip


def test_all_activations_have_a_pack() -> None:
    assert {shared.get("activation", "tanh") for _, shared, _ in PACKS.values()} == set(ACTIVATIONS)


@pytest.mark.parametrize("num_updates", [1, 3])
@pytest.mark.parametrize("name", PACKS)
def test_an_update_is_rllibs_for_every_member(name: str, num_updates: int) -> None:
    env_id, shared, members = PACKS[name]
    pairs, stack, _ = compare(env_id, [{**shared, **values} for values in members], num_epochs=num_updates)
    # All in one tensor program.
    assert len(stack._groups) == 1
    for ours, theirs in pairs:
        for what, value in differences(ours, theirs).items():
            assert value < ROUNDING, what


# -- advantages


def rllib_advantages(
    member: PPOMember, env_id: str, episodes: Sequence[Any]
) -> list[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]:
    """(value targets, advantages before they are standardised, values) of each episode, from the Learner's pipeline.

    RLlib standardises over the rows it adds, one an episode, as well: what it hands to the loss is another linear
    function of the same advantages. So these are compared before that.
    """
    from ray.rllib.core.learner.training_data import TrainingData

    from policies.packed.to_rllib import to_algorithm

    algorithm = to_algorithm(member, env_id=env_id, env_args={})
    learner = learner_of(algorithm)
    lengths = [len(episode) for episode in episodes]  # RLlib makes them longer
    batch = learner._make_batch_if_necessary(TrainingData(episodes=episodes))[MODULE]
    with torch.no_grad():
        values = learner.module[MODULE].unwrapped().compute_values(batch).numpy()
    targets, learnt = np.asarray(batch["value_targets"]), np.asarray(batch["advantages"])
    raw = targets - values
    if member.hyperparams.normalize_advantages:
        np.testing.assert_allclose(learnt, (raw - raw.mean()) / raw.std(), atol=1e-4)
    else:
        np.testing.assert_array_equal(learnt, raw)
    assert ("vf_preds" in batch) == (member.hyperparams.vf_clip_range is not None)
    np.testing.assert_array_equal(batch.get("vf_preds", values), values)
    found, start = [], 0
    for length in lengths:
        stop = start + length
        found.append((targets[start:stop], raw[start:stop], values[start:stop]))
        assert not batch["loss_mask"][stop]
        start = stop + 1
    assert start == len(targets)
    algorithm.stop()
    return found


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_advantages_and_value_targets_are_rllibs(monkeypatch: pytest.MonkeyPatch, env_id: str) -> None:
    """Of episodes that end, are cut by the time limit and are cut by the fragment, in one fragment."""
    monkeypatch.setattr(ppo_stack, "standardise", lambda advantages: advantages)
    members = [
        {"gamma": gamma, "gae_lambda": gae_lambda, "hidden_sizes": (size,), "normalize_observations": True}
        for gamma, gae_lambda, size in ((0.99, 0.95, 8), (0.8, 0.0, 5), (0.9, 1.0, 7))
    ]
    members[1] |= {"vf_clip_range": 0.2}
    members[2] |= {"normalize_advantages": False}
    limit = 12 if env_id == "CartPole-v1" else 7
    stack = make_stack(
        env_id, [{**values, "train_batch_size": 160} for values in members], {"max_episode_steps": limit}
    )
    stack.train_iteration()
    sampled = sample(stack)
    fragment, num_envs = sampled.fragment, stack.envs.num_envs
    assert fragment.cuts
    assert not fragment.ended[-1].all()
    if env_id == "CartPole-v1":
        assert fragment.terminated.any(axis=0).sum() >= len(members)
    ((group, batch),) = sampled.groups
    for index, member in enumerate(group.members):
        rows = range(index * num_envs, (index + 1) * num_envs)
        # What a terminated episode ended in must not count: RLlib is given one observation, the pack never sees any.
        episodes = [episodes_of(fragment, row, env_id, final=fragment.last[row] * 0 + 0.01) for row in rows]
        expected = rllib_advantages(stack.member(member.member_id), env_id, [e for some in episodes for e in some])
        chunks = iter(expected)
        for place, some in enumerate(episodes):
            parts = [np.concatenate(found) for found in zip(*(next(chunks) for _ in some), strict=True)]
            found = (batch.value_targets, batch.advantages, present(batch.values))
            for ours, theirs in zip(found, parts, strict=True):
                own = ours[index].reshape(-1, num_envs)[:, place]
                np.testing.assert_allclose(own, theirs, rtol=1e-5, atol=1e-5 * np.abs(theirs).max())
    stack.envs.close()


# -- first weights


@pytest.mark.parametrize("values", [
    {},
    {"vf_share_layers": True, "initializer": "orthogonal", "activation": "relu"},
    {"hidden_sizes": (9, 4), "initializer": "he_uniform", "normalize_observations": True},
])  # fmt: skip
@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_first_weights_are_those_of_rllibs_learner_with_the_seed(env_id: str, values: dict[str, Any]) -> None:
    from policies.rllib.config import build_algorithm_config

    stack = make_stack(env_id, [values], seeds=[1234])
    algorithm = build_algorithm_config(stack.members[0].hyperparams, env_id=env_id, seed=1234).build_algo()
    expected = learner_of(algorithm).module[MODULE].unwrapped().state_dict()
    assert set(stack.members[0].weights) == set(expected)
    for name, value in expected.items():
        np.testing.assert_array_equal(stack.members[0].weights[name], value.numpy())
    algorithm.stop()
    stack.envs.close()


# -- what is no number


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_a_member_whose_weights_are_no_numbers_touches_no_other(env_id: str) -> None:
    """The others' weights are to the last bit those of a run in which nothing went wrong.

    Not across machines: both runs are the same program on this one, with the same shapes, and round alike.
    """
    weights = {}
    for goes_wrong in (False, True):
        stack = make_stack(env_id, [{"grad_clip": 1.0}, {"hidden_sizes": (5,)}, {"entropy_coeff": 0.1}])
        stack.train_iteration()
        if goes_wrong:
            stack.member("m1").weights["pi.bias"][:] = math.nan
            stack._stale = True
        for _ in range(3):
            stats = stack.train_iteration()
        weights[goes_wrong] = {m.member_id: stack.member(m.member_id).weights for m in stack.members}
        # What cannot be shown is left out.
        assert all(math.isfinite(value) for found in stats.values() for value in found.learner.values())
        assert ("policy_loss" in stats["m1"].learner) is not goes_wrong
        stack.envs.close()
    for name in ("m0", "m2"):
        for key, value in weights[False][name].items():
            np.testing.assert_array_equal(weights[True][name][key], value)
    assert not np.isfinite(weights[True]["m1"]["pi.weight"]).any()
