"""Environments that list the actions that are allowed, in place of a mask of zeros and ones."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from policy_factory import registered, untrained_policy

from analysis.page.cards import acting_code
from policies.acting.evaluate import evaluate_policy
from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy, RandomPolicy
from policies.envs.make import check_env, make_env
from policies.envs.mask_hints import UnusedMask
from policies.envs.mask_values import MaskProblemError, listed_mask
from policies.envs.masks import MaskedBox
from policies.envs.spaces import describe_space, space_from_description
from policies.errors import CheckpointError, EnvError, ObservationError, SpecError
from policies.hyperparams import PPOHyperparams
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sections import EnvSpec

pytestmark = pytest.mark.usefixtures("env_plugin")

ENV = "TestForbidding-v0"
LISTS: dict[str, dict[str, Any]] = {
    "info": {"place": "info", "lists": True, "action_mask": {"actions": "action_mask"}},
    "method": {"place": "method", "lists": True, "action_mask": {"actions": "action_masks"}},
}
MASKS: dict[str, dict[str, Any]] = {"info": {"place": "info", "action_mask": True}, "method": {"place": "method"}}
PPO = PPOHyperparams(hidden_sizes=(8,), num_envs=4, train_batch_size=2048, minibatch_size=512, num_epochs=1)


@pytest.mark.parametrize("place", LISTS)
def test_what_is_observed_is_what_a_mask_would_give(place: str) -> None:
    listed, masked = make_env(ENV, LISTS[place]), make_env(ENV, MASKS[place])
    assert listed.observation_space == masked.observation_space
    for seed in range(3):
        one, other = listed.reset(seed=seed)[0], masked.reset(seed=seed)[0]
        for _ in range(16):
            assert np.array_equal(one, other)
            assert set(one[:4].tolist()) <= {0.0, 1.0}
            action = 7 + int(np.flatnonzero(other[:4])[-1])
            one, other = listed.step(action)[0], masked.step(action)[0]
        # At the end of an episode the list is empty.
        assert one[:4].tolist() == other[:4].tolist() == [1, 1, 1, 1]


@pytest.mark.parametrize("place", LISTS)
def test_trials_and_evaluations_keep_to_the_list(place: str) -> None:
    # The environment raises an error otherwise.
    envs = make_packed_envs(ENV, LISTS[place], PPO.num_envs, kind="scalar")
    stack = make_stack(PPO, envs)
    stack.add(new_member("m", PPO, 0, envs.observation_space, envs.action_space), 0)
    assert stack.train_iteration()["m"].num_env_steps == 2048
    assert not envs.errors
    envs.close()
    random = RandomPolicy.for_env(ENV, LISTS[place])
    assert evaluate_policy(random, env_id=ENV, env_args=LISTS[place], seeds=[1, 2]).lengths == (16, 16)


def listing_policy(folder: Path, place: str = "info") -> NetworkPolicy:
    return untrained_policy(ENV, LISTS[place], PPO, folder)


def test_a_policy_takes_lists_as_the_environment_gives_them(tmp_path: Path) -> None:
    policy = listing_policy(tmp_path)
    numbers = np.random.default_rng(0).uniform(-1, 1, (3, 2)).astype(np.float32)
    assert [policy.act(numbers[0], mask=[action]) for action in (7, 8, 9, 10)] == [7, 8, 9, 10]
    assert policy.act(numbers, mask=[[10], (8,), {9}]).tolist() == [10, 8, 9]
    assert policy.act(numbers[:2], mask=np.array([[10], [7]])).tolist() == [10, 7]
    best = policy.act(numbers[0], mask=[7, 8, 9, 10])
    assert policy.act(numbers[0], mask={action: None for action in range(7, 11) if action != best}) != best
    with pytest.raises(ObservationError, match="there is no mask") as caught:
        policy.act(numbers[0])
    assert 'mask=info["action_mask"]' in caught.value.hint
    for mask, words in (
        ([], "forbids every action"),
        ([1, 0, 0, 1], "and 1 is no action: they are numbers from 7 to 10"),
        ([7.5], "not a list of actions, which are numbers from 7 to 10"),
    ):
        with pytest.raises(ObservationError, match=words):
            policy.act(numbers[0], mask=mask)
    with pytest.raises(ObservationError, match="one mask, not one for each of 3"):
        policy.act(numbers, mask=[7, 8, 9])


@pytest.mark.parametrize(
    ("place", "mask"),
    [("info", 'info["action_mask"]'), ("method", 'info["action_masks"])  # or env.get_wrapper_attr(')],
)
def test_the_report_says_where_the_list_is(tmp_path: Path, place: str, mask: str) -> None:
    listing_policy(tmp_path, place)
    assert f"policy.act(observation, mask={mask}" in acting_code(tmp_path)


def test_a_policy_file_says_that_it_takes_lists(tmp_path: Path) -> None:
    space = listing_policy(tmp_path).observation_space
    assert isinstance(space, MaskedBox)
    assert space.lists_from == 7
    again = space_from_description(json.loads(json.dumps(describe_space(space))))
    assert isinstance(again, MaskedBox)
    assert again.lists_from == 7
    stacked = check_env(ENV, {**LISTS["info"], "frame_stack": 2}, "ppo").observation_space
    again = space_from_description(json.loads(json.dumps(describe_space(stacked))))
    assert isinstance(again, MaskedBox)
    assert again.lists_from == 7
    # Policies with masks say nothing of it, and read as ever.
    assert "lists_from" not in json.dumps(describe_space(make_env(ENV, MASKS["info"]).observation_space))
    text = json.loads((tmp_path / "policy.json").read_text())
    for wrong in ("7", 1.5, True):
        text["observation_space"]["mask"]["lists_from"] = wrong
        (tmp_path / "policy.json").write_text(json.dumps(text))
        with pytest.raises(CheckpointError, match="A space is described"):
            load_policy(tmp_path)


@pytest.mark.parametrize(
    "actions", [[3, 1], (1, 3), {1, 3}, np.array([1, 3], np.int16), {3: "c", 1: "a"}, iter([1, 3, 3]), range(1, 4, 2)]
)
def test_what_lists_actions(actions: Any) -> None:
    mask = listed_mask(actions, 5, 0)
    assert mask.dtype == np.float32
    assert mask.tolist() == [0, 1, 0, 1, 0]


@pytest.mark.parametrize(
    ("actions", "first"), [(np.array([100, -100], np.int8), -100), (np.array([0, 200], np.uint8), 0)]
)
def test_small_whole_numbers_list_actions_of_any_start(actions: Any, first: int) -> None:
    mask = listed_mask(actions, 201, first)
    assert np.flatnonzero(mask).tolist() == [0, 200]


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        ([], "which forbids every action"),
        (np.zeros(0), "which forbids every action"),
        (3, "not a list of actions, which are numbers from 0 to 4"),
        (None, "not a list of actions"),
        ("13", "not a list of actions"),
        (["1", "3"], "not a list of actions"),
        ([1.0, 3.0], "not a list of actions"),
        ([True, False, True, True, True], "not a list of actions"),
        ([[1], [2, 3]], "not a list of actions"),
        ([[1, 2], [3, 4]], "not a list of actions"),
        ([1, 5], "and 5 is no action: they are numbers from 0 to 4"),
        ([-1, 2], "and -1 is no action"),
        ([1, 0, 0, 1, 1], "which are zeros and ones and not a list of actions: give its name alone for a mask"),
        (np.ones(5, np.int8), "which are zeros and ones"),
    ],
    ids=str,
)
def test_what_lists_no_actions(actions: Any, words: str) -> None:
    with pytest.raises(MaskProblemError, match=words):
        listed_mask(actions, 5, 0)


class Moves(gym.Env[Any, Any]):
    """Says by an info of any name what may be done."""

    def __init__(self, name: str = "legal_moves", value: Any = (2, 0), actions: Any = None) -> None:
        self.observation_space: Any = spaces.Box(-1, 1, (2,), np.float32)
        self.action_space: Any = spaces.Discrete(3) if actions is None else actions
        self.infos = {name: value, "turn": 1, "scores": [0.5, 0.5]}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), dict(self.infos)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(2, np.float32), 0.0, False, False, dict(self.infos)

    def possible_moves(self) -> list[int]:
        return [1]


MOVES = "TestMoves-v0"


@pytest.fixture(autouse=True)
def _moves() -> Iterator[None]:
    with registered(MOVES, Moves):
        yield


@pytest.mark.parametrize("name", ["legal_moves", "valid_actions", "admissible_actions", "available_actions"])
@pytest.mark.parametrize("value", [[2, 0], np.array([1]), {0: "left"}], ids=str)
def test_a_list_that_is_not_used_is_told(name: str, value: Any) -> None:
    args = {"name": name, "value": value}
    assert check_env(MOVES, args).unused_mask == UnusedMask(f"info[{name!r}]", f"{{actions: {name}}}")
    assert check_env(MOVES, {**args, "action_mask": False}).unused_mask is None
    info = check_env(MOVES, {**args, "action_mask": {"actions": name}})
    assert (info.mask, info.unused_mask) == (f"info[{name!r}]", None)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("invalid_actions", [2, 0]),
        ("illegal_moves", [2, 0]),
        ("unavailable_actions", [0]),
        ("last_actions", [2, 0]),
        ("legal_moves", [3]),
        ("legal_moves", []),
        ("legal_moves", 2),
        ("legal_moves", ["up"]),
        ("valid", [2, 0]),
        (7, [2, 0]),
    ],
)
def test_what_lists_no_actions_that_are_allowed_is_not_told(name: Any, value: Any) -> None:
    assert check_env(MOVES, {"name": name, "value": value}).unused_mask is None


def test_a_list_may_come_from_a_method_of_any_name() -> None:
    args = {"action_mask": {"actions": "possible_moves"}}
    assert check_env(MOVES, args).mask == "possible_moves()"
    assert make_env(MOVES, args).reset(seed=0)[0].tolist() == [0, 1, 0, 0, 0]


def test_a_list_where_a_mask_was_named_and_the_other_way_round() -> None:
    with pytest.raises(EnvError, match=r"gave \(2, 0\) as info\['legal_moves'\].* not 3 zeros and ones") as caught:
        check_env(MOVES, {"action_mask": "legal_moves"})
    assert "write action_mask: {actions: ...} with its name" in caught.value.message
    with pytest.raises(EnvError, match=r"which are zeros and ones and not a list of actions: give its name alone"):
        check_env(MOVES, {"value": [1, 0, 1], "action_mask": {"actions": "legal_moves"}})
    with pytest.raises(
        EnvError, match=r"there is no info\['moves'\] at the beginning of an episode, nor a method; "
    ) as caught:
        check_env(MOVES, {"action_mask": {"actions": "moves"}})
    assert caught.value.hint.startswith("Write env.action_mask: {actions: legal_moves}")
    with pytest.raises(EnvError, match="asks for a mask") as caught:
        check_env(MOVES, {"action_mask": True})
    assert "{actions: legal_moves}" in caught.value.hint


def test_a_member_of_the_observations_is_no_list() -> None:
    args = {"action_mask": {"actions": "action_mask"}}
    with pytest.raises(
        EnvError, match=r"there is no info\['action_mask'\] .*, nor a method; there is nothing"
    ) as caught:
        check_env(ENV, args)
    assert caught.value.hint == "Write env.action_mask: action_mask; or false, if that is no mask."


def test_actions_without_numbers_cannot_be_listed() -> None:
    args = {"actions": spaces.MultiDiscrete([2, 2]), "action_mask": {"actions": "legal_moves"}}
    with pytest.raises(EnvError, match=r"its actions are no single choice \(MultiDiscrete") as caught:
        check_env(MOVES, args, "ppo")
    assert caught.value.hint.endswith("write env.action_mask: legal_moves.")
    with pytest.raises(EnvError, match="its actions are no choices"):
        check_env(MOVES, {**args, "actions": spaces.Box(-1, 1, (2,))}, "ppo")


@pytest.mark.parametrize(
    "setting", [{"actions": ""}, {"actions": 3}, {"acts": "legal"}, {"actions": "a", "b": 1}, {}, []]
)
def test_a_setting_that_is_none_is_refused(setting: Any) -> None:
    with pytest.raises(EnvError, match=r"it must be the name of the mask, \{actions: the name of a list"):
        make_env(MOVES, {"action_mask": setting})
    spec = {"env": {"id": "CartPole-v1", "action_mask": setting}, "algorithm": "ppo"}
    with pytest.raises(SpecError, match=r"it should be a name, \{actions: the name of a list of the actions"):
        load_spec(spec)


def test_a_sweep_file_names_a_list() -> None:
    env = EnvSpec.model_validate({"id": MOVES, "action_mask": {"actions": "legal_moves"}})
    assert env.wrapped_args == {"action_mask": {"actions": "legal_moves"}}
    again = EnvSpec.model_validate(json.loads(env.model_dump_json()))
    assert again == env
    assert env.model_dump(mode="json")["action_mask"] == {"actions": "legal_moves"}
