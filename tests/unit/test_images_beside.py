"""Images among other members: convolutions see them, and the dense layers what is beside them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from policy_factory import untrained_policy
from seen_images import FILTERS, SMALL, assert_all_compute_the_same

from policies.acting.evaluate import evaluate_policy
from policies.acting.load import load_policy
from policies.envs.first_step import Largest
from policies.envs.images import SeenImage, image_member, image_members, image_seen
from policies.envs.make import EnvInfo, check_env
from policies.envs.masks import FORBIDDEN, MaskedBox
from policies.envs.space_hints import one_image_hint
from policies.errors import CheckpointError, SpecError
from policies.hyperparams import DQNHyperparams, PPOHyperparams
from policies.portable.file import save_policy
from tests.narrowing import present
from tune_jobs.plan.env_checks import check_env_rules
from tune_jobs.plan.env_notes import env_notes
from tune_jobs.plan.estimates import products_per_image, trial_bytes
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec

pytestmark = pytest.mark.usefixtures("env_plugin")

ENV, FINE, MASKED = "TestBeside-v0", "TestFineBeside-v0", "TestMaskedBeside-v0"
SHAPE, SIZE = (12, 9, 2), 12 * 9 * 2
NUM_SEEN = 3 + SIZE + 2
PIXELS, GREY = spaces.Box(0, 255, (4, 5, 3), np.uint8), spaces.Box(0, 7, (4, 5), np.uint8)
GRID, FEW = spaces.Box(-1, 1, (2, 3, 1), np.float32), spaces.Box(-1, 1, (2,), np.float32)


def flat(space: gym.Space[Any]) -> gym.Space[Any]:
    from policies.envs.flat import FlatBox

    return FlatBox(space)


@pytest.mark.parametrize(
    ("space", "keys", "expected"),
    [
        (spaces.Dict({"a": FEW, "b": PIXELS, "c": FEW}), ("b",), SeenImage((4, 5, 3), 2, 4, 1 / 255)),
        (spaces.Tuple((GRID, spaces.Discrete(3))), (0,), SeenImage((2, 3, 1), 0, 3)),
        (spaces.Dict({"a": spaces.Dict({"x": spaces.Discrete(2), "y": GREY})}), ("a", "y"),
         SeenImage((4, 5, 1), 2, 2, 1 / 7)),
        (spaces.Dict({"only": PIXELS}), ("only",), SeenImage((4, 5, 3), 0, 0, 1 / 255)),
    ],
    ids=str,
)  # fmt: skip
def test_the_only_image_is_found_where_its_numbers_are(
    space: gym.Space[Any], keys: tuple[Any, ...], expected: SeenImage
) -> None:
    made = flat(space)
    for one in (made, MaskedBox(cast("spaces.Box", made), (3,))):
        assert image_members(one) == {keys: expected.shape}
        assert image_seen(one) == image_member(one) == expected
        assert image_member(one, normalizes=True) == replace(expected, scale=1.0)
    assert expected.num_seen == present(made.shape)[0]
    # A number of the image is where it is said to be.
    sample = space.sample()
    value = sample
    for key in keys:
        value = value[key]
    numbers = cast("Any", made).flat(sample)
    assert np.array_equal(numbers[expected.places[0]], np.ravel(value))


def test_a_whole_image_is_no_member_and_of_two_sizes_there_is_none() -> None:
    assert image_seen(PIXELS) == SeenImage((4, 5, 3))
    assert image_seen(flat(GREY)) == SeenImage((4, 5, 1))
    assert image_member(PIXELS) is image_member(flat(GREY)) is None
    two = flat(spaces.Dict({"a": PIXELS, "b": spaces.Box(0, 7, (5, 4), np.uint8)}))
    assert image_members(two) == {("a",): (4, 5, 3), ("b",): (5, 4, 1)}
    assert image_seen(two) is image_member(two) is None
    for none in (FEW, flat(spaces.Dict({"a": FEW, "b": spaces.MultiBinary((4, 5, 3))})), spaces.Discrete(3)):
        assert image_seen(none) is None


@pytest.mark.parametrize(
    ("space", "expression"),
    [
        (spaces.Dict({"a": spaces.Dict({"x": PIXELS}), "b": PIXELS, "c": FEW}), "FilterObservation(gymnasium.make("),
        (spaces.Dict({"a": spaces.Dict({"x": PIXELS, "y": PIXELS}), "c": FEW}), "seen['a']['x']"),
        (spaces.Tuple((PIXELS, GREY)), "seen[0]"),
    ],
    ids=str,
)
def test_what_leaves_one_image_leaves_what_is_beside_it_where_it_can(space: gym.Space[Any], expression: str) -> None:
    hint = one_image_hint("Two-v0", space, list(image_members(flat(space))))
    assert expression in hint
    assert ("['a', 'c'])` leaves the other images out" in hint) is expression.startswith("Filter")


# -- networks


def observations(num: int, *, high: float = 255.0) -> NDArray[np.float32]:
    """Vectors as of the test environment."""
    rng = np.random.default_rng(0)
    parts = [rng.uniform(-1, 1, (num, 3)), rng.uniform(0, high, (num, SIZE)), np.eye(2)[rng.integers(0, 2, num)]]
    return np.concatenate(parts, axis=1).astype(np.float32)


def info_of(env_id: str = ENV) -> EnvInfo:
    return check_env(env_id, {})


@pytest.mark.parametrize("normalizes", [False, True])
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_all_compute_the_same_of_what_is_observed(algorithm: str, normalizes: bool, tmp_path: Path) -> None:
    def parts(seen: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        image = seen[:, 3 : 3 + SIZE].reshape(-1, *SHAPE)
        return image if normalizes else image / 255, [seen[:, :3], seen[:, 3 + SIZE :]]

    image = SeenImage(SHAPE, 3, 5, 1 / 255)
    assert_all_compute_the_same(
        ENV, algorithm, observations(20), parts, image=image, folder=tmp_path, normalizes=normalizes
    )


def test_what_is_beside_the_image_and_each_pixel_matter(tmp_path: Path) -> None:
    policy = untrained_policy(FINE, {}, PPOHyperparams(**SMALL), tmp_path)
    row = observations(1, high=1.0)
    before = policy.outputs(row)
    without = [place for place in range(NUM_SEEN) if np.array_equal(policy.outputs(changed(row, place)), before)]
    # The kernels see all rows, and 8 of 9 columns.
    unseen = np.zeros(SHAPE, bool)
    unseen[:, 8] = True
    assert without == (3 + np.flatnonzero(unseen)).tolist()


def test_a_batch_of_no_observations_has_no_actions(tmp_path: Path) -> None:
    policy = untrained_policy(FINE, {}, PPOHyperparams(**SMALL), tmp_path)
    assert policy.act(observations(1, high=1.0)).shape == (1,)
    assert policy.act(np.zeros((0, NUM_SEEN), np.float32)).shape == (0,)


def changed(row: NDArray[np.float32], place: int) -> NDArray[np.float32]:
    other = row.copy()
    other[0, place] += 1
    return other


@pytest.mark.parametrize("env_id", [ENV, MASKED])
def test_a_policy_takes_what_the_environment_gives(env_id: str, tmp_path: Path) -> None:
    policy = untrained_policy(env_id, {}, PPOHyperparams(**SMALL), tmp_path)
    env = gym.make(env_id)
    observation, _ = env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(9):
        mask = observation.get("action_mask", np.ones(2, np.int8))
        image = np.asarray(observation["image"], np.float32).ravel()
        row = np.concatenate([observation["before"], image, np.eye(2)[observation["which"]]])
        masked = np.concatenate([mask, row]) if "action_mask" in observation else row
        outputs = policy.outputs(masked[None].astype(np.float32))[0]
        assert (outputs == FORBIDDEN).tolist() == (mask == 0).tolist()
        assert policy.act(observation) == outputs.argmax()
        observation, *_ = env.step(int(rng.choice(np.flatnonzero(mask))))
    assert evaluate_policy(policy, env_id=env_id, seeds=[1, 2]).lengths == (10, 10)


def test_a_policy_file_whose_image_is_elsewhere_is_refused(tmp_path: Path) -> None:
    policy = untrained_policy(ENV, {}, PPOHyperparams(**SMALL), tmp_path)
    save_policy(policy.portable, tmp_path)
    described = json.loads((tmp_path / "policy.json").read_text())
    assert described["network"]["image"] == {"shape": [12, 9, 2], "start": 3, "num_beside": 5, "scale": 1 / 255}
    for wrong in ({"start": 6}, {"start": -1}, {"num_beside": 4}):
        changed = {**described, "network": {**described["network"], "image": described["network"]["image"] | wrong}}
        (tmp_path / "policy.json").write_text(json.dumps(changed))
        with pytest.raises(CheckpointError, match="an image of shape"):
            load_policy(tmp_path)
    del described["network"]["image"]
    (tmp_path / "policy.json").write_text(json.dumps(described))
    with pytest.raises(CheckpointError):
        load_policy(tmp_path)


# -- plans


def plan_notes(env_id: str = ENV, **sweep: Any) -> list[str]:
    return env_notes(load_spec({"env": env_id, "algorithm": "ppo", **sweep}), info_of(env_id))


@pytest.mark.parametrize("sweep", [
    {"hyperparams": {"conv_filters": [[5, 4, 2]]}},
    {"space": {"conv_filters": {"choice": [None, [[5, 4, 2]]]}}},
], ids=str)  # fmt: skip
def test_the_plan_says_what_convolutions_see(sweep: dict[str, Any]) -> None:
    note = (
        "Convolutions see observation['image'], of (12, 9, 2) (rows, columns, channels); the dense layers see 5 other "
        "numbers beside it."
    )
    assert note in plan_notes(**sweep)
    assert not [note for note in plan_notes() if "onvolutions" in note]
    spec = load_spec({"env": ENV, "algorithm": "ppo", **sweep})
    check_env_rules(spec, info_of(), [PPOHyperparams(), PPOHyperparams(conv_filters=((5, 4, 2),))])


def test_bytes_that_convolutions_see_are_divided_and_so_not_told_as_large() -> None:
    convolved: dict[str, Any] = {"hyperparams": {"conv_filters": [[5, 4, 2]]}}
    assert [note for note in plan_notes() if "networks learn little" in note]
    assert not [note for note in plan_notes(**convolved) if "networks learn little" in note]
    # Searched with none, they are not divided in some trials.
    searched: dict[str, Any] = {"space": {"conv_filters": {"choice": [None, [[5, 4, 2]]]}}}
    assert [note for note in plan_notes(**searched) if "networks learn little" in note]


@pytest.mark.parametrize(("value", "place", "told"), [
    (10.0, "observation['image'][0][0][0]", "numbers of up to 10, and its space allows 255"),
    (10.0, "observation['before'][0]", "numbers as large as 10 (observation['before'][0])"),
    (100.0, "observation['image'][0][0][0]", None),
])  # fmt: skip
def test_bytes_of_a_member_of_which_few_are_used_are_told_as_those_of_an_image(
    value: float, place: str, told: str | None
) -> None:
    info = replace(info_of(), largest=Largest(value, place))
    spec = load_spec({"env": ENV, "algorithm": "ppo", "hyperparams": {"conv_filters": [[5, 4, 2]]}})
    notes = [note for note in env_notes(spec, info) if "normalize_observations" in note]
    assert len(notes) == (told is not None)
    assert all(told is not None and told in note for note in notes)


def test_filters_that_do_not_fit_the_member_are_refused() -> None:
    spec = load_spec({"env": ENV, "algorithm": "ppo"})
    with pytest.raises(SpecError, match=r"does not fit TestBeside-v0: conv_filters\[0\] has kernels of 10") as caught:
        check_env_rules(spec, info_of(), [PPOHyperparams(conv_filters=((4, 10, 1),))])
    assert "smaller kernels" in caught.value.hint
    stacked = load_spec({"env": {"id": ENV, "frame_stack": 2}, "algorithm": "ppo"})
    with pytest.raises(SpecError, match=r"does not fit TestBeside-v0: conv_filters\[0\] has kernels of 10"):
        check_env_rules(stacked, check_env(ENV, {"frame_stack": 2}), [PPOHyperparams(conv_filters=((4, 10, 1),))])


def test_a_large_image_without_convolutions_is_told_with_filters_for_it() -> None:
    screen = spaces.Box(0, 255, (40, 30, 3), np.uint8)
    info = replace(info_of(), observation_space=flat(spaces.Dict({"health": FEW, "screen": screen})))
    (note,) = [
        note for note in env_notes(load_spec({"env": ENV, "algorithm": "ppo"}), info) if "beside another" in note
    ]
    assert note.startswith("3,600 numbers of these vectors are those of an image, observation['screen']:")
    assert note.endswith("hyperparams.conv_filters, such as [[16, 8, 4], [32, 4, 2]], has convolutions see it.")


def test_memory_and_work_are_counted_with_what_is_beside() -> None:
    info, image = info_of(), present(info_of().image)
    values = PPOHyperparams(conv_filters=((4, 3, 2),), hidden_sizes=(10,))
    assert products_per_image(image, values) == 5 * 4 * 4 * 18 + (5 * 4 * 4 + 5) * 10
    assert products_per_image(replace(image, num_beside=0), values) == 5 * 4 * 4 * 18 + 5 * 4 * 4 * 10
    whole = check_env("TestShades-v0", {})
    dqn = DQNHyperparams(conv_filters=FILTERS, replay_capacity=100_000)
    # Numbers of four bytes each, in two observations of a transition.
    assert trial_bytes(info, dqn) - trial_bytes(whole, dqn) > 2 * 100_000 * (3 * SIZE + 4 * 5)


def test_weights_for_what_is_beside_are_counted() -> None:
    def needed(num_beside: int) -> int:
        more = spaces.Box(-1, 1, (num_beside,), np.float32)
        info = replace(info_of(), observation_space=flat(spaces.Dict({"image": PIXELS, "more": more})))
        small = {"train_batch_size": 16, "minibatch_size": 16, "num_envs": 1}
        return trial_bytes(info, PPOHyperparams(conv_filters=((4, 3, 1),), hidden_sizes=(1000,), **small))

    # Of 4 bytes each, in the networks of the policy and of the value function.
    assert needed(5001) - needed(1) > 2 * 5000 * 1000 * 4


@pytest.mark.parametrize(("filters", "engine"), [([[8, 4, 2]], "packed"), ([[64, 3, 1], [64, 3, 1]], "rllib")])
def test_large_convolutions_are_trained_by_rllib(filters: Any, engine: str) -> None:
    hyperparams = {"conv_filters": filters, "hidden_sizes": [64]}
    plan = make_plan(load_spec({"env": ENV, "algorithm": "ppo", "hyperparams": hyperparams}), Machine(8, 0))
    assert plan.engines == {engine: 1}
