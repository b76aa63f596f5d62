"""Observations that are no vectors are made some, wherever an environment is made and whatever a policy is given."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from policies.acting.policy import RandomPolicy
from policies.envs.flat import FlatBox, needs_flattening
from policies.envs.make import check_env, make_env, make_vector_env
from policies.envs.own_actions import Choices
from policies.envs.spaces import describe_space, space_from_description
from policies.errors import CheckpointError, EnvError, ObservationError

NUMBERS = spaces.Box(-1, 1, (3,), np.float32)
# Of these Gymnasium makes the same vectors.
VECTORS: dict[str, gym.Space[Any]] = {
    "discrete": spaces.Discrete(16),
    "discrete from 3": spaces.Discrete(5, start=3),
    "multi-discrete": spaces.MultiDiscrete([3, 4], start=[1, -2]),
    "multi-discrete matrix": spaces.MultiDiscrete(cast("Any", [[3, 2], [2, 2]])),
    "multi-binary": spaces.MultiBinary(4),
    "multi-binary matrix": spaces.MultiBinary([2, 3]),
    "whole numbers": spaces.Box(0, 9, (4,), np.int64),
    "bytes": spaces.Box(0, 255, (6,), np.uint8),
    "matrix": spaces.Box(-1, 1, (3, 2), np.float32),
    "infinite matrix": spaces.Box(-np.inf, np.inf, (2, 2), np.float64),
    "four dimensions": spaces.Box(-1, 1, (2, 2, 2, 2), np.float32),
    "row": spaces.Box(-1, 1, (1, 3), np.float32),
    "number": spaces.Box(-1, 1, (), np.float32),
    "dict": spaces.Dict({"z": spaces.Discrete(3), "a": NUMBERS}),
    "tuple": spaces.Tuple((NUMBERS, spaces.Dict({"flags": spaces.MultiBinary(2)}))),
    "dict of tuples": spaces.Dict(
        {"b": spaces.Tuple((spaces.Discrete(2), NUMBERS)), "a": spaces.MultiDiscrete([2, 3])}
    ),
}
IMAGES: dict[str, tuple[spaces.Box, tuple[int, ...], type]] = {
    "grey": (spaces.Box(0, 255, (12, 9), np.uint8), (12, 9, 1), np.uint8),
    "of whole numbers": (spaces.Box(0, 255, (12, 9, 3), np.int64), (12, 9, 3), np.float32),
}
AS_THEY_ARE = [
    NUMBERS, spaces.Box(-1, 1, (3,), np.float64), spaces.Box(0, 255, (8, 8, 3), np.uint8),
    spaces.Box(0, 1, (8, 8, 1), np.float32),
]  # fmt: skip
EnvOf = Callable[[gym.Space[Any]], str]


class Samples(gym.Env[Any, Any]):
    """Observes samples of a space, or what it was told to."""

    def __init__(self, space: gym.Space[Any], told: list[Any]) -> None:
        self.observation_space, self.action_space, self.told = copy.deepcopy(space), spaces.Discrete(2), told

    def _observation(self) -> Any:
        return self.told.pop(0) if self.told else self.observation_space.sample()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._observation(), 0.0, False, False, {}


@pytest.fixture
def told() -> list[Any]:
    return []


@pytest.fixture
def env_of(monkeypatch: pytest.MonkeyPatch, told: list[Any]) -> EnvOf:
    """Registers an environment that observes a space."""
    monkeypatch.setitem(gym.registry, "Samples-v0", None)

    def register(space: gym.Space[Any]) -> str:
        del gym.registry["Samples-v0"]
        gym.register("Samples-v0", cast("Any", lambda: Samples(space, told)))
        return "Samples-v0"

    return register


@pytest.mark.parametrize("kind", VECTORS)
def test_the_vectors_are_gymnasiums_in_one_env_and_in_a_vector(kind: str, env_of: EnvOf) -> None:
    env_id, space = env_of(VECTORS[kind]), VECTORS[kind]
    info = check_env(env_id, None, "ppo")
    made = info.observation_space
    flat = spaces.flatten_space(space)
    assert isinstance(made, FlatBox)
    assert made.dtype == np.float32
    assert made.shape == (flat.shape or (1,))
    assert np.array_equal(made.low.ravel(), cast("spaces.Box", flat).low.ravel().astype(np.float32))
    assert np.array_equal(made.high.ravel(), cast("spaces.Box", flat).high.ravel().astype(np.float32))
    env, envs = make_env(env_id), make_vector_env(env_id, None, 2)
    one, _ = env.reset(seed=5)
    rows, _ = envs.reset(seed=cast("Any", [5, 6]))
    for _ in range(5):
        assert made.contains(one)
        assert rows.dtype == np.float32
        assert np.array_equal(rows[0], one)
        assert rows.shape == (2, *made.shape)
        one, rows = env.step(0)[0], envs.step(np.array([0, 1]))[0]
    for _ in range(20):
        own = space.sample()
        assert np.array_equal(made.flat(own), np.ravel(np.asarray(spaces.flatten(space, own), np.float32)))


@pytest.mark.parametrize("kind", IMAGES)
def test_images_stay_images(kind: str, env_of: EnvOf) -> None:
    space, shape, dtype = IMAGES[kind]
    info = check_env(env_of(space), None, "ppo")
    assert info.observation_space.shape == shape
    assert info.observation_space.dtype == dtype
    assert info.observes_images
    own = space.sample()
    made = cast("FlatBox", info.observation_space).flat(own)
    assert made.dtype == dtype
    assert np.array_equal(made.reshape(own.shape), own)


@pytest.mark.parametrize("space", AS_THEY_ARE, ids=str)
def test_vectors_and_images_are_left_as_they_are(space: spaces.Box, env_of: EnvOf) -> None:
    assert not needs_flattening(space)
    assert type(check_env(env_of(space), None, "ppo").observation_space) is spaces.Box


@pytest.mark.parametrize(
    ("space", "place"),
    [
        (spaces.Graph(NUMBERS, None), "observation is of kind Graph"),
        (spaces.Dict({"a": NUMBERS, "b": spaces.Sequence(NUMBERS)}), r"observation\['b'\] is of kind Sequence"),
        (spaces.Tuple((NUMBERS, spaces.Dict({"t": spaces.Text(4)}))), r"observation\[1\]\['t'\] is of kind Text"),
        (spaces.Box(-1, 1, (0,), np.float32), "have 0 numbers"),
        (spaces.Discrete(10**9), "have 1,000,000,000 numbers"),
    ],
    ids=str,
)
def test_a_member_of_which_no_vector_can_be_made_is_named(space: gym.Space[Any], place: str, env_of: EnvOf) -> None:
    with pytest.raises(EnvError, match=place):
        check_env(env_of(space), None, "ppo")


@pytest.mark.parametrize("shape", [(1,), (1, 1)])
@pytest.mark.parametrize("alone", [0.5, np.float32(0.5), np.array(0.5)])
def test_a_number_alone_is_one_of_a_single_number(shape: tuple[int, ...], alone: Any) -> None:
    space = FlatBox(spaces.Dict({"force": spaces.Box(0, 1, shape, np.float32), "pole": NUMBERS}))
    observation = {"force": alone, "pole": np.array([0.1, 0.2, 0.3], np.float32)}
    np.testing.assert_array_equal(space.flat(observation), np.array([0.5, 0.1, 0.2, 0.3], np.float32))


def test_a_number_alone_is_not_several() -> None:
    with pytest.raises(ValueError, match=r"0.5 as observation\['pole'\], not numbers of shape \(3,\)"):
        FlatBox(spaces.Dict({"pole": NUMBERS})).flat({"pole": 0.5})


@pytest.mark.parametrize(
    ("kind", "observation", "words"),
    [
        ("discrete", 16, "16 as observation, which is outside of Discrete"),
        ("discrete from 3", 2, "2 as observation, which is outside of Discrete"),
        ("discrete", 0.5, "0.5 as observation, not whole numbers"),
        ("multi-binary", [0, 2, 0, 0], "not zeros and ones"),
        ("matrix", [[1.0, 2.0]], r"not numbers of shape \(3, 2\)"),
        ("dict", {"z": 1}, "with no member 'a'"),
        ("dict", 3, "3 as observation, that is no dict"),
        ("tuple", ([0, 0, 0],), "with no member 1"),
        ("tuple", ([0, 0, 0], {"flags": "none"}), r"'none' as observation\[1\]\['flags'\], not numbers"),
    ],
)
def test_an_observation_that_leaves_its_space_is_refused_with_its_place(
    kind: str, observation: Any, words: str, env_of: EnvOf, told: list[Any]
) -> None:
    told.append(observation)
    with pytest.raises(EnvError, match=rf"reset\(\) of Samples-v0 returns .*{words}"):
        check_env(env_of(VECTORS[kind]), None, "ppo")
    told[:] = [VECTORS[kind].sample(), VECTORS[kind].sample(), observation]
    env = make_env("Samples-v0")
    env.reset()
    env.step(0)
    with pytest.raises(ValueError, match=words):
        env.step(0)


@pytest.mark.parametrize("kind", [*VECTORS, *IMAGES])
def test_a_policy_takes_what_the_environment_gives_and_what_was_made_of_it(kind: str) -> None:
    space = VECTORS[kind] if kind in VECTORS else IMAGES[kind][0]
    made, seen = FlatBox(space), []

    class Noting(RandomPolicy):
        def _act_batch(self, observations: Any) -> Any:
            seen.append(observations)
            return super()._act_batch(observations)

    policy = Noting(made, spaces.Discrete(3), env_id="x")
    own = [space.sample() for _ in range(3)]
    wanted = np.stack([made.flat(one) for one in own])
    assert isinstance(policy.act(own[0]), int)
    assert isinstance(policy.act(wanted[0]), int)
    for batch in (own, wanted):
        assert np.shape(policy.act(batch)) == (3,)
    assert policy.act_on_rows(wanted[:1]).shape == (1,)
    assert all(np.array_equal(found, wanted[: len(found)]) for found in seen)
    assert len(seen) == 5


def test_a_policy_says_what_it_wanted() -> None:
    policy = RandomPolicy(FlatBox(VECTORS["dict"]), spaces.Discrete(3), env_id="x")
    with pytest.raises(
        ObservationError, match=r"Observations of x must be of Dict.*, or numbers of shape \(6,\): .*'a'"
    ):
        policy.act({"z": 1})
    with pytest.raises(ObservationError, match=r"of shape \(4,\)"):
        policy.act([1.0, 2.0, 3.0, 4.0])


@pytest.mark.parametrize("kind", [*VECTORS, *IMAGES])
def test_the_space_is_described_and_read_again(kind: str) -> None:
    made = FlatBox(VECTORS[kind] if kind in VECTORS else IMAGES[kind][0])
    read = space_from_description(json.loads(json.dumps(describe_space(made))))
    assert isinstance(read, FlatBox)
    assert read.original == made.original
    assert read == made


def test_members_of_a_dict_keep_the_order_that_the_env_gave_them() -> None:
    """Gymnasium sorts the keys of a dict, and of nothing else; two spaces of other orders are equal to it."""
    inner = spaces.Dict([("z", spaces.Discrete(2)), ("a", spaces.Discrete(3))])
    box = spaces.Box(-9.0, 9.0, (1,))
    made = FlatBox(spaces.Dict(velocity=box, inner=inner, angle=box))
    read = space_from_description(json.loads(json.dumps(describe_space(made))))
    assert isinstance(read, FlatBox)
    observation = {"angle": [2.0], "velocity": [1.0], "inner": {"a": 1, "z": 1}}
    assert made.flat(observation).tolist() == [1, 0, 1, 0, 1, 0, 2]
    np.testing.assert_array_equal(read.flat(observation), made.flat(observation))
    for original, action in ((inner, [1, 2]), (spaces.Dict(steer=spaces.Discrete(2), gas=spaces.Discrete(2)), [1, 0])):
        choices = Choices(original)
        again = space_from_description(json.loads(json.dumps(describe_space(choices))))
        assert isinstance(again, Choices)
        assert again.own(np.array(action)) == choices.own(np.array(action))
        assert list(again.own(np.array(action)).values()) == action


def test_members_may_be_named_by_tuples_and_numbers(env_of: EnvOf) -> None:
    named = cast("Callable[[Any], spaces.Dict]", spaces.Dict)
    inner = named([(("a", (1, None)), spaces.Discrete(2)), (("b", (2, None)), spaces.Discrete(3))])
    original = named([(1, inner), (2, spaces.Discrete(2))])
    info = check_env(env_of(original), None)
    read = space_from_description(json.loads(json.dumps(describe_space(info.observation_space))))
    assert isinstance(read, FlatBox)
    assert read.original == original
    observation = {1: {("a", (1, None)): 1, ("b", (2, None)): 0}, 2: 1}
    assert read.flat(observation).tolist() == [0, 1, 1, 0, 0, 0, 1]
    choices = space_from_description(json.loads(json.dumps(describe_space(Choices(original)))))
    assert isinstance(choices, Choices)
    assert choices.own(np.array([1, 0, 1])) == observation


@pytest.mark.parametrize("key", [b"far", ("a", np.int64(3)), frozenset("a")], ids=str)
def test_a_member_whose_name_no_file_can_hold_is_refused_in_words_about_the_env(key: Any, env_of: EnvOf) -> None:
    named: Any = spaces.Dict([("x", spaces.Discrete(2)), ("y", spaces.Dict([(key, spaces.Discrete(2))]))])
    with pytest.raises(EnvError) as caught:
        check_env(env_of(named), None)
    assert caught.value.message.startswith(f"Samples-v0 has observations with a member {key!r}")
    assert "by texts, by numbers, or by tuples of these" in caught.value.hint


@pytest.mark.parametrize(
    "change",
    [
        {"shape": [7]},
        {"made_of": {"type": "dict", "members": [["a", {"type": "graph"}]]}},
        {"made_of": {"type": "discrete", "n": 10**12}},
        {"made_of": {"type": "multi_binary", "shape": [10**6, 10**6]}},
        {"made_of": 3},
    ],
    ids=str,
)
def test_a_damaged_description_is_refused(change: dict[str, Any]) -> None:
    description = {**describe_space(FlatBox(VECTORS["dict"])), **change}
    with pytest.raises(CheckpointError, match="A space is described as"):
        space_from_description(description)


def test_an_environment_with_a_vectorised_version_is_stepped_one_by_one_if_that_observes_no_vectors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    closed: list[int] = []

    class Many(gym.vector.SyncVectorEnv):
        def __init__(self, num_envs: int) -> None:
            super().__init__([lambda: Samples(spaces.Discrete(4), [])] * num_envs)

        def close_extras(self, **kwargs: Any) -> None:
            super().close_extras(**kwargs)
            closed.append(self.num_envs)

    monkeypatch.setitem(gym.registry, "Many-v0", None)
    del gym.registry["Many-v0"]
    one = cast("Any", lambda: Samples(spaces.Discrete(4), []))
    gym.register("Many-v0", one, vector_entry_point=cast("Any", Many))
    assert not check_env("Many-v0", None, "dqn").has_vector_entry_point
    envs = make_vector_env("Many-v0", None, 2)
    assert closed == [2]
    rows, _ = envs.reset(seed=0)
    assert rows.shape == (2, 4)
    assert rows.sum() == 2
