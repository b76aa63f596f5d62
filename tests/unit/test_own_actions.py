"""Actions of any form are made of what policies give, wherever an environment is made; `act` gives the env's own."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import json
import pickle
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from policy_factory import make_portable, registered

from policies.acting.baselines import ConstantPolicy
from policies.acting.evaluate import evaluate_policy
from policies.acting.live import watch_episode
from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy, RandomPolicy
from policies.envs.action_bounds import ToBounds
from policies.envs.make import check_env, make_env, make_vector_env
from policies.envs.own_actions import Choices, Numbers, is_taken, made_of, own_actions
from policies.envs.spaces import describe_space, space_from_description
from policies.errors import CheckpointError, EnvError, SpecError
from policies.hyperparams import PPOHyperparams
from policies.packed.initial import new_member
from policies.packed.portable_member import portable_policy
from policies.portable.file import save_policy

pytestmark = pytest.mark.usefixtures("env_plugin")

CHOICES: dict[str, tuple[gym.Space[Any], tuple[int, ...]]] = {
    "multi-discrete": (spaces.MultiDiscrete([3, 2]), (3, 2)),
    "from 1 and -2": (spaces.MultiDiscrete([3, 2], start=[1, -2]), (3, 2)),
    "matrix": (spaces.MultiDiscrete(cast("Any", [[3, 2], [2, 1]])), (3, 2, 2, 1)),
    "bytes": (spaces.MultiDiscrete([2, 2], dtype=cast("Any", np.uint8)), (2, 2)),
    "bits": (spaces.MultiBinary(3), (2, 2, 2)),
    "matrix of bits": (spaces.MultiBinary([1, 2]), (2, 2)),
    "one in a tuple": (spaces.Tuple((spaces.Discrete(4, start=5),)), (4,)),
    "nested": (
        spaces.Dict({"b": spaces.Tuple((spaces.Discrete(2), spaces.MultiBinary(1))), "a": spaces.Discrete(3)}),
        (3, 2, 2),
    ),
}
NUMBERS: dict[str, gym.Space[Any]] = {
    "matrix": spaces.Box(-1, 3, (2, 2), np.float64),
    "number": spaces.Box(-2, 2, (), np.float32),
    "half precision": spaces.Box(0, 0.1, (1, 2), np.float16),
    "whole numbers": spaces.Box(-3, 4, (3,), np.int64),
    "bytes": spaces.Box(0, 255, (1, 2), np.uint8),
    "all whole numbers": spaces.Box(np.iinfo(np.int64).min, np.iinfo(np.int64).max, (2,), np.int64),
    "bounds of their own": spaces.Box(np.array([[-1.0], [0.0]]), np.array([[5.0], [np.inf]]), dtype=np.float32),
    "dict": spaces.Dict({"z": spaces.Box(0, 1, (2,)), "a": spaces.Tuple((spaces.Box(-9, 9, (1, 1), np.int8),))}),
}
ALL = {**{f"choices: {name}": space for name, (space, _) in CHOICES.items()}, **NUMBERS}


@pytest.mark.parametrize("kind", CHOICES)
def test_every_action_is_one_of_the_choices(kind: str) -> None:
    space, sizes = CHOICES[kind]
    made = made_of(space)
    assert isinstance(made, Choices)
    assert made.sizes == sizes
    assert made.nvec.tolist() == list(sizes)
    assert not made.start.any()
    owns = [made.own(np.array(choices)) for choices in itertools.product(*map(range, sizes))]
    assert all(space.contains(own) for own in owns)
    given = [made.given_for(own).tolist() for own in owns]
    assert given == [list(choices) for choices in itertools.product(*map(range, sizes))]
    assert len({pickle.dumps(own) for own in owns}) == np.prod(sizes)


def test_a_choice_of_an_env_is_a_plain_number() -> None:
    own = made_of(CHOICES["nested"][0]).own(np.array([2, 1, 0]))
    assert type(own["a"]) is int
    assert own["a"] == 2
    assert type(own["b"]) is tuple
    assert own["b"][0] == 1
    assert own["b"][1].tolist() == [0]


@pytest.mark.parametrize("kind", NUMBERS)
def test_every_vector_is_an_action_and_its_bounds_are_the_spaces(kind: str) -> None:
    space = NUMBERS[kind]
    made = made_of(space)
    assert isinstance(made, Numbers)
    assert np.issubdtype(made.dtype, np.floating)
    to_bounds, rng = ToBounds(made), np.random.default_rng(0)
    for size in (0.5, 1.0, 30.0, 1e30):
        for _ in range(20):
            drawn = (size * rng.normal(size=made.shape)).astype(np.float32)
            own = made.own(to_bounds(drawn))
            assert space.contains(own)
            assert pickle.dumps(made.own(made.given_for(own))) == pickle.dumps(own)
    least, most = (spaces.flatten(space, made.own(to_bounds(np.full(made.shape, side)))) for side in (-9.0, 9.0))
    for found, bound in ((least, made.low), (most, made.high)):
        is_finite = np.isfinite(bound)
        np.testing.assert_allclose(found[is_finite], bound[is_finite], rtol=1e-3)


def test_whole_numbers_are_rounded_to_the_nearest() -> None:
    made = made_of(NUMBERS["whole numbers"])
    assert made.own(np.array([0.4, -2.6, 3.51], np.float32)).tolist() == [0, -3, 4]


ENDLESS: dict[str, tuple[gym.Space[Any], list[int]]] = {
    "one bound": (spaces.Box(0, np.inf, (2,), np.int64), [3, 0]),
    "the other": (spaces.Box(-np.inf, 1, (2,), np.int64), [1, -7]),
    "none": (spaces.Box(-np.inf, np.inf, (2,), np.int32), [3, -7]),
    "written out": (spaces.Box(np.array([0, -99]), np.full(2, np.iinfo(np.int64).max), dtype=np.int64), [3, -7]),
    "as Gymnasium asks": (spaces.Box(0, 2**63 - 2, (2,), np.int64), [3, 0]),
    "of 32 bits": (spaces.Box(-99, np.iinfo(np.int32).max - 1, (2,), np.int32), [3, -7]),
    "the least that is drawn": (spaces.Box(np.iinfo(np.int32).min + 2, 1, (2,), np.int32), [1, -7]),
}


@pytest.mark.parametrize("is_read", [False, True])
@pytest.mark.parametrize("kind", ENDLESS)
def test_whole_numbers_with_one_bound_or_none_are_not_stretched(kind: str, is_read: bool) -> None:
    def made(space: gym.Space[Any]) -> Any:
        found = made_of(space)
        return space_from_description(json.loads(json.dumps(describe_space(found)))) if is_read else found

    space, wanted = ENDLESS[kind]
    alone = made(space)
    assert not ToBounds(alone).stretches_all
    assert alone.own(ToBounds(alone)(np.array([3.2, -7.0], np.float32))).tolist() == wanted
    beside = made(spaces.Dict({"a": space, "b": spaces.Box(-2, 6, (1,), np.int16)}))
    own = beside.own(ToBounds(beside)(np.array([3.2, -7.0, 0.5], np.float32)))
    assert (own["a"].tolist(), own["b"].tolist()) == (wanted, [4])


@pytest.mark.parametrize("kind", ["one bound", "the other", "none"])
def test_a_space_that_was_read_draws_what_the_envs_own_does(kind: str) -> None:
    space = copy.deepcopy(ENDLESS[kind][0])
    read = space_from_description(json.loads(json.dumps(describe_space(made_of(space)))))
    for seed in range(5):
        space.seed(seed)
        read.seed(seed)
        assert read.sample().tolist() == space.sample().tolist()


@pytest.mark.parametrize("kind", ENDLESS)
def test_what_is_made_draws_what_it_does_once_it_is_read(kind: str) -> None:
    given: Any = ENDLESS[kind][0]
    own = copy.deepcopy(given)
    made = made_of(own)
    read = space_from_description(json.loads(json.dumps(describe_space(made))))
    for seed in range(5):
        made.seed(seed)
        read.seed(seed)
        drawn = made.sample()
        assert drawn.tolist() == read.sample().tolist()
        assert own.contains(made.own(drawn))
        # Near a bound that it has, and not anywhere in all that the type holds.
        assert np.all(np.abs(drawn) < 120)
    # The space that it was given is left as it was.
    assert np.array_equal(own.bounded_above, given.bounded_above)


class Endless(gym.Env[Any, Any]):
    """Takes all whole numbers from 0."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, most: int) -> None:
        self.action_space = spaces.Box(0, most, (2,), np.int64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        return np.zeros(2, np.float32), 1.0, False, True, {}


@pytest.mark.parametrize("most", [2**63 - 1, 2**63 - 2])
def test_an_env_whose_whole_numbers_end_with_their_type_is_checked(most: int) -> None:
    with registered("TestEndless-v0", Endless):
        info = check_env("TestEndless-v0", {"most": most}, "ppo")
    assert isinstance(info.action_space, Numbers)
    assert np.all(np.isposinf(info.action_space.high))


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint32, np.uint64])
def test_whole_numbers_of_few_bits_and_without_a_sign_are_stretched_over_all_of_them(dtype: Any) -> None:
    least, most = np.iinfo(dtype).min, np.iinfo(dtype).max
    made = made_of(spaces.Box(least, most, (3,), dtype))
    found = made.own(ToBounds(cast("Any", made))(np.array([-1, 0, 1], np.float32)))
    assert (found[0], found[2]) == (least, most)
    assert found[1] == pytest.approx((float(least) + float(most)) / 2, rel=1e-6, abs=1)


@pytest.mark.parametrize("kind", ALL)
def test_the_space_is_described_copied_and_read_again(kind: str) -> None:
    made = made_of(ALL[kind])
    for other in (
        space_from_description(json.loads(json.dumps(describe_space(made)))), copy.deepcopy(made),
        pickle.loads(pickle.dumps(made)),
    ):  # fmt: skip
        assert type(other) is type(made)
        assert other.original == made.original
        assert other == made


@pytest.mark.parametrize(
    "change", [{"nvec": [3]}, {"sent_as": {"type": "discrete", "n": 0}}, {"sent_as": 3}, {"sent_as": None}], ids=str
)
def test_a_damaged_description_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(CheckpointError, match="A space is described as"):
        space_from_description({**describe_space(made_of(CHOICES["nested"][0])), **change})


def test_what_policies_give_is_left_as_it_is() -> None:
    assert is_taken(spaces.Discrete(3, start=2))
    assert is_taken(spaces.Box(-1, 2, (3,), np.float64))
    assert type(check_env("Pendulum-v1", None, "ppo").action_space) is spaces.Box


@pytest.mark.parametrize("kind", ["multi-discrete", "dict of choices", "whole numbers", "dict of numbers"])
def test_one_env_and_a_vector_take_what_policies_give(kind: str) -> None:
    # The environment refuses an action that is not in its own space.
    env, envs = make_env("TestReply-v0", {"kind": kind}), make_vector_env("TestReply-v0", {"kind": kind}, 2)
    env.reset(seed=0)
    envs.reset(seed=0)
    assert envs.single_action_space == env.action_space
    for _ in range(20):
        action = env.action_space.sample()
        observation, *_ = env.step(action)
        assert env.observation_space.contains(observation)
        envs.step(np.stack([action, env.action_space.sample()]))


def saved_policy(kind: str, folder: Path) -> Any:
    env_args, info = {"kind": kind}, check_env("TestReply-v0", {"kind": kind}, "ppo")
    member = new_member("t0000", PPOHyperparams(hidden_sizes=(8,)), 3, info.observation_space, info.action_space)
    portable = portable_policy(
        member, info.observation_space, info.action_space, env_id="TestReply-v0", env_args=env_args, training={}
    )
    save_policy(portable, folder)
    return load_policy(folder)


@pytest.mark.parametrize("kind", ["multi-discrete", "multi-binary", "dict of choices", "matrix", "dict of numbers"])
def test_a_policy_acts_in_the_envs_own_form(kind: str, tmp_path: Path) -> None:
    policy, own = saved_policy(kind, tmp_path), gym.make("TestReply-v0", kind=kind)
    space = own.action_space
    observations = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    rows = policy.act_on_rows(observations)
    batch = policy.act(observations)
    assert len(batch) == 5
    for observation, row, one in zip(observations, rows, batch, strict=True):
        assert space.contains(policy.act(observation))
        assert pickle.dumps(policy.act(observation)) == pickle.dumps(policy.action_space.own(row))
        flat, alone = (np.asarray(spaces.flatten(space, action)) for action in (one, policy.act(observation)))
        assert np.array_equal(flat, alone)
    assert len(own_actions(policy.action_space, rows[:0])) == 0
    if isinstance(policy.action_space, Choices):
        logits = np.split(policy.outputs(observations), np.cumsum(policy.action_space.sizes)[:-1], axis=1)
        assert rows.tolist() == np.stack([block.argmax(axis=1) for block in logits], axis=1).tolist()


@pytest.mark.parametrize("kind", ["multi-discrete", "tuple of choices", "dict of numbers"])
def test_a_class_of_somebodys_own_acts_in_that_form_too(kind: str, tmp_path: Path) -> None:
    env_args = {"kind": kind}
    policy = saved_policy(kind, tmp_path)

    class Own(NetworkPolicy):
        def act(self, observations: Any, mask: Any = None) -> Any:
            return super().act(observations, mask)

    own = Own(policy.portable)
    # The environment refuses an action that is not in its own space.
    assert evaluate_policy(own, env_id="TestReply-v0", env_args=env_args, seeds=range(4)) == evaluate_policy(
        policy, env_id="TestReply-v0", env_args=env_args, seeds=range(4)
    )
    _, steps = watch_episode(own, "TestReply-v0", env_args, 1)
    _, others = watch_episode(policy, "TestReply-v0", env_args, 1)
    assert [step.action for step in steps] == [step.action for step in others]


def test_baselines_have_such_actions_too() -> None:
    info = check_env("TestReply-v0", {"kind": "tuple of choices"}, "ppo")
    own = gym.make("TestReply-v0", kind="tuple of choices").action_space
    draws = RandomPolicy(info.observation_space, info.action_space, env_id="x", seed=1)
    observation = np.zeros(2, np.float32)
    drawn = [draws.act(observation) for _ in range(200)]
    assert all(own.contains(action) for action in drawn)
    assert len({str(action) for action in drawn}) == 12
    always = ConstantPolicy(info.observation_space, info.action_space, (1.0, 2.0, 0.0), env_id="x")
    first, second = always.act(observation)
    assert (first, second.tolist()) == (4, [2, 0])
    for wrong in ((1.0, 3.0, 0.0), (0.5, 0.0, 0.0), (-1.0, 0.0, 0.0), 1):
        with pytest.raises(SpecError, match="none of the actions"):
            ConstantPolicy(info.observation_space, info.action_space, cast("Any", wrong), env_id="x")


def test_dqn_has_one_choice_alone() -> None:
    with pytest.raises(EnvError, match="its actions are 2 choices at once") as caught:
        check_env("TestReply-v0", {"kind": "multi-binary"}, "dqn")
    assert "Use 'algorithm: ppo'" in caught.value.hint
    with pytest.raises(EnvError, match="its actions are continuous"):
        check_env("TestReply-v0", {"kind": "matrix"}, "dqn")


def test_who_watches_sees_the_choices(tmp_path: Path) -> None:
    policy = saved_policy("multi-discrete", tmp_path)
    info, steps = watch_episode(policy, "TestReply-v0", {"kind": "multi-discrete"}, 5)
    assert (info.actions.low, info.actions.high) == ([0.0, 0.0], [1.0, 2.0])
    shown = list(steps)
    assert len(shown) == 17
    assert shown[1].action is not None
    assert shown[1].scores is None


def test_a_network_of_other_outputs_is_refused(tmp_path: Path) -> None:
    portable = make_portable("Acrobot-v1")  # six observations, three actions
    space = describe_space(made_of(spaces.MultiBinary(2)))
    with pytest.raises(CheckpointError, match="has 3 outputs, but its actions need 4"):
        save_policy(dataclasses.replace(portable, action_space=space), tmp_path)


class Refuses(gym.Env[Any, Any]):
    """Takes none of its own actions."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Dict({"force": spaces.Box(-9, 9, (1,), np.float32)})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        raise ValueError("no array is taken")


def test_a_first_step_that_fails_is_told_with_the_action_as_the_env_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gym.registry, "Refuses-v0", None)
    del gym.registry["Refuses-v0"]
    gym.register("Refuses-v0", cast("Any", Refuses))
    with pytest.raises(EnvError, match=r"with the action \{'force': array\(\[[-.\d]+\].*\)\} after a reset: Value"):
        check_env("Refuses-v0", None, "ppo")
