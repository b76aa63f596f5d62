"""An observation that is none, in mid-episode: evaluations and films say where it came from."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from policy_factory import registered

from policies.acting.baselines import ConstantPolicy
from policies.acting.evaluate import evaluate_policy, play_episode
from policies.acting.policy import RandomPolicy
from policies.acting.video import record_video
from policies.envs import calls
from policies.envs.checked import CheckedEnvs
from policies.envs.make import check_env, make_env, make_vector_env
from policies.errors import EnvError, EnvFailedError
from policies.packed.envs.make import make_packed_envs

ENV = "TestBreaks-v0"
BROKEN: dict[str, Any] = {
    "none": None,
    "longer": np.zeros(3, np.float32),
    "scalar": 1.0,
    "ragged": [[1.0], [1.0, 2.0]],
    "text": ["a", "b"],
    "nested": np.zeros((1, 2), np.float32),
}


class Breaks(gym.Env[Any, Any]):
    """Its second step, or its reset, returns something other than an observation."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, how: str, at: int = 2, render_mode: str | None = None) -> None:
        self.how, self.at, self.render_mode, self.steps = how, at, render_mode, 0

    def _seen(self) -> Any:
        return BROKEN[self.how] if self.steps == self.at else [0.5, 0.25]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._seen(), 1.0, self.steps == 4, False, {}

    def render(self) -> Any:
        return np.zeros((20, 320, 3), np.uint8)


@pytest.fixture(autouse=True)
def _env() -> Iterator[None]:
    with registered(ENV, Breaks):
        yield


def policy() -> RandomPolicy:
    return RandomPolicy(Breaks.observation_space, Breaks.action_space, env_id=ENV)


@pytest.mark.parametrize("how", BROKEN)
def test_an_evaluation_names_the_env_the_seed_and_the_step(how: str) -> None:
    words = rf"after env step 2 of the episode of {ENV} with seed 7 was .*not numbers of shape \(2,\)"
    with pytest.raises(EnvFailedError, match=words) as caught:
        evaluate_policy(policy(), env_id=ENV, env_args={"how": how}, seeds=[7])
    assert "step()" in caught.value.hint
    assert ("was None," in caught.value.message) is (how == "none")


@pytest.mark.parametrize("how", BROKEN)
def test_so_does_a_reset(how: str) -> None:
    words = rf"from reset\(\), at the beginning of the episode of {ENV} with seed 7 was "
    with pytest.raises(EnvFailedError, match=words) as caught:
        evaluate_policy(policy(), env_id=ENV, env_args={"how": how, "at": 0}, seeds=[7])
    assert "reset()" in caught.value.hint


def test_so_do_episodes_side_by_side_and_films(tmp_path: Path) -> None:
    constant = ConstantPolicy(Breaks.observation_space, Breaks.action_space, 0, env_id=ENV)
    with pytest.raises(EnvFailedError, match=r"after env step 2 .* with seed 3 was of shape"):
        evaluate_policy(constant, env_id=ENV, env_args={"how": "longer"}, seeds=[3, 4])
    with pytest.raises(EnvFailedError, match=r"after env step 2 .* with seed 3 was None"):
        record_video(constant, env_id=ENV, env_args={"how": "none"}, seeds=3, mp4=tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []


def test_lists_of_numbers_pass() -> None:
    env = make_env(ENV, {"how": "none", "at": 9})
    assert play_episode(policy(), env, 0, max_episode_steps=9) == (4.0, 4)


def test_a_watched_policy_tells_that_it_acts_on_rows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with (tmp_path / "page").open("w+b") as file:
        file.truncate(calls.PAGE_BYTES)
        page = calls.Page(file.fileno())
    monkeypatch.setattr(calls, "_page", page)
    inside = []

    class Own(RandomPolicy):
        """Acts by an `act` of its own, which is called by `act_on_rows`."""

        def act(self, observations: Any, mask: Any = None) -> Any:
            inside.append((page.call, page.count))
            return super().act(observations, mask)

        def _act_batch(self, observations: Any) -> Any:
            inside.append((page.call, page.count))
            return super()._act_batch(observations)

    rows = np.zeros((3, 2), np.float32)
    own = calls.watch_policy(Own(Breaks.observation_space, Breaks.action_space, env_id=ENV))
    assert own.act_on_rows(rows).shape == (3,)
    # A call inside a call: both count, and the outer one is what is left when the inner one has ended.
    assert inside == [(calls.Call.ACT, 2), (calls.Call.ACT, 2)]
    assert (page.call, page.count) == (calls.Call.NONE, 4)

    class Plain(RandomPolicy):
        def _act_batch(self, observations: Any) -> Any:
            inside.append((page.call, page.count))
            return super()._act_batch(observations)

    plain = calls.watch_policy(Plain(Breaks.observation_space, Breaks.action_space, env_id=ENV))
    plain.act_on_rows(rows)
    assert inside[2:] == [(calls.Call.ACT, 5)]
    assert (page.call, page.count) == (calls.Call.NONE, 6)


class Ruined(gym.Env[Any, Any]):
    """A number of what it observes is NaN from some step on; a mask is a member, or an info."""

    action_space = gym.spaces.Discrete(4)

    def __init__(self, kind: str, at: int = 3) -> None:
        self.kind, self.at, self.steps = kind, at, 0
        members = {"a": gym.spaces.Discrete(3), "x": gym.spaces.Box(-1, 1, (2, 2), np.float32)}
        if kind == "member":
            members["action_mask"] = gym.spaces.MultiBinary(4)
        self.observation_space: Any = gym.spaces.Dict(members) if kind != "info" else members["x"]

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        matrix, mask = np.zeros((2, 2), np.float32), np.ones(4, np.int8)
        if self.steps >= self.at:
            matrix[1, 0] = np.nan
        if self.kind == "info":
            return matrix, {"action_mask": mask}
        return {"a": 0, "x": matrix} | ({"action_mask": mask} if self.kind == "member" else {}), {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._seen()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        observation, info = self._seen()
        return observation, 1.0, self.steps == 9, False, info


RUINED = "TestRuined-v0"


@pytest.mark.parametrize(
    ("args", "where"),
    [
        ({"kind": "plain"}, "observation['x'][1][0]"),
        ({"kind": "member"}, "observation['x'][1][0]"),
        ({"kind": "info", "action_mask": True}, "observation[1][0]"),
        # In the newest of two observations.
        ({"kind": "member", "frame_stack": 2}, "observation['x'][1][0]"),
    ],
    ids=str,
)
def test_a_number_that_is_none_is_named_as_the_env_has_it(args: dict[str, Any], where: str) -> None:
    with registered(RUINED, Ruined):
        words = re.escape(f"after env step 3 of an episode of {RUINED} was NaN ({where})")
        random = RandomPolicy.for_env(RUINED, args)
        with pytest.raises(EnvFailedError, match=words):
            evaluate_policy(random, env_id=RUINED, env_args=args, seeds=[7])
        rows = CheckedEnvs(make_vector_env(RUINED, args, 2), RUINED)
        packed = make_packed_envs(RUINED, args, 1, kind="scalar")
        packed.add("m", 0)
        rows.reset(seed=1)
        for _ in range(2):
            rows.step(np.zeros(2, np.int64))
            packed.step(np.zeros(1, np.int64))
        with pytest.raises(EnvFailedError, match=words):
            rows.step(np.zeros(2, np.int64))
        packed.step(np.zeros(1, np.int64))
        with pytest.raises(EnvError, match=words):
            raise packed.errors["m"]
        packed.close()


@pytest.mark.parametrize(
    ("args", "where"),
    [({"kind": "member"}, "observation['x'][1][0]"), ({"kind": "plain", "frame_stack": 2}, "observation['x'][1][0]")],
)
def test_so_is_one_of_the_first_observation(args: dict[str, Any], where: str) -> None:
    with registered(RUINED, Ruined), pytest.raises(EnvError, match=re.escape(f"not finite: nan at {where}")):
        check_env(RUINED, {**args, "at": 0})
