"""MuJoCo's running robots are stepped together as Gymnasium steps each, to the last bit, or not at all."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from policies.envs.make import make_env
from policies.envs.runners import Copy, Runners
from policies.packed.envs.make import make_packed_envs
from policies.packed.envs.sub_envs import SubEnvs
from policies.packed.envs.together_sub_envs import TogetherSubEnvs, make_sub_envs
from tests.stepped_together import assert_equal_steps, check_episodes

mujoco = pytest.importorskip("mujoco")

ROBOTS: list[tuple[str, dict[str, Any]]] = [
    ("Hopper-v5", {}),
    ("Hopper-v5", {"healthy_state_range": [-3.0, 2.5], "terminate_when_unhealthy": True, "healthy_reward": 2}),
    ("Hopper-v5", {"terminate_when_unhealthy": False, "exclude_current_positions_from_observation": False}),
    ("Walker2d-v5", {}),
    ("Walker2d-v5", {"healthy_z_range": [1.1, 1.3], "ctrl_cost_weight": 0.5, "frame_skip": 2}),
    ("HalfCheetah-v5", {}),
    ("HalfCheetah-v5", {"forward_reward_weight": 3.0, "exclude_current_positions_from_observation": False}),
    ("Swimmer-v5", {}),
    ("Swimmer-v5", {"reset_noise_scale": 0.5, "ctrl_cost_weight": 1}),
]


@pytest.fixture(autouse=True)
def _warnings_as_they_were() -> Iterator[None]:
    before = mujoco.get_mju_user_warning()
    yield
    mujoco.set_mju_user_warning(before)


@pytest.mark.parametrize(("env_id", "args"), ROBOTS)
def test_each_step_is_gymnasiums_to_the_last_bit(env_id: str, args: dict[str, Any]) -> None:
    """Through falls and time limits, while members come and go."""
    args = {**args, "max_episode_steps": 25}
    ours, theirs = make_sub_envs(env_id, args), SubEnvs(env_id, args)
    assert isinstance(ours, TogetherSubEnvs)
    space = make_env(env_id, args).action_space
    assert isinstance(space, gym.spaces.Box)
    rng = np.random.default_rng(1)
    num_ends = num = 0
    for number in range(120):
        if number in (0, 10, 40):
            seeds = [100 * number, 100 * number + 1, 7]
            for mine, other in zip(ours.add(f"m{number}", seeds), theirs.add(f"m{number}", seeds), strict=True):
                np.testing.assert_array_equal(mine, other, strict=True)
            num += 3
        if number == 70:
            ours.remove("m10")
            theirs.remove("m10")
            num -= 3
        actions = rng.uniform(space.low, space.high, (num, *space.shape)).astype(np.float32)
        step = ours.step(actions)
        assert_equal_steps(step, theirs.step(actions))
        num_ends += len(step.first_observations)
    assert num_ends >= 20
    ours.close()
    theirs.close()


@pytest.mark.parametrize(
    ("env_id", "args"),
    [
        ("Hopper-v5", {}),
        ("Hopper-v5", {"healthy_state_range": [-2.0, 1.0], "healthy_angle_range": [-9, 9], "healthy_z_range": [-9, 9]}),
        ("Walker2d-v5", {}),
    ],
)
def test_a_robot_has_fallen_where_gymnasium_says_so(env_id: str, args: dict[str, Any]) -> None:
    inner: Any = make_env(env_id, args).unwrapped
    inner.reset(seed=0)
    runners, rng = Runners(inner), np.random.default_rng(0)
    assert runners._is_healthy is not None
    num = 400
    # Each number by itself far out of its range in some of the states.
    qpos = inner.init_qpos + rng.normal(0, 0.1, (num, inner.model.nq))
    qvel = rng.normal(0, 0.1, (num, inner.model.nv))
    for numbers in (qpos, qvel):
        numbers[np.arange(num), rng.integers(0, numbers.shape[1], num)] += rng.choice([0, 0, -300, -1.5, 1.5, 300], num)
    ours = runners._is_healthy(vars(inner), qpos, qvel)
    theirs = []
    for place in range(num):
        inner.data.qpos[:], inner.data.qvel[:] = qpos[place], qvel[place]
        theirs.append(inner.is_healthy)
    assert ours.tolist() == theirs
    assert 40 < sum(theirs) < num - 40


def test_processes_step_robots_as_this_one_does() -> None:
    here, there = (
        make_packed_envs("Hopper-v5", None, 3, kind=kind, num_processes=2) for kind in ("scalar", "processes")
    )
    for envs in (here, there):
        envs.add("m", 5)
    rng = np.random.default_rng(0)
    for _ in range(60):
        actions = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        ours, theirs = there.step(actions), here.step(actions)
        np.testing.assert_array_equal(ours.observations, theirs.observations, strict=True)
        np.testing.assert_array_equal(ours.rewards, theirs.rewards, strict=True)
    here.close()
    there.close()


def test_no_environment_but_a_robot_is_made_to_look_at_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user's may take seconds to make, or end the process; its members are told so when they are added."""

    made: list[str] = []
    monkeypatch.setattr("policies.envs.runners.make_env", lambda env_id, _: made.append(env_id))
    for env_id in ("CartPole-v1", "Ant-v5", "nowhere:Env"):
        assert type(make_sub_envs(env_id, {})) is SubEnvs
    assert not made


def test_robots_fall_in_these_tests() -> None:
    envs = make_sub_envs("Hopper-v5", {})
    envs.add("m", [0, 1])
    falls = sum(envs.step(np.ones((2, 3), dtype=np.float32)).terminated.sum() for _ in range(100))
    assert falls >= 2
    envs.close()


@pytest.mark.parametrize(
    ("env_id", "args"),
    [
        ("CartPole-v1", {}),
        ("InvertedPendulum-v5", {}),
        ("Ant-v5", {}),
        ("Hopper-v5", {"frame_stack": 2}),
    ],
)
def test_other_environments_are_stepped_one_by_one(env_id: str, args: dict[str, Any]) -> None:
    assert Runners.of(env_id, args) is None
    envs = make_sub_envs(env_id, args)
    assert type(envs) is SubEnvs
    envs.close()


def test_a_derived_robot_is_stepped_by_itself() -> None:
    from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

    class Lazy(HopperEnv):
        def control_cost(self, action: Any) -> Any:
            return 0.0 * np.sum(action)

    gym.register("LazyHopper-v0", entry_point=Lazy)
    try:
        assert Runners.of("LazyHopper-v0", None) is None
    finally:
        del gym.registry["LazyHopper-v0"]


@pytest.mark.parametrize("name", ["control_cost", "_get_obs", "is_healthy"])
def test_a_gymnasium_that_steps_in_another_way_is_left_to_itself(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

    assert Runners.of("Hopper-v5", None) is not None
    other: Any = {
        "control_cost": lambda _, action: 1e-3 * np.abs(action).sum(),
        "_get_obs": lambda self: np.concatenate([self.data.qpos[1:], self.data.qvel]) * (1 + 1e-15),
        "is_healthy": property(lambda self: bool(self.data.qpos[1] > 1.0)),
    }[name]
    monkeypatch.setattr(HopperEnv, name, other)
    assert Runners.of("Hopper-v5", None) is None


def test_what_mujoco_raises_is_the_error_of_that_member(monkeypatch: pytest.MonkeyPatch) -> None:
    envs = make_sub_envs("Hopper-v5", {})
    assert isinstance(envs, TogetherSubEnvs)
    for name in ("good", "bad", "fine"):
        envs.add(name, [1, 2])
    broken = envs._copies[3].data
    runners: Any = envs._stepper
    step = runners._mj_step

    def fails(model: Any, data: Any, num: int) -> None:
        if data is broken:
            raise mujoco.FatalError("mj_stack overflow")
        step(model, data, num)

    monkeypatch.setattr(runners, "_mj_step", fails)
    stepped = envs.step(np.zeros((6, 3), dtype=np.float32))
    assert list(stepped.errors) == ["bad"]
    assert "mj_stack overflow" in str(stepped.errors["bad"])
    assert np.isfinite(stepped.rewards[[0, 1, 4, 5]]).all()
    envs.close()


def test_an_observation_that_is_not_finite_is_the_error_of_that_member() -> None:
    envs = make_sub_envs("HalfCheetah-v5", {})
    assert isinstance(envs, TogetherSubEnvs)
    for name in ("good", "bad"):
        envs.add(name, [1])
    actions = np.zeros((2, 6), dtype=np.float32)
    actions[1] = np.nan
    theirs = SubEnvs("HalfCheetah-v5", {})
    for name in ("good", "bad"):
        theirs.add(name, [1])
    ours, other = envs.step(actions), theirs.step(actions)
    assert list(ours.errors) == list(other.errors) == ["bad"]
    assert str(ours.errors["bad"]) == str(other.errors["bad"])


@pytest.mark.parametrize("env_id", ["Hopper-v5", "HalfCheetah-v5"])
def test_episodes_of_an_evaluation_are_those_that_are_played_alone(
    env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_episodes(env_id, monkeypatch, cap=50, limit=60)


def test_mujoco_says_each_warning_once_and_writes_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    mujoco.set_mju_user_warning(None)
    for _ in range(3):
        env = make_env("HalfCheetah-v5")
        env.reset(seed=0)
        Copy(env).qvel[:] = 1e12
        env.step(np.zeros(6, dtype=np.float32))
    said = capfd.readouterr()
    assert said.err.count("simulation is unstable") == 1
    assert "WARNING" not in said.out + said.err
    assert list(tmp_path.iterdir()) == []


def test_who_listens_to_mujocos_warnings_goes_on_to(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[str] = []
    mujoco.set_mju_user_warning(heard.append)
    env = make_env("HalfCheetah-v5")
    env.reset(seed=0)
    Copy(env).qvel[:] = 1e12
    env.step(np.zeros(6, dtype=np.float32))
    assert any("unstable" in text for text in heard)
