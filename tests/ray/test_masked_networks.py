"""RLlib's modules of several choices and of masks: what they draw, and that portable policies act as they do."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from network_builds import build, portable
from rllib_cases import Build, module_of

from policies.acting.policy import NetworkPolicy
from policies.envs.masks import FORBIDDEN, MaskedBox
from policies.hyperparams import Algorithm

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

__all__ = ["build"]

SMALL_IMAGE: dict[str, Any] = {"conv_filters": ((5, 4, 2), (3, 2, 1)), "activation": "tanh"}
CASES: dict[str, tuple[Algorithm, str, dict[str, Any]]] = {
    "ppo, several choices": ("ppo", "TestReply-v0", {}),
    "ppo, masked, normalised": ("ppo", "TestForbidding-v0", {"normalize_observations": True}),
    "ppo, several choices, masked": ("ppo", "TestForbiddingTwo-v0", {"vf_share_layers": True}),
    "ppo, masked image, normalised": ("ppo", "TestMaskedShades-v0", {**SMALL_IMAGE, "normalize_observations": True}),
    "dqn, masked image": ("dqn", "TestMaskedShades-v0", SMALL_IMAGE),
    "dqn, masked": ("dqn", "TestForbidding-v0", {"dueling": False}),
    "dqn, masked, dueling, normalised": ("dqn", "TestForbidding-v0", {"normalize_observations": True}),
}


def observed(space: Any, num: int) -> Any:
    """Observations with masks in which something is allowed, and each choice is the only one somewhere."""
    rng = np.random.default_rng(0)
    low, high = (0, 256) if isinstance(space, MaskedBox) and space.seen.dtype == np.uint8 else (-2, 2)
    rows = rng.uniform(low, high, (num, space.shape[0])).astype(np.float32)
    if isinstance(space, MaskedBox):
        masks = [rng.integers(0, 2, (num, size)) for size in space.sizes]
        for mask, size in zip(masks, space.sizes, strict=True):
            mask[np.arange(num), rng.integers(0, size, num)] = 1
        rows[:, : space.num_masked] = np.concatenate(masks, axis=1)
    return rows


@pytest.mark.parametrize("case", CASES)
def test_the_portable_policy_does_what_the_module_does(case: str, build: Build) -> None:
    algorithm, env_id, values = CASES[case]
    algo, hyperparams = build(algorithm, env_id, **values)
    algo.train()
    module = module_of(algo)
    rows = observed(module.observation_space, 1000)
    with torch.no_grad():
        out = module.forward_inference({"obs": torch.from_numpy(rows)})
        if "actions" not in out:
            dist = module.get_inference_action_dist_cls().from_logits(out["action_dist_inputs"])
            out["actions"] = dist.to_deterministic().sample()
    theirs = out["actions"].numpy()
    policy = NetworkPolicy(portable(algo, hyperparams))
    start = policy.action_space.start if isinstance(policy.action_space, gym.spaces.Discrete) else 0
    ours = np.asarray(policy.act_on_rows(rows)) - start
    # Where two outputs are equal but for rounding, either is the best.
    assert (ours == theirs).mean() > 0.999
    assert len(np.unique(ours.reshape(len(ours), -1), axis=0)) > 2


def test_what_is_normalised_is_behind_the_mask(build: Build) -> None:
    module = module_of(build("ppo", "TestForbidding-v0", normalize_observations=True)[0])
    rows = observed(module.observation_space, 1000)
    module.update_observation_statistics(rows)
    seen = rows[:, 4:]
    np.testing.assert_allclose(module.obs_mean, seen.mean(axis=0), rtol=1e-4)
    prepared = module.prepare(torch.from_numpy(rows))
    np.testing.assert_allclose(prepared, (seen - seen.mean(axis=0)) / seen.std(axis=0), atol=1e-4)


@pytest.mark.parametrize("case", [case for case in CASES if "dqn" in case])
def test_targets_are_of_what_the_next_observation_allows(case: str, build: Build) -> None:
    algorithm, env_id, values = CASES[case]
    module = module_of(build(algorithm, env_id, **values)[0])
    rows, next_rows = np.split(observed(module.observation_space, 100), 2)
    batch = {"obs": torch.from_numpy(rows), "new_obs": torch.from_numpy(next_rows)}
    out = module.forward_train(batch)
    for key, mask in (("qf_preds", rows), ("qf_next_preds", next_rows), ("qf_target_next_preds", next_rows)):
        assert ((out[key] == FORBIDDEN).numpy() == (mask[:, :4] == 0)).all(), key


@pytest.mark.parametrize("case", [case for case in CASES if "masked" in case])
def test_of_ten_thousand_draws_none_is_forbidden_and_all_else_is_drawn(case: str, build: Build) -> None:
    algorithm, env_id, values = CASES[case]
    algo, _ = build(algorithm, env_id, **values)
    module = algo.env_runner.module
    space = module.observation_space
    rows = observed(space, 10_000)
    with torch.no_grad():
        # Before any step all of DQN's actions are random.
        out = module.forward_exploration({"obs": torch.from_numpy(rows)}, t=0)
        if "actions" not in out:
            dist = module.get_exploration_action_dist_cls().from_logits(out["action_dist_inputs"])
            out["actions"] = dist.sample()
            assert torch.isfinite(dist.entropy()).all()
            assert torch.isfinite(dist.logp(out["actions"])).all()
            assert (out["action_dist_inputs"].min() == FORBIDDEN).all()
    actions = out["actions"].numpy().reshape(len(rows), -1)
    start = 0
    for place, size in enumerate(space.sizes):
        mask = rows[:, start : start + size]
        assert (mask[np.arange(len(rows)), actions[:, place]] == 1).all()
        # A tenth of what a policy that knows nothing draws.
        assert np.bincount(actions[:, place], minlength=size).min() > len(rows) / size / 10
        start += size
