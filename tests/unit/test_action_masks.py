"""Masks of actions: where they come from, what is no mask, and that nothing that is forbidden is ever done."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from policy_factory import untrained_policy

from analysis.page.cards import acting_code
from policies.acting.baselines import ConstantPolicy
from policies.acting.evaluate import Evaluator, evaluate_policy
from policies.acting.live import watch_episode
from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy, RandomPolicy
from policies.envs.flat import FlatBox
from policies.envs.make import EnvInfo, check_env, make_env, make_vector_env
from policies.envs.mask_hints import UnusedMask
from policies.envs.masks import FORBIDDEN, MaskedBox
from policies.envs.spaces import describe_space, space_from_description
from policies.errors import CheckpointError, EnvError, ObservationError
from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams
from policies.packed.envs.make import check_seedable, make_packed_envs, measure_step
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from policies.packed.sampling import allowed_at, mask_outputs

pytestmark = pytest.mark.usefixtures("env_plugin")

ENV = "TestForbidding-v0"
PLACES: dict[str, dict[str, Any]] = {
    "observation": {},
    "method": {"place": "method"},
    "info": {"place": "info", "action_mask": True},
}
SMALL: dict[str, Any] = {"hidden_sizes": (8,), "num_envs": 4}
PPO = PPOHyperparams(**SMALL, train_batch_size=2048, minibatch_size=512, num_epochs=1)
DQN = DQNHyperparams(
    **SMALL, env_steps_per_iteration=2048, train_freq=64, updates_per_env_step=0.01, learning_starts=64,
    train_batch_size=32, epsilon_initial=1.0, epsilon_final=1.0, epsilon_decay=1, gamma=0.5,
)  # fmt: skip


def policy_of(hyperparams: TrainedHyperparams, env_args: dict[str, Any], folder: Path) -> NetworkPolicy:
    """One with random weights, from its file."""
    return untrained_policy(ENV, env_args, hyperparams, folder)


@pytest.mark.parametrize(("place", "given"), [("observation", ""), ("method", ", mask="), ("info", ", mask=")])
def test_the_report_says_how_to_act_with_a_mask(tmp_path: Path, place: str, given: str) -> None:
    policy_of(PPO, PLACES[place], tmp_path / "best")
    assert f"policy.act(observation{given}" in acting_code(tmp_path / "best")
    assert acting_code(tmp_path / "best").endswith("(observation)") is (given == "")
    assert acting_code(tmp_path / "nothing") == "action = policy.act(observation)"


@pytest.mark.parametrize(
    ("env_args", "mask"),
    [
        ({"place": "method"}, 'env.get_wrapper_attr("action_masks")()'),
        ({"place": "info", "action_mask": True}, 'info["action_mask"]'),
        ({"place": "info", "action_mask": "action_mask"}, 'info["action_mask"]'),
    ],
)
def test_the_report_says_where_this_environment_has_its_mask(
    tmp_path: Path, env_args: dict[str, Any], mask: str
) -> None:
    policy = policy_of(PPO, env_args, tmp_path / "best")
    code = acting_code(tmp_path / "best")
    assert code.partition("mask=")[2].startswith(f"{mask})")
    env = gym.make(ENV, **{name: value for name, value in env_args.items() if name != "action_mask"})
    observation, info = env.reset(seed=0)
    known: dict[str, Any] = {"policy": policy, "observation": observation, "env": env, "info": info}
    exec(code, known)
    assert env.action_space.contains(known["action"])


@pytest.mark.parametrize("place", PLACES)
def test_what_is_observed_begins_with_the_mask(place: str) -> None:
    info = check_env(ENV, PLACES[place], "dqn")
    assert isinstance(info.observation_space, MaskedBox)
    assert info.observation_space.shape == (6,)
    assert info.mask == {
        "observation": "observation['action_mask']", "method": "action_masks()", "info": "info['action_mask']"
    }[place]  # fmt: skip
    assert not info.has_vector_entry_point
    env, envs = make_env(ENV, PLACES[place]), make_vector_env(ENV, PLACES[place], 2)
    own: Any = env.unwrapped
    one, _ = env.reset(seed=5)
    rows, _ = envs.reset(seed=5)
    for _ in range(15):
        assert info.observation_space.contains(one)
        assert one[:4].tolist() == own.mask.tolist()
        assert np.array_equal(rows[0], one)
        action = 7 + int(np.flatnonzero(own.mask)[-1])
        other = 7 + int(np.flatnonzero(rows[1][:4])[0])
        one, rows = env.step(action)[0], envs.step(np.array([action, other]))[0]
    # Where an episode has terminated, nothing has to be allowed.
    one, _, terminated, *_ = env.step(7 + int(np.flatnonzero(own.mask)[0]))
    assert terminated
    assert one[:4].tolist() == [1, 1, 1, 1]


def test_frames_are_stacked_behind_the_newest_mask() -> None:
    args = {"frame_stack": 3}
    info = check_env(ENV, args, "ppo")
    assert isinstance(info.observation_space, MaskedBox)
    assert (info.observation_space.shape, info.observation_space.seen.shape) == ((10,), (6,))
    env, envs, plain = make_env(ENV, args), make_vector_env(ENV, args, 1), make_env(ENV)
    frames = [plain.reset(seed=1)[0]] * 3
    (rows, _), (stack, _) = envs.reset(seed=1), env.reset(seed=1)
    for _ in range(10):
        wanted = np.concatenate([frames[-1][:4], *(frame[4:] for frame in frames)])
        assert np.array_equal(stack, wanted)
        assert np.array_equal(rows[0], wanted)
        action = 7 + int(np.flatnonzero(stack[:4])[0])
        frames = [*frames[1:], plain.step(action)[0]]
        stack, rows = env.step(action)[0], envs.step(np.array([action]))[0]
    again = space_from_description(json.loads(json.dumps(describe_space(info.observation_space))))
    assert isinstance(again, MaskedBox)
    assert again == info.observation_space
    assert again.seen.shape == (6,)


def test_an_info_that_looks_like_a_mask_is_told_and_not_used() -> None:
    info = check_env("Taxi-v3", None, "dqn")
    assert (info.mask, info.unused_mask) == (None, UnusedMask("info['action_mask']", "true"))
    info = check_env("Taxi-v3", {"action_mask": "action_mask"}, "dqn")
    assert (info.mask, info.unused_mask) == ("info['action_mask']", None)
    assert info.observation_space.shape == (506,)
    assert check_env("CartPole-v1", None, "dqn").unused_mask is None


class Odd(gym.Env[Any, Any]):
    """Of any spaces."""

    def __init__(self, observations: gym.Space[Any], actions: gym.Space[Any]) -> None:
        self.observation_space, self.action_space = observations, actions

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {"action_mask": np.ones(2, np.int8)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {"action_mask": np.ones(2, np.int8)}


NUMBERS: gym.Space[Any] = spaces.Box(-1, 1, (3,), np.float32)
TWO: gym.Space[Any] = spaces.Discrete(2)


def with_mask(mask: gym.Space[Any]) -> spaces.Dict:
    return spaces.Dict({"seen": NUMBERS, "action_mask": mask})


def odd(monkeypatch: pytest.MonkeyPatch, observations: gym.Space[Any], actions: gym.Space[Any], mask: Any) -> EnvInfo:
    monkeypatch.setitem(gym.registry, "Odd-v0", None)
    del gym.registry["Odd-v0"]
    gym.register("Odd-v0", lambda: Odd(observations, actions))  # type: ignore[arg-type]
    return check_env("Odd-v0", None if mask is None else {"action_mask": mask}, "ppo")


@pytest.mark.parametrize(
    ("observations", "actions", "mask", "words"),
    [
        (with_mask(spaces.MultiBinary(3)), TWO, None, r"'action_mask', of MultiBinary\(3\), but there are 2 actions"),
        (
            spaces.Dict({"action_mask": spaces.MultiBinary(2)}),
            TWO,
            None,
            "a mask of actions, 'action_mask', and nothing",
        ),
        (NUMBERS, NUMBERS, "action_mask", "its actions are no choices"),
        (NUMBERS, TWO, "legal", r"there is no info\['legal'\] at the beginning of an episode, nor .*\['action_mask'\]"),
        (spaces.Box(0, 255, (8, 8, 0), np.uint8), TWO, "action_mask", "its observations have 0 numbers"),
        (NUMBERS, TWO, 3, "action_mask is 3; it must be the name"),
        (NUMBERS, NUMBERS, True, "has action_mask True, but its actions are no choices"),
        (NUMBERS, TWO, "", "action_mask is ''; it must be the name"),
        (with_mask(spaces.Box(0, 9, (2,), np.int8)), TWO, None, "at the beginning of an episode, not zeros and ones"),
    ],
)
def test_what_cannot_be_a_mask_is_refused_before_anything_starts(
    observations: gym.Space[Any], actions: gym.Space[Any], mask: Any, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    observations = copy.deepcopy(observations)
    observations.seed(0)
    with pytest.raises(EnvError, match=words):
        odd(monkeypatch, observations, actions, mask)


def test_a_mask_that_is_not_wanted_is_observed_as_any_member(monkeypatch: pytest.MonkeyPatch) -> None:
    info = odd(monkeypatch, with_mask(spaces.MultiBinary(2)), TWO, False)
    assert isinstance(info.observation_space, FlatBox)
    assert info.observation_space.shape == (5,)
    assert info.mask is None
    assert type(make_env(ENV, {"place": "method", "action_mask": False}).observation_space) is spaces.Box
    policy = RandomPolicy(info.observation_space, info.action_space, env_id="x")
    with pytest.raises(ObservationError, match="there is a mask, but it was trained without one"):
        policy.act(np.zeros(5), [1, 1])


def test_a_member_of_that_name_is_no_mask_of_actions_that_are_no_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    info = odd(monkeypatch, with_mask(spaces.MultiBinary(2)), NUMBERS, None)
    assert isinstance(info.observation_space, FlatBox)
    assert info.mask is None


def test_pixels_have_no_mask() -> None:
    with pytest.raises(EnvError, match="action_mask is 'legal' and pixels true"):
        make_env("CartPole-v1", {"pixels": True, "action_mask": "legal"})


@pytest.mark.parametrize(
    ("goes_wrong", "words"),
    [
        ("nothing", r"\[0, 0, 0, 0\] as {place} after env step 2 of an episode, which forbids every action"),
        ("short", r"as {place} after env step 2 of an episode, not 4 zeros and ones"),
        ("twos", r"as {place} after env step 2 of an episode, not zeros and ones"),
        ("missing", r"(there is no|gave None as) {place} after env step 2 of an episode"),
    ],
)
@pytest.mark.parametrize("place", PLACES)
def test_a_step_without_a_mask_fails_the_trial_and_no_other(place: str, goes_wrong: str, words: str) -> None:
    args = {**PLACES[place], "goes_wrong": goes_wrong}
    where = {"observation": r"observation\['action_mask'\]", "method": r"action_masks\(\)"}.get(
        place, r"info\['action_mask'\]"
    )
    words = words.replace("{place}", where)
    envs = make_packed_envs(ENV, args, 2, kind="scalar")
    envs.add("m", 0)
    for _ in range(2):
        assert not envs.errors
        envs.step(allowed_at(np.zeros(2), envs.observations, 4))
    with pytest.raises(EnvError, match=rf"{ENV} raised an error in step\(\).*{words}"):
        raise envs.errors["m"]
    envs.close()
    with pytest.raises(EnvError, match=words):
        evaluate_policy(RandomPolicy.for_env(ENV, args), env_id=ENV, env_args=args, seeds=[1])


# -- acting


@pytest.mark.parametrize("hyperparams", [PPO, DQN], ids=["ppo", "dqn"])
@pytest.mark.parametrize("place", PLACES)
def test_a_policy_takes_the_best_of_what_is_allowed(place: str, hyperparams: Any, tmp_path: Path) -> None:
    policy, rng = policy_of(hyperparams, PLACES[place], tmp_path), np.random.default_rng(0)
    numbers = rng.uniform(-1, 1, (200, 2)).astype(np.float32)
    masks = rng.integers(0, 2, (200, 4))
    masks[np.arange(200), rng.integers(0, 4, 200)] = 1
    rows = np.concatenate([masks, numbers], axis=1).astype(np.float32)
    scores = policy._forward(numbers)
    wanted = 7 + np.where(masks == 1, scores, -np.inf).argmax(axis=1)
    assert len(set(wanted.tolist())) >= 3
    assert policy.act(rows).tolist() == wanted.tolist()
    assert policy.act(numbers, mask=masks).tolist() == wanted.tolist()
    assert (policy.outputs(rows)[masks == 0] == FORBIDDEN).all()
    # Also in place of the one that a vector begins with.
    others = 7 + np.where(masks[::-1] == 1, scores, -np.inf).argmax(axis=1)
    assert policy.act(rows, mask=masks[::-1]).tolist() == others.tolist()
    for index in (0, 3, 9):
        assert policy.act(rows[index]) == policy.act(numbers[index], masks[index]) == wanted[index]
        if place == "observation":
            own = {"observation": numbers[index], "action_mask": masks[index].astype(np.int8)}
            assert policy.act(own) == wanted[index]
            assert policy.act([own, own]).tolist() == [wanted[index]] * 2
            # A mask that is given goes before the one that is observed.
            assert policy.act(own, mask=[0, 0, 0, 1]) == 10


def test_a_policy_says_what_is_wrong_with_a_mask(tmp_path: Path) -> None:
    policy = policy_of(PPO, PLACES["info"], tmp_path)
    with pytest.raises(ObservationError, match="there is no mask") as caught:
        policy.act(np.zeros(2, np.float32))
    assert 'mask=info["action_mask"]' in caught.value.hint
    for mask, words in (
        (np.zeros(4), "forbids every action"),
        (np.ones(3), "not 4 zeros"),
        ([2, 0, 0, 0], "not zeros"),
    ):
        with pytest.raises(ObservationError, match=words):
            policy.act(np.zeros(2, np.float32), mask)
    with pytest.raises(ObservationError, match="1 masks for 2 observations"):
        policy.act(np.zeros((2, 2), np.float32), np.ones((1, 4)))
    for numbers in (np.zeros(3), np.zeros(())):
        with pytest.raises(ObservationError, match="there is an observation of shape"):
            policy.act(numbers, np.ones(4))
    assert policy.act(np.zeros((0, 2)), np.ones((0, 4))).shape == (0,)
    policy = policy_of(PPO, {}, tmp_path)
    with pytest.raises(ObservationError, match="with no member 'action_mask'"):
        policy.act({"observation": np.zeros(2)})


def test_a_mask_of_other_actions_is_no_policy_file(tmp_path: Path) -> None:
    policy_of(PPO, {}, tmp_path)
    text = json.loads((tmp_path / "policy.json").read_text())
    for mask, words in (
        ({"sizes": [2, 2], "key": "action_mask"}, "the mask is of choices"),
        ({"sizes": []}, "A space"),
    ):
        (tmp_path / "policy.json").write_text(
            json.dumps({**text, "observation_space": {**text["observation_space"], "mask": mask}})
        )
        with pytest.raises(CheckpointError, match=words):
            load_policy(tmp_path)


def test_baselines_keep_to_the_mask_and_their_episodes_repeat() -> None:
    # The environment raises an error if they don't.
    info = check_env(ENV, {}, "ppo")
    always = ConstantPolicy(info.observation_space, info.action_space, 8, env_id=ENV)
    for policy in (RandomPolicy.for_env(ENV), always):
        with Evaluator(ENV, {}, range(20)) as evaluator:
            played = evaluator.run(policy)
            assert played.lengths == (16,) * 20
            assert evaluator.run(policy) == played
    masks = np.array([[0, 1, 1, 0], [1, 0, 0, 1], [0, 0, 0, 1]], np.float32)
    rows = np.concatenate([masks, np.zeros((3, 2), np.float32)], axis=1)
    assert always.act(rows).tolist() == [8, 7, 10]
    two = check_env("TestForbiddingTwo-v0", {}, "ppo")
    both = ConstantPolicy(two.observation_space, two.action_space, (1.0, 2.0), env_id=ENV)
    row = np.array([0, 0, 1, 1, 1, 1, 1, 1, 0, 0], np.float32)
    assert both.act(row).tolist() == [2, 2]
    assert evaluate_policy(RandomPolicy.for_env("TestForbiddingTwo-v0"), env_id="TestForbiddingTwo-v0", seeds=[1])


def test_who_watches_sees_no_score_of_what_is_forbidden(tmp_path: Path) -> None:
    for hyperparams in (PPO, DQN):
        _, steps = watch_episode(policy_of(hyperparams, {}, tmp_path), ENV, {}, 5)
        shown = list(steps)[1:]
        assert len(shown) == 16
        for step in shown:
            assert step.observation is not None
            assert step.scores is not None
            forbidden = [score for score, one in zip(step.scores, step.observation[:4], strict=True) if not one]
            assert all(score in (0.0, None) for score in forbidden)


# -- sampling


@pytest.mark.parametrize(
    ("env_id", "hyperparams"), [(ENV, PPO), ("TestForbiddingTwo-v0", PPO), (ENV, DQN)], ids=["ppo", "two", "dqn"]
)
def test_nothing_that_is_forbidden_is_done_in_ten_thousand_steps(env_id: str, hyperparams: Any) -> None:
    # The environment raises an error otherwise.
    envs = make_packed_envs(env_id, {}, hyperparams.num_envs, kind="scalar")
    stack = make_stack(hyperparams, envs)
    stack.add(new_member("m", hyperparams, 0, envs.observation_space, envs.action_space), 0)
    for _ in range(5):
        stats = stack.train_iteration()["m"]
        assert not envs.errors
        assert all(np.isfinite(value) for value in stats.learner.values())
    assert stats.num_env_steps >= 10_000
    assert all(np.isfinite(value).all() for value in stack.member("m").weights.values())
    envs.close()


def test_what_is_allowed_is_drawn_equally_often() -> None:
    rng = np.random.default_rng(0)
    rows = np.tile(np.array([0, 1, 1, 0, 1, 5.0]), (30_000, 1))
    found = np.bincount(allowed_at(rng.random(30_000), rows, 5), minlength=5)
    assert found[[0, 3]].tolist() == [0, 0]
    # Five standard deviations.
    assert np.abs(found[[1, 2, 4]] - 10_000).max() < 5 * np.sqrt(30_000 * 2 / 9)
    assert allowed_at(np.array([0.0, 1 - 1e-16]), rows[:2], 5).tolist() == [1, 4]


def test_outputs_are_masked_in_place() -> None:
    outputs: NDArray[np.float32] = np.arange(4, dtype=np.float32).reshape(2, 2)
    mask_outputs(outputs, np.array([[0, 1, 9.0], [1, 1, 9.0]]), 2)
    assert outputs.tolist() == [[FORBIDDEN, 1], [2, 3]]


def test_the_plan_steps_it_with_what_is_allowed() -> None:
    check_seedable(ENV, {})
    assert measure_step(ENV, {}).us is not None
