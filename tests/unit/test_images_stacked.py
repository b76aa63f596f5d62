"""Images among the members of several observations at once: convolutions see them all, as the channels of one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from policy_factory import untrained_policy
from seen_images import SMALL

from policies.acting.evaluate import evaluate_policy
from policies.acting.load import load_policy
from policies.envs.checked import check_observation
from policies.envs.first_step import Largest
from policies.envs.flat import FlatBox
from policies.envs.images import Channels, SeenImage, image_members, image_seen
from policies.envs.make import EnvInfo, check_env, make_env, make_vector_env
from policies.envs.masks import MaskedBox, seen_by_networks
from policies.envs.spaces import describe_space, space_from_description
from policies.envs.stacked import StackedBox
from policies.errors import CheckpointError, EnvError, SpecError
from policies.guard import guarded
from policies.hyperparams import PPOHyperparams
from policies.portable.file import save_policy
from tune_jobs.plan.env_checks import check_env_rules
from tune_jobs.plan.env_notes import env_notes
from tune_jobs.spec.file import load_spec

pytestmark = pytest.mark.usefixtures("env_plugin")

ENV, MASKED, PAIR = "TestBeside-v0", "TestMaskedBeside-v0", "TestPair-v0"
ARGS: dict[str, Any] = {"frame_stack": 3}
SIZE = 12 * 9 * 2
FRAME = 3 + SIZE + 2
SEEN = SeenImage(
    (12, 9, 6), 3, 15, 1 / 255, (Channels(3 + FRAME, 2, 1 / 255), Channels(3 + 2 * FRAME, 2, 1 / 255))
)  # fmt: skip
CONVOLVED: dict[str, Any] = {"hyperparams": {"conv_filters": [[5, 4, 2]]}}


@pytest.mark.parametrize("env_id", [ENV, MASKED])
def test_the_images_of_all_observations_are_found(env_id: str) -> None:
    info = check_env(env_id, ARGS)
    assert isinstance(info.observation_space, MaskedBox) is (env_id == MASKED)
    assert image_members(info.observation_space) == {("image",): (12, 9, 2)}
    assert info.image == SEEN


def test_the_numbers_are_where_they_are_said_to_be() -> None:
    frame = FlatBox(spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Box(-3, 7, (2, 2, 1), np.float32)}))
    space = StackedBox(frame, 3)
    assert space.shape == (18,)
    assert space == spaces.Box(np.tile(frame.low, 3), np.tile(frame.high, 3))
    assert [(keys, start, end) for keys, _, start, end in space.places()] == [
        (("a",), 0, 2), (("b",), 2, 6), (("a",), 6, 8), (("b",), 8, 12), (("a",), 12, 14), (("b",), 14, 18)
    ]  # fmt: skip
    assert [space.name_of(place) for place in (9, 13, 17)] == [
        "observation['b'][0][1][0]", "observation['a']", "observation['b'][1][1][0]"
    ]  # fmt: skip


def test_a_picture_alone_is_stacked_as_an_image() -> None:
    info = check_env("TestShades-v0", ARGS)
    assert (info.image, image_seen(info.observation_space)) == (SeenImage((12, 9, 6)), SeenImage((12, 9, 6)))
    assert not isinstance(info.observation_space, StackedBox)
    assert not isinstance(check_env("CartPole-v1", ARGS).observation_space, StackedBox)


def test_a_vector_environment_observes_the_same() -> None:
    envs = make_vector_env(ENV, ARGS, 2)
    assert isinstance(envs.single_observation_space, StackedBox)
    assert image_seen(envs.single_observation_space) == SEEN
    envs.close()


@pytest.mark.parametrize("env_id", [ENV, MASKED])
def test_a_saved_policy_sees_each_observation_where_it_is(env_id: str, tmp_path: Path) -> None:
    """By the frames that the environment itself gave, which a policy without them gets as one image."""
    made = untrained_policy(env_id, ARGS, PPOHyperparams(**SMALL), tmp_path)
    save_policy(made.portable, tmp_path)
    policy: Any = load_policy(tmp_path)
    network = policy.portable.network
    assert network.image == SEEN
    env, own = make_env(env_id, ARGS), gym.make(env_id)
    rows, frames = [env.reset(seed=1)[0]], [own.reset(seed=1)[0]]
    rng = np.random.default_rng(0)
    for _ in range(5):
        mask = frames[-1].get("action_mask", np.ones(2, np.int8))
        action = int(rng.choice(np.flatnonzero(mask)))
        rows.append(env.step(action)[0])
        frames.append(own.step(action)[0])
    num_masked = 4 if env_id == MASKED else 0
    for number in range(2, 6):
        row = rows[number][num_masked:][None]
        image = np.concatenate(network.image.members_of(row), axis=-1)[0]
        expected = np.concatenate([frame["image"] for frame in frames[number - 2 : number + 1]], axis=-1)
        np.testing.assert_allclose(image, expected / 255, rtol=1e-6)
        beside = np.concatenate(network.image.beside_of(row), axis=-1)[0]
        parts = [
            part for frame in frames[number - 2 : number + 1] for part in (frame["before"], np.eye(2)[frame["which"]])
        ]
        np.testing.assert_array_equal(beside, np.concatenate(parts).astype(np.float32))
    assert np.array_equal(made.act(np.array(rows)), policy.act(np.array(rows)))
    assert evaluate_policy(policy, env_id=env_id, env_args=ARGS, seeds=[1, 2]).lengths == (10, 10)


def test_several_images_of_several_observations_are_one() -> None:
    seen = check_env(PAIR, {"frame_stack": 2}).image
    assert seen is not None
    assert (seen.shape, seen.num_beside) == ((12, 9, 6), 16)
    assert [part.num_channels for part in seen.parts] == [2, 1, 2, 1]
    assert [part.scale for part in seen.parts] == [1 / 255, 1.0, 1 / 255, 1.0]


@pytest.mark.parametrize("env_id", [ENV, MASKED, PAIR, "FrozenLake-v1"])
def test_the_plan_has_the_space_from_a_process_of_the_environments(env_id: str) -> None:
    """As JSON: with the members of each observation, of which a plan says what convolutions see."""
    own = check_env(env_id, ARGS)
    told = guarded.check_env(env_id, ARGS)
    seen = seen_by_networks(told.observation_space)
    assert isinstance(seen, StackedBox)
    assert [place[0::2] for place in seen.places()] == [
        place[0::2] for place in cast("StackedBox", seen_by_networks(own.observation_space)).places()
    ]
    assert (told.image, told.observation_space) == (own.image, own.observation_space)
    assert isinstance(told.observation_space, MaskedBox) is (env_id == MASKED)


@pytest.mark.parametrize("wrong", [1, 0, 4, 10**7, True, "3"])
def test_a_description_of_other_observations_at_once_is_refused(wrong: Any) -> None:
    described = describe_space(check_env(ENV, ARGS).observation_space)
    assert space_from_description(described) == check_env(ENV, ARGS).observation_space
    with pytest.raises(CheckpointError, match="A space is described as"):
        space_from_description({**described, "frames": wrong})


# -- what is said


def info_of(env_id: str = ENV, num_frames: int = 3) -> EnvInfo:
    return check_env(env_id, {"frame_stack": num_frames})


def notes_of(info: EnvInfo, **sweep: Any) -> list[str]:
    env = {"id": info.env_id, "frame_stack": info.env_args["frame_stack"]}
    return env_notes(load_spec({"env": env, "algorithm": "ppo", **sweep}), info)


def test_the_plan_says_what_convolutions_see_of_stacked_observations() -> None:
    made, seen = notes_of(info_of(), **CONVOLVED)[:2]
    assert made.startswith(f"Observations of {ENV} are made vectors of shape (663,), 3 observations in each: Dict(")
    assert seen == (
        "Convolutions see observation['image'] of the last 3 observations as the channels of one image, of (12, 9, 6) "
        "(rows, columns, channels); the dense layers see 15 other numbers beside it."
    )
    (made,) = (note for note in notes_of(info_of("FrozenLake-v1", 2)) if "are made" in note)
    assert made.endswith("vectors of shape (32,), 2 observations in each: Discrete(16).")
    spec = load_spec({"env": {"id": ENV, "frame_stack": 3}, "algorithm": "ppo", **CONVOLVED})
    check_env_rules(spec, info_of(), [PPOHyperparams(conv_filters=((5, 4, 2),))])


@pytest.mark.parametrize(("value", "told"), [(10.0, True), (100.0, False)])
def test_few_used_bytes_of_stacked_observations_are_told(value: float, told: bool) -> None:
    info = replace(info_of(), largest=Largest(value, "observation['image'][0][0][0]"))
    notes = [note for note in notes_of(info, **CONVOLVED) if "normalize_observations" in note]
    assert ["numbers of up to 10, and its space allows 255" in note for note in notes] == [True] * told


def test_the_largest_number_of_stacked_observations_has_its_place() -> None:
    largest = info_of().largest
    assert largest is not None
    assert largest.place.startswith("observation['image'][")


def test_a_number_that_is_none_has_its_place() -> None:
    row = np.zeros(3 * FRAME, np.float32)
    row[2 * FRAME + 1] = np.nan
    with pytest.raises(EnvError, match=r"was NaN \(observation\['before'\]\[1\]\)"):
        check_observation(row, ENV, 1, seen_by_networks(info_of().observation_space))


@pytest.mark.parametrize("masked", [False, True])
def test_stacked_images_of_two_sizes_are_refused_with_what_leaves_one(masked: bool) -> None:
    """A wrapper for those below a mask could lose it: there is none in the hint."""
    members: dict[str, gym.Space[Any]] = {"a": spaces.Box(0, 255, (4, 5, 3), np.uint8), "n": spaces.Discrete(2)}
    stacked = StackedBox(FlatBox(spaces.Dict({**members, "z": spaces.Box(0, 255, (5, 4, 3), np.uint8)})), 2)
    info = replace(info_of(), observation_space=MaskedBox(stacked, (2,)) if masked else stacked)
    spec = load_spec({"env": {"id": ENV, "frame_stack": 2}, "algorithm": "ppo"})
    with pytest.raises(SpecError, match="with 2 images among their members, of different sizes") as caught:
        check_env_rules(spec, info, [PPOHyperparams(conv_filters=((5, 4, 2),))])
    hint = caught.value.hint
    assert "observe only one of observation['a'] and observation['z']. Those of one height" in hint
    assert ("FilterObservation(gymnasium.make('TestBeside-v0'), ['a', 'n'])" in hint) is not masked
    assert hint.endswith("channels of one.") is masked
