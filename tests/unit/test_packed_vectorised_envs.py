"""The environments that a pack steps in one object: CartPole's own vectorised version, and which have none."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleEnv, CartPoleVectorEnv
from test_packed_envs import Actor, N, assert_equal_bits, make, own_modules, seen_by

from policies.envs.make import make_env
from policies.errors import EnvError
from policies.packed.envs import cartpole_rows
from policies.packed.envs.cartpole_rows import CartPoleRows
from policies.packed.envs.make import make_packed_envs
from tests.narrowing import present

__all__ = ["make", "own_modules"]


@pytest.mark.parametrize("env_args", [{"max_episode_steps": 25}, {"sutton_barto_reward": True}])
def test_vectorised_cartpole_takes_the_scalar_env_s_steps_to_the_last_bit(make: Any, env_args: Any) -> None:
    envs = make("CartPole-v1", "vectorised", env_args=env_args, members={"a": 1, "b": 2})
    scalars = [make_env("CartPole-v1", env_args) for _ in range(2 * N)]

    def restart(row: int) -> None:
        scalars[row].reset(seed=0)
        cast("Any", scalars[row].unwrapped).state = envs._rows.states[row].copy()

    for row in range(2 * N):
        restart(row)
    rng = np.random.default_rng(0)
    num_ended = {"terminated": 0, "truncated": 0}
    for _ in range(300):
        actions = rng.integers(0, 2, 2 * N)
        step = envs.step(actions)
        for row, env in enumerate(scalars):
            observation, reward, terminated, truncated, _ = env.step(int(actions[row]))
            np.testing.assert_array_equal(step.final_observations[row], observation)
            assert (step.rewards[row], step.terminated[row], step.truncated[row]) == (reward, terminated, truncated)
            num_ended["terminated"] += terminated
            num_ended["truncated"] += truncated
            if terminated or truncated:
                restart(row)
    assert num_ended["terminated"] > 10
    assert (num_ended["truncated"] > 10) is ("max_episode_steps" in env_args)


@pytest.mark.parametrize("env_args", [{"max_episode_steps": 25}, {"sutton_barto_reward": True}])
def test_cartpole_s_own_physics_steps_any_number_of_rows_as_gymnasium_s_to_the_last_bit(env_args: Any) -> None:
    own = present(CartPoleRows.make("CartPole-v1", env_args))
    theirs = CartPoleRows(cast("Any", own)._env, None)
    assert own._physics is not None
    rng = np.random.default_rng(3)
    # From everywhere that an episode comes to, and beyond: far from 0 sines are computed in another way.
    states = rng.normal(scale=[1.5, 2.0, 0.15, 2.0], size=(777, 4))
    states[:50] *= 1e4
    for num in (777, 64, 8, 5, 1, 0):
        lengths = rng.integers(0, 25, num)
        for rows in (own, theirs):
            rows.put(states[:num], lengths)
        for _ in range(3):
            actions = rng.integers(0, 2, num)
            found: list[Any] = [*own.step(actions), own.states, own.lengths]
            expected: list[Any] = [*theirs.step(actions), theirs.states, theirs.lengths]
            for one, other in zip(found, expected, strict=True):
                assert (one.dtype, one.shape) == (other.dtype, other.shape)
                assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize("changed", ["tau", "reward", "limit"])
def test_a_version_of_gymnasium_that_steps_cartpole_otherwise_is_left_to_itself(
    changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = CartPoleVectorEnv.step

    def other(env: Any, actions: Any) -> Any:
        if changed == "tau":
            before = env.tau
            env.tau = 0.5 * before
            try:
                return step(env, actions)
            finally:
                env.tau = before
        observations, rewards, terminated, truncated, info = step(env, actions)
        return observations, rewards + (changed == "reward"), terminated, truncated | (changed == "limit"), info

    monkeypatch.setattr(CartPoleVectorEnv, "step", other)
    cartpole_rows._steps_alike.cache_clear()
    try:
        rows = present(CartPoleRows.make("CartPole-v1", None))
        rows.put(np.full((2, 4), 0.01), np.zeros(2))
        first, rewards, _, truncated, _ = rows.step(np.array([0, 1]))
    finally:
        cartpole_rows._steps_alike.cache_clear()
    assert rows._physics is None
    moved = 0.01 + (0.01 if changed == "tau" else 0.02) * 0.01
    np.testing.assert_array_equal(first[:, 0], np.float32(moved))
    np.testing.assert_array_equal(rewards, 2.0 if changed == "reward" else 1.0)
    assert truncated.all() == (changed == "limit")


def test_a_cartpole_with_other_constants_is_stepped_with_these() -> None:
    rows = present(CartPoleRows.make("CartPole-v1", None))
    env = cast("Any", rows)._env
    known = cartpole_rows.Constants.of(env)
    assert cartpole_rows._steps_alike(known._replace(length=0.7, force_mag=3.0, gravity=1.6))
    # Its other method of integration is not here.
    env.kinematics_integrator = "semi-implicit euler"
    assert cartpole_rows.own_physics(env) is None
    del env.polemass_length
    assert cartpole_rows.own_physics(env) is None


def test_start_states_are_those_of_cartpole_and_no_two_are_the_same(make: Any) -> None:
    envs = make("CartPole-v1", "vectorised", num_envs=50, env_args={"max_episode_steps": 2}, members={"a": 1, "b": 2})
    starts = [envs.observations]
    for _ in range(20):
        step = envs.step(np.zeros(100, dtype=np.int64))
        starts += [step.observations] if step.truncated.all() else []
    every = np.concatenate(starts)
    assert len(every) == 11 * 100
    assert len(np.unique(every, axis=0)) == len(every)
    assert np.abs(every).max() <= 0.05
    assert np.abs(every).max() > 0.049
    assert np.abs(every.mean(axis=0)).max() < 0.004


def test_what_a_member_gets_does_not_depend_on_how_long_the_stretches_are(make: Any) -> None:
    traces = []
    every = dict.fromkeys(range(60), 1)
    for stretches in ({0: 60}, every, {0: 7, 7: 20, 27: 33}, {0: 100}, {}, {0: 10, 3: 20, 17: 2, 30: 8, 33: 40}):
        envs = make("CartPole-v1", "vectorised", env_args={"max_episode_steps": 5}, members={"a": 3})
        actor, trace = Actor(envs.action_space, 0), []
        for index in range(60):
            if index in stretches:
                envs.begin(stretches[index])
            trace.append(seen_by(envs, envs.step(actor()), "a"))
        traces.append(trace)
    for trace in traces[1:]:
        assert_equal_bits(trace, traces[0])


@pytest.mark.parametrize(
    ("env_id", "env_args"),
    [
        ("policy_factory:Walk", {}),
        ("CartPole-v1", {"pixels": True}),
        ("CartPole-v1", {"frame_stack": 2}),
        ("Pendulum-v1", {"frame_stack": 2}),
        ("Acrobot-v1", {"pixels": True}),
    ],
)
def test_only_plain_classic_control_is_vectorised(env_id: str, env_args: Any) -> None:
    with pytest.raises(EnvError, match="no vectorised version"):
        make_packed_envs(env_id, env_args, 2, kind="vectorised")


def test_a_cartpole_of_somebody_s_own_is_not_vectorised() -> None:
    class LowGravity(CartPoleEnv):
        """Its registry entry has forgotten that Gymnasium's vectorised version does not know of this."""

    gym.register(
        "TestLowGravity-v0",
        cast("Any", LowGravity),
        max_episode_steps=20,
        vector_entry_point=cast("Any", CartPoleVectorEnv),
    )
    try:
        with pytest.raises(EnvError, match="no vectorised version"):
            make_packed_envs("TestLowGravity-v0", None, 2, kind="vectorised")
    finally:
        del gym.registry["TestLowGravity-v0"]
