"""LunarLanders are stepped together as Gymnasium steps each, to the last bit, or not at all."""

import importlib
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from policies.envs.landers import Landers, _is_lander
from policies.envs.make import make_env
from policies.packed.envs.make import make_packed_envs
from policies.packed.envs.sub_envs import SubEnvs
from policies.packed.envs.together_sub_envs import TogetherSubEnvs, make_sub_envs
from tests.stepped_together import assert_equal_steps, check_episodes

pytest.importorskip("Box2D")
lunar_lander: Any = importlib.import_module("gymnasium.envs.box2d.lunar_lander")

LANDERS: list[tuple[str, dict[str, Any]]] = [
    ("LunarLander-v3", {}),
    ("LunarLander-v3", {"gravity": -3.0, "max_episode_steps": 70}),
    ("LunarLander-v3", {"continuous": True}),
    ("LunarLanderContinuous-v3", {"gravity": -11.5}),
]


def drawn(space: gym.Space[Any], num: int, rng: np.random.Generator) -> NDArray[Any]:
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(0, 4, num)
    return rng.choice([-1.0, -0.5, 0.0, 0.5, 1.0, 0.7, -0.6], (num, 2)).astype(np.float32)


@pytest.mark.parametrize(("env_id", "args"), LANDERS)
def test_each_step_is_gymnasiums_to_the_last_bit(env_id: str, args: dict[str, Any]) -> None:
    """Through falls and time limits, while members come and go."""
    ours, theirs = make_sub_envs(env_id, args), SubEnvs(env_id, args)
    assert isinstance(ours, TogetherSubEnvs)
    space, rng = make_env(env_id, args).action_space, np.random.default_rng(1)
    num_ends = num = 0
    for number in range(400):
        if number in (0, 10, 40):
            seeds = [100 * number, 100 * number + 1, 7]
            for mine, other in zip(ours.add(f"m{number}", seeds), theirs.add(f"m{number}", seeds), strict=True):
                np.testing.assert_array_equal(mine, other, strict=True)
            num += 3
        if number == 70:
            ours.remove("m10")
            theirs.remove("m10")
            num -= 3
        actions = drawn(space, num, rng)
        step = ours.step(actions)
        assert_equal_steps(step, theirs.step(actions))
        num_ends += len(step.first_observations)
    assert num_ends >= 20
    ours.close()
    theirs.close()


@pytest.mark.parametrize("env_id", ["LunarLander-v3", "LunarLanderContinuous-v3"])
def test_landings_are_gymnasiums_too(env_id: str) -> None:
    """Gymnasium's own pilot comes down on the legs, and to rest."""
    ours, theirs = make_sub_envs(env_id, {}), SubEnvs(env_id, {})
    pilot = gym.make(env_id).unwrapped
    seeds = [0, 1, 2]
    observations = np.array(ours.add("m", seeds))
    theirs.add("m", seeds)
    num_landings = num_touching = 0
    for _ in range(700):
        actions = np.array([lunar_lander.heuristic(pilot, observation) for observation in observations])
        actions = actions.astype(np.float32) if "Continuous" in env_id else actions
        step = ours.step(actions)
        assert_equal_steps(step, theirs.step(actions))
        num_landings += int((step.rewards == 100).sum())
        num_touching += int((step.final_observations[:, 6:].sum(axis=1) == 1).sum())
        observations = step.final_observations.copy()
        for place, first in step.first_observations.items():
            observations[place] = first
    assert num_landings >= 3
    assert num_touching >= 3


def test_processes_step_landers_as_this_one_does() -> None:
    here, there = (
        make_packed_envs("LunarLander-v3", None, 3, kind=kind, num_processes=2) for kind in ("scalar", "processes")
    )
    for envs in (here, there):
        envs.add("m", 5)
    rng = np.random.default_rng(0)
    for _ in range(150):
        actions = rng.integers(0, 4, 3)
        ours, theirs = there.step(actions), here.step(actions)
        np.testing.assert_array_equal(ours.observations, theirs.observations, strict=True)
        np.testing.assert_array_equal(ours.rewards, theirs.rewards, strict=True)
    here.close()
    there.close()


@pytest.mark.parametrize("args", [{"enable_wind": True}, {"frame_stack": 2}, {"normalize_observations": True}])
def test_other_landers_are_stepped_one_by_one(args: dict[str, Any]) -> None:
    """With wind, or in wrappers."""
    assert Landers.of("LunarLander-v3", args) is None


def test_landers_that_are_drawn_are_not_taken_as_their_engines_throw_particles() -> None:
    for mode, is_taken in ((None, True), ("rgb_array", False)):
        assert _is_lander(gym.make("LunarLander-v3", render_mode=mode, disable_env_checker=True)) == is_taken


@pytest.mark.parametrize("is_named", [True, False])
def test_a_derived_lander_is_stepped_by_itself(is_named: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in the place of Gymnasium's own, and although its first thousand steps are the same."""

    class Lazy(lunar_lander.LunarLander):  # type: ignore[misc]
        num_steps = 0

        def step(self, action: Any) -> Any:
            observation, reward, terminated, truncated, info = super().step(action)
            self.num_steps += 1
            return observation, reward * (1 + (self.num_steps > 1000)), terminated, truncated, info

    if is_named:
        monkeypatch.setattr(lunar_lander, "LunarLander", Lazy)
        assert type(make_env("LunarLander-v3", {}).unwrapped) is Lazy
        assert Landers.of("LunarLander-v3", None) is None
    else:
        gym.register("LazyLander-v0", entry_point=Lazy)
        try:
            assert Landers.of("LazyLander-v0", None) is None
        finally:
            del gym.registry["LazyLander-v0"]


def test_no_environment_but_a_lander_is_made_to_look_at_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user's may take seconds to make, or end the process; its members are told so when they are added."""
    made: list[str] = []
    monkeypatch.setattr("policies.envs.landers.make_env", lambda env_id, _: made.append(env_id))
    for env_id in ("CartPole-v1", "BipedalWalker-v3", "nowhere:Env"):
        assert Landers.of(env_id, {}) is None
    assert not made


@pytest.mark.parametrize(
    ("name", "value"),
    [("SIDE_ENGINE_HEIGHT", 17), ("FPS", 60), ("SCALE", 25.0), ("LEG_DOWN", 17), ("MAIN_ENGINE_POWER", 20.0)],
)
def test_numbers_are_those_of_gymnasiums_module(name: str, value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lunar_lander, name, value)
    assert Landers.of("LunarLander-v3", None) is not None


def test_a_gymnasium_that_steps_in_another_way_is_left_to_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    own = lunar_lander.LunarLander.step

    def step(self: Any, action: Any) -> Any:
        observation, reward, *others = own(self, action)
        # Another last bit.
        return observation, reward * (1 + 2**-52), *others

    assert Landers.of("LunarLander-v3", None) is not None
    monkeypatch.setattr(lunar_lander.LunarLander, "step", step)
    assert Landers.of("LunarLander-v3", None) is None


def test_what_box2d_raises_is_the_error_of_that_member() -> None:
    envs = make_sub_envs("LunarLander-v3", {})
    assert isinstance(envs, TogetherSubEnvs)
    for name in ("good", "bad", "fine"):
        envs.add(name, [1, 2])

    class Broken:
        def Step(self, *_: object) -> None:  # noqa: N802 (Box2D's name)
            raise RuntimeError("b2Assert failed")

    envs._envs[3].env.unwrapped.world = Broken()  # type: ignore[attr-defined]
    stepped = envs.step(np.array([0, 1, 2, 3, 0, 1]))
    assert list(stepped.errors) == ["bad"]
    assert "b2Assert failed" in str(stepped.errors["bad"])
    assert np.isfinite(stepped.rewards[[0, 1, 4, 5]]).all()


@pytest.mark.parametrize("env_id", ["LunarLander-v3", "LunarLanderContinuous-v3"])
def test_episodes_of_an_evaluation_are_those_that_are_played_alone(
    env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lengths = check_episodes(env_id, monkeypatch, cap=130, limit=150)
    assert len(set(lengths)) > 1
