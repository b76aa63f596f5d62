"""`Policy.make_env`: an environment that observes what the policy takes, and takes the actions that it gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from atari_games import ID, NO_OPENCV, needs_opencv, register
from policy_factory import registered, untrained_policy

from analysis.page.cards import acting_code, loading_code
from policies.acting.evaluate import evaluate_policy
from policies.acting.load import load_policy
from policies.acting.policy import RandomPolicy
from policies.errors import EnvError, ObservationError
from policies.hyperparams import DQNHyperparams, PPOHyperparams
from policies.portable.file import save_policy

pytestmark = pytest.mark.usefixtures("env_plugin")

SMALL: dict[str, Any] = {"hidden_sizes": (7,)}
FILTERS = {"conv_filters": ((4, 8, 4),)}
SEEDS = [3, 4]


def saved(env_id: str, env_args: dict[str, Any], folder: Path, **values: Any) -> Any:
    """An untrained policy as it is read from its file."""
    made = untrained_policy(env_id, env_args, PPOHyperparams(**{**SMALL, **values}), folder)
    save_policy(made.portable, folder)
    return load_policy(folder)


def played(policy: Any, seed: int) -> float:
    """The return of an episode as a user plays it."""
    env, total, is_over = policy.make_env(), 0.0, False
    observation, _ = env.reset(seed=seed)
    while not is_over:
        observation, reward, terminated, truncated, _ = env.step(policy.act(observation))
        total, is_over = total + float(reward), terminated or truncated
    env.close()
    return total


@pytest.mark.parametrize(("env_id", "env_args", "values"), [
    ("CartPole-v1", {}, {}),
    ("CartPole-v1", {"frame_stack": 3, "max_episode_steps": 20}, {}),
    ("CartPole-v1", {"pixels": True, "frame_stack": 2, "max_episode_steps": 10}, FILTERS),
    ("Pendulum-v1", {"frame_stack": 2, "max_episode_steps": 30}, {}),
    ("FrozenLake-v1", {"is_slippery": True}, {}),
    ("TestMaskedBeside-v0", {"frame_stack": 2}, {"conv_filters": ((4, 3, 2),)}),
    ("TestMaskedShades-v0", {}, {"conv_filters": ((4, 3, 2),)}),
], ids=str)  # fmt: skip
def test_an_episode_there_is_one_of_an_evaluation(
    env_id: str, env_args: dict[str, Any], values: dict[str, Any], tmp_path: Path
) -> None:
    policy = saved(env_id, env_args, tmp_path, **values)
    episodes = evaluate_policy(policy, env_id=env_id, env_args=env_args, seeds=SEEDS)
    assert [played(policy, seed) for seed in SEEDS] == pytest.approx(list(episodes.returns))


class Forms(gym.Env[Any, Any]):
    """Takes actions of a form that no network gives, and tells with its rewards what it got.

    Args:
        kind: Which form.
    """

    def __init__(self, kind: str) -> None:
        spaces: dict[str, gym.Space[Any]] = {
            "choices": gym.spaces.MultiDiscrete([3, 4], start=[5, -2]),
            "members": gym.spaces.Dict({"a": gym.spaces.Discrete(3, start=1), "b": gym.spaces.MultiBinary(2)}),
            "whole": gym.spaces.Box(-20, 20, (2, 2), np.int16),
            "numbers": gym.spaces.Tuple((gym.spaces.Box(-1, 3, (2,)), gym.spaces.Box(0, 9, (1, 2), np.float64))),
            "discrete": gym.spaces.Discrete(4, start=2),
        }
        self.action_space = spaces[kind]
        self.observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
        self.ticks = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.ticks = 0
        return self.np_random.uniform(-1, 1, 3).astype(np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.ticks += 1
        told: Any = gym.spaces.flatten(self.action_space, action)
        observation = self.np_random.uniform(-1, 1, 3).astype(np.float32)
        return observation, float(told @ np.arange(1, 1 + len(told))), self.ticks == 6, False, {}


@pytest.mark.parametrize("kind", ["choices", "members", "whole", "numbers", "discrete"])
def test_actions_are_in_the_envs_own_form(kind: str, tmp_path: Path) -> None:
    with registered("TestForms-v0", Forms):
        policy = saved("TestForms-v0", {"kind": kind}, tmp_path)
        env = policy.make_env()
        assert env.action_space == Forms(kind).action_space
        env.reset(seed=0)
        for _ in range(3):
            env.step(env.action_space.sample())
        episodes = evaluate_policy(policy, env_id="TestForms-v0", env_args={"kind": kind}, seeds=SEEDS)
        assert [played(policy, seed) for seed in SEEDS] == pytest.approx(list(episodes.returns))


def test_it_is_drawn_if_that_is_asked_for(tmp_path: Path) -> None:
    policy = saved("CartPole-v1", {"frame_stack": 2}, tmp_path)
    env = policy.make_env(render_mode="rgb_array")
    env.reset(seed=0)
    assert np.asarray(env.render()).shape == (400, 600, 3)
    env.close()
    assert policy.make_env().render_mode is None


def test_a_baseline_has_it_and_an_env_that_is_not_there_is_named() -> None:
    env = RandomPolicy.for_env("CartPole-v1", {"frame_stack": 2}).make_env()
    assert env.observation_space.shape == (8,)
    lost = RandomPolicy.for_env("CartPole-v1", {})
    lost.env_id = "Lost-v0"
    with pytest.raises(EnvError, match="'Lost-v0'"):
        lost.make_env()


@pytest.mark.parametrize(("env_args", "values", "wrapped"), [
    ({"frame_stack": 4}, {}, "frame_stack: 4"),
    ({"pixels": True, "frame_stack": 2}, FILTERS, "frame_stack: 2 and pixels: true"),
    ({}, {}, ""),
], ids=str)  # fmt: skip
def test_what_the_env_itself_gives_is_refused_with_what_it_was_trained_with(
    env_args: dict[str, Any], values: dict[str, Any], wrapped: str, tmp_path: Path
) -> None:
    policy = saved("CartPole-v1", env_args, tmp_path, **values)
    with pytest.raises(ObservationError) as caught:
        policy.act(np.zeros(5) if not wrapped else np.zeros(4))
    hint = "Pass what env.reset or env.step returned"
    hint += f", of an env with {wrapped}, with which it was trained: env = policy.make_env()" if wrapped else ""
    assert caught.value.hint == f"{hint}."
    code = acting_code(tmp_path)
    assert ("env = policy.make_env()" in code) is bool(wrapped)
    if wrapped:
        assert f"# with {wrapped}" in code
        names: dict[str, Any] = {"policy": policy}
        exec(code, names)
        assert names["action"] in (0, 1)


@pytest.mark.skipif(needs_opencv, reason=NO_OPENCV)
def test_atari_is_told_without_its_numbers(tmp_path: Path) -> None:
    register()
    policy = saved(ID, {"atari": {"noop_max": 0}, "frame_stack": 4}, tmp_path, **FILTERS)
    assert "# with frame_stack: 4 and atari" in acting_code(tmp_path)
    env = policy.make_env()
    observation, _ = env.reset(seed=0)
    assert policy.act(observation) in range(3)
    env.close()


def test_a_module_that_is_not_allowed_says_how_python_allows_it(tmp_path: Path) -> None:
    policy = saved("CartPole-v1", {}, tmp_path)
    policy.env_id = "my_own_envs:Lake"
    with pytest.raises(EnvError, match="'my_own_envs' is not allowed") as caught:
        policy.make_env()
    assert "in Python with tune_jobs.allow_modules(['my_own_envs'])" in caught.value.hint


def test_the_reports_code_allows_the_envs_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_pairs.py").write_text("from tune_jobs_test_members import Pair as Pair\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("TUNE_JOBS_ALLOWED_MODULES", "own_pairs")
    saved("own_pairs:Pair", {"frame_stack": 2}, tmp_path)
    monkeypatch.delenv("TUNE_JOBS_ALLOWED_MODULES")
    code = loading_code(str(tmp_path), tmp_path)
    assert code.startswith("from tune_jobs import allow_modules, load_policy\n")
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["action"] in (0, 1)
    saved("CartPole-v1", {"frame_stack": 2}, tmp_path)
    assert loading_code("it", tmp_path).startswith(
        "from tune_jobs import load_policy\n\npolicy = load_policy('it')\nenv ="
    )


def test_masks_come_with_what_it_observes(tmp_path: Path) -> None:
    """Where frames are stacked below a mask, they are one row."""
    made = untrained_policy(
        "TestMaskedBeside-v0", {"frame_stack": 2}, DQNHyperparams(conv_filters=((4, 3, 2),)), tmp_path
    )
    save_policy(made.portable, tmp_path)
    code = acting_code(tmp_path)
    assert code.endswith("action = policy.act(observation)")
    assert "frame_stack: 2" in code
