"""Masks of actions beside images, which are in a row behind the mask until networks see them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from policy_factory import registered, untrained_policy

from policies.acting.evaluate import evaluate_policy
from policies.acting.policy import NetworkPolicy, RandomPolicy
from policies.envs.make import check_env, make_env, make_vector_env
from policies.envs.masks import FORBIDDEN, MaskedBox
from policies.envs.spaces import describe_space, space_from_description
from policies.errors import EnvError, ObservationError, SpecError
from policies.hyperparams import DQNHyperparams, PPOHyperparams
from tune_jobs.plan.env_checks import check_env_rules
from tune_jobs.plan.estimates import trial_bytes
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec

pytestmark = pytest.mark.usefixtures("env_plugin")

ENV = "TestMaskedShades-v0"
SHAPE, SIZE = (12, 9, 2), 12 * 9 * 2
FILTERS = ((5, 4, 2), (3, 2, 1))


def policy_of(hyperparams: Any, folder: Path) -> NetworkPolicy:
    return untrained_policy(ENV, {}, hyperparams, folder)


def test_an_image_is_observed_in_a_row_behind_the_mask() -> None:
    info = check_env(ENV, None, "dqn")
    space = info.observation_space
    assert isinstance(space, MaskedBox)
    assert (space.shape, space.seen.shape) == ((4 + SIZE,), SHAPE)
    assert space.seen.dtype == np.uint8
    assert (info.mask, info.observes_images, info.is_flattened) == ("action_masks()", True, False)
    assert space.high[:4].max() == 1
    assert space.high[4:].min() == 255
    env, envs, own = make_env(ENV), make_vector_env(ENV, {}, 1), gym.make(ENV)
    inner: Any = own.unwrapped
    row, (rows, _), image = env.reset(seed=2)[0], envs.reset(seed=2), own.reset(seed=2)[0]
    for _ in range(9):
        assert np.array_equal(row, np.concatenate([inner.mask, image.ravel()]))
        assert np.array_equal(rows[0], row)
        action = int(np.flatnonzero(inner.mask)[0])
        row, rows, image = env.step(action)[0], envs.step(np.array([action]))[0], own.step(action)[0]
    again = space_from_description(json.loads(json.dumps(describe_space(space))))
    assert isinstance(again, MaskedBox)
    assert again == space
    assert again.seen == space.seen


@pytest.mark.parametrize("kind", ["ppo", "dqn"])
@pytest.mark.parametrize("normalizes", [False, True])
def test_a_policy_looks_at_the_image_and_takes_what_is_allowed(kind: str, normalizes: bool, tmp_path: Path) -> None:
    make: Any = PPOHyperparams if kind == "ppo" else DQNHyperparams
    values = {"conv_filters": FILTERS, "hidden_sizes": (8,), "activation": "tanh", "normalize_observations": normalizes}
    policy = policy_of(make(**values), tmp_path)
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (50, *SHAPE), dtype=np.uint8)
    masks = rng.integers(0, 2, (50, 4))
    masks[np.arange(50), rng.integers(0, 4, 50)] = 1
    rows = np.concatenate([masks, images.reshape(50, -1)], axis=1).astype(np.float32)
    # Bytes are scaled as those of images without a mask.
    scores = policy._forward(images.astype(np.float32))
    assert policy.portable.network.scale == pytest.approx(1 / 255)
    assert np.array_equal(policy.outputs(rows), np.where(masks == 1, scores, np.float32(FORBIDDEN)))
    wanted = np.where(masks == 1, scores, -np.inf).argmax(axis=1)
    assert len(set(wanted.tolist())) >= 3
    assert policy.act(rows).tolist() == policy.act(images, mask=masks).tolist() == wanted.tolist()
    assert policy.act(rows, mask=np.ones((50, 4))).tolist() == scores.argmax(axis=1).tolist()
    assert policy.act(images[0], mask=masks[0]) == policy.act(rows[0]) == wanted[0]
    assert policy.act(images[:0], mask=masks[:0]).shape == (0,)
    assert evaluate_policy(policy, env_id=ENV, seeds=[1, 2]).lengths == (10, 10)
    with pytest.raises(ObservationError, match="there is no mask") as caught:
        policy.act(images[0])
    assert 'mask=env.get_wrapper_attr("action_masks")()' in caught.value.hint
    for wrong in (images[0, :-1], images[0, :, :, 0], images[0].ravel()[1:]):
        with pytest.raises(ObservationError, match="there is an observation of shape"):
            policy.act(wrong, mask=masks[0])


def test_who_plays_at_random_takes_what_is_allowed() -> None:
    # The environment raises an error otherwise.
    assert evaluate_policy(RandomPolicy.for_env(ENV), env_id=ENV, seeds=range(5)).lengths == (10,) * 5


class Board(gym.Env[Any, Any]):
    """A board of whole numbers."""

    observation_space: Any = gym.spaces.Box(-1, 1, (6, 7, 2), np.int8)
    action_space: Any = gym.spaces.Discrete(7)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.full((6, 7, 2), -1, np.int8), {"legal": np.ones(7, np.int8)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.ones((6, 7, 2), np.int8), 0.0, True, False, {}


def test_a_board_of_whole_numbers_is_an_image_too() -> None:
    with registered("TestBoard-v0", Board):
        info = check_env("TestBoard-v0", {"action_mask": "legal"}, "dqn")
        assert isinstance(info.observation_space, MaskedBox)
        assert (info.observation_space.seen.shape, info.observes_images) == ((6, 7, 2), True)
        again = space_from_description(json.loads(json.dumps(describe_space(info.observation_space))))
        assert isinstance(again, MaskedBox)
        assert again.seen.shape == (6, 7, 2)
        policy = RandomPolicy(again, info.action_space, env_id="TestBoard-v0")
        assert policy.act(np.ones((6, 7, 2), np.int8), mask=[0, 0, 0, 0, 0, 1, 0]) == 5
        assert policy.act(np.ones((3, 6, 7, 2), np.int8), mask=[[0, 0, 1, 0, 0, 0, 0]] * 3).tolist() == [2, 2, 2]


class Hand(Board):
    """Two boards beside other members, one of which lies on its side."""

    def __init__(self, *, has_mask: bool) -> None:
        mask = {"action_mask": gym.spaces.MultiBinary(7)} if has_mask else {}
        last = gym.spaces.Box(0, 1, (7, 6, 2), np.int8)
        self.observation_space = gym.spaces.Dict(
            {"cards": gym.spaces.Discrete(3), "board": Board.observation_space, "last": last, **mask}
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        board, info = super().reset(seed=seed)
        mask = {"action_mask": info["legal"]} if "action_mask" in self.observation_space.spaces else {}
        return {"cards": 1, "board": board, "last": board.swapaxes(0, 1), **mask}, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.reset()[0], 0.0, True, False, {}


@pytest.mark.parametrize("has_mask", [False, True])
def test_convolutions_for_two_images_are_refused_with_what_leaves_one(has_mask: bool) -> None:
    with registered("TestHand-v0", Hand):
        spec = load_spec({"env": {"id": "TestHand-v0", "args": {"has_mask": has_mask}}, "algorithm": "ppo"})
        info = check_env("TestHand-v0", {"has_mask": has_mask}, "ppo")
        assert not info.observes_images
        with pytest.raises(SpecError, match=r"are flat, of shape \(171,\), with 2 images among their mem") as caught:
            check_env_rules(spec, info, [PPOHyperparams(conv_filters=FILTERS)])
        names = "only one of observation['board'] and observation['last']"
        assert f"Leave hyperparams.conv_filters out, or observe {names}." in caught.value.hint
        (expression,) = re.findall("`(.+?)`", caught.value.hint)
        # What makes the environment, within the wrapper, as the hint has it.
        made = expression.replace("gymnasium.make('TestHand-v0')", "hand")
        assert made != expression
        hand = Hand(has_mask=has_mask)
        members = eval(made, {"gymnasium": gym, "hand": hand}).observation_space.spaces
    assert list(members) == [*(["action_mask"] if has_mask else []), "board", "cards"]
    cartpole = check_env("CartPole-v1", None, "ppo")
    with pytest.raises(SpecError, match="convolutions are for images") as caught:
        check_env_rules(
            load_spec({"env": "CartPole-v1", "algorithm": "ppo"}), cartpole, [PPOHyperparams(conv_filters=FILTERS)]
        )
    assert caught.value.hint == "Leave hyperparams.conv_filters out, or observe images with env.pixels: true."


def test_frames_of_masked_images_are_not_stacked() -> None:
    with pytest.raises(EnvError, match="images with a mask cannot be stacked") as caught:
        check_env(ENV, {"frame_stack": 2})
    assert "action_mask: false" in caught.value.hint
    assert check_env(ENV, {"frame_stack": 2, "action_mask": False}).observation_space.shape == (12, 9, 4)


def test_the_plan_wants_convolutions_that_fit_and_counts_numbers_of_four_bytes() -> None:
    info = check_env(ENV, None, "ppo")
    spec = load_spec({"env": ENV, "algorithm": "ppo"})
    with pytest.raises(SpecError, match=r"has images of shape \(12, 9, 2\)") as caught:
        check_env_rules(spec, info, [PPOHyperparams()])
    assert "such as [[16, 3, 1]]." in caught.value.hint
    with pytest.raises(SpecError, match="does not fit TestMaskedShades-v0"):
        check_env_rules(spec, info, [PPOHyperparams(conv_filters=((4, 10, 1),))])
    check_env_rules(spec, info, [PPOHyperparams(conv_filters=FILTERS)])
    masked, plain = (
        trial_bytes(one, DQNHyperparams(conv_filters=FILTERS, replay_capacity=100_000))
        for one in (info, check_env(ENV, {"action_mask": False}))
    )
    # Of two observations in each transition.
    assert masked - plain > 2 * 100_000 * (3 * SIZE + 4 * 4)


@pytest.mark.parametrize(("filters", "engine"), [([[8, 4, 4]], "packed"), ([[64, 3, 1]], "rllib")])
def test_large_ones_are_trained_by_rllib_as_those_without_a_mask_are(filters: Any, engine: str) -> None:
    sweep: dict[str, Any] = {"algorithm": "ppo", "hyperparams": {"conv_filters": filters, "hidden_sizes": [64]}}
    masked, plain = (
        make_plan(load_spec({**sweep, "env": {"id": env_id, "args": {"shape": [40, 60, 1]}}}), Machine(8, 0))
        for env_id in (ENV, "TestShades-v0")
    )
    assert masked.engines == plain.engines == {engine: 1}
    assert [note for note in masked.notes if "allows" not in note] == list(plain.notes)
