"""Several images of one size among other members: convolutions see them as the channels of one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

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
from policies.envs.flat import FlatBox
from policies.envs.images import Channels, SeenImage, image_member, image_members, image_seen
from policies.envs.make import EnvInfo, check_env
from policies.envs.space_hints import named_images
from policies.errors import CheckpointError, SpecError
from policies.hyperparams import PPOHyperparams
from policies.portable.file import save_policy
from tests.narrowing import present
from tune_jobs.plan.env_checks import check_env_rules
from tune_jobs.plan.env_notes import env_notes
from tune_jobs.spec.file import load_spec

pytestmark = pytest.mark.usefixtures("env_plugin")

ENV = "TestPair-v0"
SIZE = 12 * 9
COLOR, DEPTH = slice(2, 2 + 2 * SIZE), slice(5 + 2 * SIZE, 5 + 3 * SIZE)
NUM_SEEN = 3 * SIZE + 8
SEEN = SeenImage((12, 9, 3), 2, 8, 1 / 255, (Channels(5 + 2 * SIZE, 1),))
PIXELS, GREY = spaces.Box(0, 255, (4, 5, 3), np.uint8), spaces.Box(0, 7, (4, 5), np.uint8)
ASIDE, FEW = spaces.Box(0, 255, (5, 4, 3), np.uint8), spaces.Box(-1, 1, (2,), np.float32)


def info_of() -> EnvInfo:
    return check_env(ENV, {})


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (spaces.Dict({"a": FEW, "b": PIXELS, "c": GREY, "d": FEW}),
         SeenImage((4, 5, 4), 2, 4, 1 / 255, (Channels(62, 1, 1 / 7),))),
        (spaces.Tuple((GREY, FEW, GREY, PIXELS)),
         SeenImage((4, 5, 5), 0, 2, 1 / 7, (Channels(22, 1, 1 / 7), Channels(42, 3, 1 / 255)))),
        (spaces.Dict({"a": PIXELS, "b": spaces.Dict({"x": FEW, "y": PIXELS})}),
         SeenImage((4, 5, 6), 0, 2, 1 / 255, (Channels(62, 3, 1 / 255),))),
        (spaces.Dict({"a": PIXELS, "b": ASIDE}), None),
        (spaces.Dict({"a": PIXELS, "b": GREY, "c": ASIDE}), None),
    ],
    ids=str,
)  # fmt: skip
def test_images_of_one_height_and_width_are_one(space: gym.Space[Any], expected: SeenImage | None) -> None:
    made = FlatBox(space)
    assert image_seen(made) == image_member(made) == expected
    unscaled = image_member(made, normalizes=True)
    if expected is None or unscaled is None:
        assert expected is unscaled is None
        return
    assert unscaled == replace(unscaled, start=expected.start) != expected
    assert {part.scale for part in unscaled.parts} == {1.0}
    assert [part.start for part in unscaled.parts] == [part.start for part in expected.parts]
    assert expected.num_seen == made.shape[0]
    # Each channel has the numbers of its member, and what is left is beside it.
    numbers = made.flat(space.sample())
    members = expected.members_of(numbers)
    places = [place for keys, _, *place in made.places() if keys in image_members(made)]
    for member, part, (start, stop) in zip(members, expected.parts, places, strict=True):
        np.testing.assert_allclose(member.ravel(), numbers[start:stop] * part.scale, rtol=1e-6)
    kept = [numbers[start:stop] for keys, _, start, stop in made.places() if keys not in image_members(made)]
    assert np.concatenate(expected.beside_of(numbers)).tolist() == np.concatenate(kept).tolist()


def observations(num: int) -> NDArray[np.float32]:
    """Vectors as of the test environment, with noise for images."""
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (num, NUM_SEEN)).astype(np.float32)
    rows[:, COLOR] = rng.integers(0, 256, (num, 2 * SIZE))
    return rows


@pytest.mark.parametrize("normalizes", [False, True])
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_all_compute_the_same_of_several(algorithm: str, normalizes: bool, tmp_path: Path) -> None:
    def parts(seen: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        color = seen[:, COLOR].reshape(-1, 12, 9, 2) / (1 if normalizes else 255)
        beside = [seen[:, :2], seen[:, COLOR.stop : DEPTH.start], seen[:, DEPTH.stop :]]
        return torch.cat([color, seen[:, DEPTH].reshape(-1, 12, 9, 1)], dim=3), beside

    assert_all_compute_the_same(
        ENV, algorithm, observations(20), parts, image=SEEN, folder=tmp_path, normalizes=normalizes
    )


def test_each_image_and_what_is_beside_them_matter(tmp_path: Path) -> None:
    policy = untrained_policy(ENV, {}, PPOHyperparams(**SMALL), tmp_path)
    row = observations(1)
    before = policy.outputs(row)
    without = []
    for place in range(NUM_SEEN):
        other = row.copy()
        other[0, place] += 100
        without += [place] if np.array_equal(policy.outputs(other), before) else []
    # The kernels see all rows, and 8 of 9 columns.
    unseen = np.zeros((12, 9, 2), bool)
    unseen[:, 8] = True
    color, depth = np.flatnonzero(unseen) + COLOR.start, np.flatnonzero(unseen[..., :1]) + DEPTH.start
    assert without == [*color.tolist(), *depth.tolist()]


def test_a_saved_policy_takes_what_the_environment_gives(tmp_path: Path) -> None:
    made = untrained_policy(ENV, {}, PPOHyperparams(**SMALL), tmp_path)
    save_policy(made.portable, tmp_path)
    policy: Any = load_policy(tmp_path)
    assert policy.portable.network.image == SEEN
    env = gym.make(ENV)
    observation, _ = env.reset(seed=1)
    for _ in range(9):
        parts = [
            np.eye(2)[observation["a_die"]], observation["color"].ravel(), observation["counts"],
            observation["depth"].ravel(), np.eye(3)[observation["digit"]],
        ]  # fmt: skip
        row = np.concatenate(parts).astype(np.float32)
        assert policy.act(observation) == made.outputs(row[None])[0].argmax()
        observation, *_ = env.step(0)
    assert evaluate_policy(policy, env_id=ENV, seeds=[1, 2]).lengths == (10, 10)


@pytest.mark.parametrize("wrong", [
    {"start": COLOR.start + 4}, {"start": 200}, {"start": COLOR.start, "num_channels": 1}, {"num_channels": 3},
], ids=str)  # fmt: skip
def test_a_policy_file_whose_images_lie_elsewhere_is_refused(wrong: dict[str, Any], tmp_path: Path) -> None:
    policy = untrained_policy(ENV, {}, PPOHyperparams(**SMALL), tmp_path)
    save_policy(policy.portable, tmp_path)
    described = json.loads((tmp_path / "policy.json").read_text())
    more = [{"start": DEPTH.start, "num_channels": 1, "scale": 1.0}]
    image = {"shape": [12, 9, 3], "start": 2, "num_beside": 8, "scale": 1 / 255, "more": more}
    assert described["network"]["image"] == image
    described["network"]["image"] = {**image, "more": [more[0] | wrong]}
    (tmp_path / "policy.json").write_text(json.dumps(described))
    with pytest.raises(CheckpointError, match="an image of shape"):
        load_policy(tmp_path)


# -- plans


def notes_of(info: EnvInfo | None = None, **sweep: Any) -> list[str]:
    return env_notes(load_spec({"env": ENV, "algorithm": "ppo", **sweep}), info or info_of())


CONVOLVED: dict[str, Any] = {"hyperparams": {"conv_filters": [[5, 4, 2]]}}


def test_the_plan_says_which_images_are_seen_together() -> None:
    assert (
        "Convolutions see observation['color'] and observation['depth'] as the channels of one image, of (12, 9, 3) "
        "(rows, columns, channels); the dense layers see 8 other numbers beside it."
    ) in notes_of(**CONVOLVED)
    spec = load_spec({"env": ENV, "algorithm": "ppo", **CONVOLVED})
    check_env_rules(spec, info_of(), [PPOHyperparams(), PPOHyperparams(conv_filters=((5, 4, 2),))])
    with pytest.raises(SpecError, match=r"does not fit TestPair-v0: conv_filters\[0\] has kernels of 10"):
        check_env_rules(spec, info_of(), [PPOHyperparams(conv_filters=((4, 10, 1),))])


@pytest.mark.parametrize(("place", "value", "told"), [
    ("observation['color'][0][0][0]", 10.0, "numbers of up to 10, and its space allows 255"),
    ("observation['color'][0][0][0]", 100.0, None),
    ("observation['depth'][0][0][0]", 100.0, "numbers as large as 100 (observation['depth'][0][0][0])"),
])  # fmt: skip
def test_each_image_is_told_by_its_own_sizes(place: str, value: float, told: str | None) -> None:
    notes = [
        note
        for note in notes_of(replace(info_of(), largest=Largest(value, place)), **CONVOLVED)
        if "normalize_observations" in note
    ]
    assert len(notes) == (told is not None)
    assert all(told is not None and told in note for note in notes)


@pytest.mark.parametrize(("second", "hint"), [
    ((40, 30, 1), "hyperparams.conv_filters, such as [[16, 8, 4], [32, 4, 2]], has convolutions see it."),
    ((30, 40, 1), "observes the image alone."),
])  # fmt: skip
def test_a_large_image_without_convolutions_is_told_with_what_fits_it(second: tuple[int, ...], hint: str) -> None:
    screen: gym.Space[Any] = spaces.Box(0, 255, (40, 30, 3), np.uint8)
    members = {"depth": spaces.Box(0.0, 9.0, second, np.float32), "screen": screen}
    (note,) = [
        note
        for note in notes_of(replace(info_of(), observation_space=FlatBox(spaces.Dict(members))))
        if "beside another" in note
    ]
    assert note.startswith("3,600 numbers of these vectors are those of an image, observation['screen']:")
    assert note.endswith(hint)


def test_images_of_other_sizes_are_refused_with_their_names() -> None:
    depth = spaces.Box(0.0, 9.0, (30, 40, 1), np.float32)
    members: dict[str, gym.Space[Any]] = {"depth": depth, "screen": PIXELS, "was": PIXELS}
    info = replace(info_of(), observation_space=FlatBox(spaces.Dict(members)))
    spec = load_spec({"env": ENV, "algorithm": "ppo"})
    with pytest.raises(SpecError, match="with 3 images among their members, of different sizes: conv") as caught:
        check_env_rules(spec, info, [PPOHyperparams(conv_filters=FILTERS)])
    assert caught.value.hint.startswith(
        "Leave hyperparams.conv_filters out, or observe only one of observation['depth'], observation['screen'] and "
        "observation['was']. Those of one height and width are seen together, as the channels of one. Wrap it"
    )


def test_of_many_images_few_are_named() -> None:
    names = [("a",), ("b",), ("c",), ("d",), ("e",), ("f",)]
    assert named_images(names[:1]) == "observation['a']"
    assert named_images(names[:4]) == "observation['a'], observation['b'], observation['c'] and observation['d']"
    assert named_images(names) == "observation['a'], observation['b'], observation['c'] and 3 more"


def test_images_of_nothing_but_their_channels_have_nothing_beside() -> None:
    seen = present(image_seen(FlatBox(spaces.Tuple((PIXELS, PIXELS)))))
    assert (seen.num_beside, seen.places_beside, seen.shape) == (0, (), (4, 5, 6))
