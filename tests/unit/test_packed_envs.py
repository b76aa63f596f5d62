from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from policy_factory import register_test_envs

from policies.envs import modules as env_modules
from policies.envs.make import make_env
from policies.envs.modules import allow_modules
from policies.errors import EnvError
from policies.packed.envs.make import make_packed_envs
from policies.packed.envs.vector import EnvKind

if TYPE_CHECKING:
    from policies.packed.envs.vector import PackedEnvs, Step


register_test_envs()


@pytest.fixture(autouse=True)
def own_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    """The modules of these tests are allowed, and are not any more when they are over."""
    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["odd_envs", "policy_factory"])


N = 3
KINDS = [
    pytest.param("CartPole-v1", "vectorised", id="cartpole-vectorised"),
    pytest.param("CartPole-v1", "scalar", id="cartpole-scalar"),
    pytest.param("Pendulum-v1", "scalar", id="pendulum-scalar"),
    pytest.param("Pendulum-v1", "processes", id="pendulum-processes"),
    pytest.param("Pendulum-v1", "vectorised", id="pendulum-vectorised"),
    pytest.param("MountainCarContinuous-v0", "vectorised", id="continuous-vectorised"),
    pytest.param("Acrobot-v1", "vectorised", id="acrobot-vectorised"),
]


@pytest.fixture
def make() -> Iterator[Any]:
    made = []

    def make_one(
        env_id: str,
        kind: EnvKind,
        num_envs: int = N,
        env_args: Any = None,
        members: Mapping[str, int] = MappingProxyType({}),
        **kwargs: Any,
    ) -> PackedEnvs:
        envs = make_packed_envs(env_id, env_args, num_envs, kind=kind, **kwargs)
        made.append(envs)
        for member_id, seed in dict(members).items():
            envs.add(member_id, seed)
        return envs

    yield make_one
    for envs in made:
        envs.close()
    assert multiprocessing.active_children() == []


class Actor:
    """The actions of one member: the same ones again for the same seed."""

    def __init__(self, space: Any, seed: int, num_envs: int = N) -> None:
        self.space, self.rng, self.num_envs = space, np.random.default_rng(seed), num_envs

    def __call__(self) -> NDArray[Any]:
        if isinstance(self.space, gym.spaces.Discrete):
            return self.rng.integers(0, int(self.space.n), self.num_envs)
        size = (self.num_envs, *self.space.shape)
        return self.rng.uniform(self.space.low, self.space.high, size).astype(np.float32)


def step_all(envs: PackedEnvs, actors: dict[str, Actor]) -> Step:
    return envs.step(np.concatenate([actors[member_id]() for member_id in envs.member_ids]))


def rows_of(envs: PackedEnvs, member_id: str, num_envs: int = N) -> slice:
    first = envs.member_ids.index(member_id) * num_envs
    return slice(first, first + num_envs)


def go_on(envs: PackedEnvs, breaking: str | None = None, how: int = 0, place: int = 1) -> Step:
    actions = np.zeros(len(envs.observations), dtype=np.int64)
    if breaking is not None:
        actions[rows_of(envs, breaking)][place] = how
    return envs.step(actions)


def seen_by(envs: PackedEnvs, step: Step, member_id: str) -> dict[str, NDArray[Any]]:
    rows = rows_of(envs, member_id)
    names = ("observations", "final_observations", "rewards", "own_rewards", "terminated", "truncated")
    return {name: getattr(step, name)[rows].copy() for name in names}


def assert_equal_bits(one: Sequence[dict[str, NDArray[Any]]], another: Sequence[dict[str, NDArray[Any]]]) -> None:
    assert len(one) == len(another)
    for left, right in zip(one, another, strict=True):
        for name, values in left.items():
            np.testing.assert_array_equal(values, right[name], err_msg=name)


# -- any kind


@pytest.mark.parametrize(("env_id", "kind"), KINDS)
def test_a_member_gets_the_same_beside_any_others(make: Any, env_id: str, kind: str) -> None:
    def trace_alone(member_id: str, seed: int, actor_seed: int) -> list[dict[str, NDArray[Any]]]:
        envs = make(env_id, kind, env_args={"max_episode_steps": 15}, members={member_id: seed}, num_processes=2)
        actor = Actor(envs.action_space, actor_seed)
        return [seen_by(envs, envs.step(actor()), member_id) for _ in range(60)]

    alone = {"a": trace_alone("a", 11, 0), "z": trace_alone("z", 7, 1)}
    envs = make(env_id, kind, env_args={"max_episode_steps": 15}, members={"x": 5, "a": 11, "y": 6}, num_processes=2)
    actors = {name: Actor(envs.action_space, seed) for seed, name in enumerate(("a", "z", "x", "y"))}
    beside: dict[str, list[Any]] = {"a": [], "z": []}
    for index in range(77):
        # In the middle of episodes, and of a stretch of steps.
        if index == 8:
            envs.remove("x")
        elif index == 17:
            envs.add("z", 7)
        elif index == 33:
            envs.arrange(["z", "a", "y"])
        if index % 25 == 0:
            envs.begin(25)
        step = step_all(envs, actors)
        for member_id in {"a", "z"}.intersection(envs.member_ids):
            beside[member_id].append(seen_by(envs, step, member_id))
    for member_id, trace in alone.items():
        assert_equal_bits(beside[member_id][:60], trace)
        assert sum(seen["truncated"].sum() + seen["terminated"].sum() for seen in trace) >= 9


@pytest.mark.parametrize(("env_id", "kind"), KINDS)
def test_running_episodes_go_on_when_members_come_go_and_are_arranged(make: Any, env_id: str, kind: str) -> None:
    envs = make(env_id, kind, members={"a": 1, "b": 2, "c": 3}, num_processes=2)
    actors = {name: Actor(envs.action_space, seed) for seed, name in enumerate("abcd")}
    step_all(envs, actors)

    def observed() -> dict[str, NDArray[np.float32]]:
        return {member_id: envs.observations[rows_of(envs, member_id)].copy() for member_id in envs.member_ids}

    before = observed()
    envs.arrange(["c", "a", "b"])
    assert envs.member_ids == ("c", "a", "b")
    envs.add("d", 4)
    envs.remove("a")
    assert envs.member_ids == ("c", "b", "d")
    after = observed()
    for member_id in ("b", "c"):
        np.testing.assert_array_equal(after[member_id], before[member_id])
    fresh = make(env_id, kind, members={"d": 4}, num_processes=1)
    np.testing.assert_array_equal(after["d"], fresh.observations)
    step = step_all(envs, actors)
    assert len(step.rewards) == len(step.observations) == len(envs.observations) == 3 * N


@pytest.mark.parametrize(("env_id", "kind"), KINDS)
def test_members_are_named_once_and_all_of_them_are_arranged(make: Any, env_id: str, kind: str) -> None:
    envs = make(env_id, kind, members={"a": 1, "b": 2}, num_processes=1)
    with pytest.raises(ValueError, match="a member already"):
        envs.add("a", 3)
    with pytest.raises(ValueError, match="the members are a, b"):
        envs.arrange(["a"])
    assert envs.member_ids == ("a", "b")
    assert len(envs.observations) == 2 * N
    for member_id in ("a", "b"):
        envs.remove(member_id)
    assert envs.member_ids == ()
    assert len(envs.observations) == 0
    envs.add("a", 1)
    assert len(envs.observations) == N


@pytest.mark.parametrize(("env_id", "kind"), KINDS)
def test_no_step_spans_a_reset(make: Any, env_id: str, kind: str) -> None:
    limit = 6
    envs = make(env_id, kind, env_args={"max_episode_steps": limit}, members={"a": 1, "b": 2}, num_processes=2)
    actors = {"a": Actor(envs.action_space, 0), "b": Actor(envs.action_space, 1)}
    envs.begin(40)
    kept = []
    for index in range(1, 41):
        step = step_all(envs, actors)
        ended = step.terminated | step.truncated
        assert ended.all() if index % limit == 0 else not ended.any()  # so each episode has all its steps
        assert envs.observations is step.observations
        if ended.any():
            assert (step.observations[ended] != step.final_observations[ended]).any(axis=1).all()
        else:
            assert step.final_observations is step.observations
        assert step.own_rewards is step.rewards
        assert step.observations.dtype == step.rewards.dtype == np.float32
        assert step.terminated.dtype == step.truncated.dtype == np.bool_
        kept.append((step, {name: np.copy(value) for name, value in vars(step).items()}))
    for step, values in kept:  # arrays are not written to again
        for name, value in values.items():
            np.testing.assert_array_equal(getattr(step, name), value)


@pytest.mark.parametrize("kind", ["vectorised", "scalar"])
def test_truncated_is_not_terminated(make: Any, kind: str) -> None:
    envs = make("CartPole-v1", kind, env_args={"max_episode_steps": 12}, num_envs=2, members={"a": 1})
    balanced, pushed = [], []
    for index in range(12):
        step = envs.step(np.array([index % 2, 0]))
        balanced.append((bool(step.terminated[0]), bool(step.truncated[0])))
        pushed.append((bool(step.terminated[1]), bool(step.truncated[1])))
    assert balanced == [(False, False)] * 11 + [(False, True)]
    assert (True, False) in pushed
    assert not any(truncated for _, truncated in pushed)


@pytest.mark.parametrize("kind", ["vectorised", "scalar"])
def test_the_failure_penalty_is_for_the_learner_alone(make: Any, kind: str) -> None:
    envs = make("CartPole-v1", kind, env_args={"max_episode_steps": 12}, members={"a": 1}, failure_penalty=-7.5)
    num_failed = num_truncated = 0
    for index in range(40):
        step = envs.step(np.array([0, 1, index % 2]))
        failed = step.terminated
        num_failed, num_truncated = num_failed + failed.sum(), num_truncated + step.truncated.sum()
        np.testing.assert_array_equal(step.rewards, np.where(failed, np.float32(-7.5), np.float32(1)))
        np.testing.assert_array_equal(step.own_rewards, np.ones(N, np.float32))
        assert step.rewards.dtype == np.float32
    assert num_failed > 4
    assert num_truncated == 3


def test_a_penalty_without_a_failure_is_refused() -> None:
    for kind in ("scalar", "processes"):
        with pytest.raises(EnvError, match="no failure"):
            make_packed_envs("MountainCar-v0", None, 2, kind=kind, failure_penalty=-1)


# -- scalar environments


@pytest.mark.parametrize(
    ("env_id", "env_args", "kind"),
    [
        *((env_id, env_args, kind) for env_id, env_args in (
            ("CartPole-v1", {"frame_stack": 2}),
            ("Pendulum-v1", {"max_episode_steps": 9}),
            ("policy_factory:Walk", {"end": 1.0}),
        ) for kind in ("scalar", "processes")),
        ("Pendulum-v1", {"max_episode_steps": 9}, "vectorised"),
        ("Pendulum-v1", {"max_episode_steps": 9, "g": 3}, "vectorised"),
        ("MountainCar-v0", {"max_episode_steps": 7, "goal_velocity": 0.01}, "vectorised"),
        ("MountainCarContinuous-v0", {"max_episode_steps": 11}, "vectorised"),
        ("Acrobot-v1", {"max_episode_steps": 8}, "vectorised"),
    ],
)  # fmt: skip
def test_sub_environments_are_those_of_gym_make_with_seeds_one_after_the_other(
    make: Any, env_id: str, env_args: Any, kind: str
) -> None:
    envs = make(env_id, kind, env_args=env_args, members={"a": 2**32 - 2}, num_processes=2)
    scalars = [make_env(env_id, env_args) for _ in range(N)]
    first = [env.reset(seed=seed)[0] for env, seed in zip(scalars, (2**32 - 2, 2**32 - 1, 0), strict=True)]
    np.testing.assert_array_equal(envs.observations, np.array(first, np.float32))
    actor, num_ended = Actor(envs.action_space, 0), 0
    for _ in range(60):
        actions = actor()
        step = envs.step(actions)
        for row, env in enumerate(scalars):
            action = int(actions[row]) + int(cast("Any", env.action_space).start) if actions.ndim == 1 else actions[row]
            observation, reward, terminated, truncated, _ = env.step(action)
            np.testing.assert_array_equal(step.final_observations[row], np.asarray(observation, np.float32))
            assert step.rewards[row] == np.float32(reward)
            assert (step.terminated[row], step.truncated[row]) == (terminated, truncated)
            if terminated or truncated:
                observation, _ = env.reset()
                num_ended += 1
            np.testing.assert_array_equal(step.observations[row], np.asarray(observation, np.float32))
    assert num_ended


def test_images_stay_bytes(make: Any) -> None:
    envs = make("CartPole-v1", "scalar", env_args={"pixels": True}, num_envs=1, members={"a": 1})
    assert envs.observations.dtype == np.uint8
    step = envs.step(np.array([1]))
    assert step.observations.shape == (1, 40, 60, 1)
    assert step.observations.max() > 0


def test_an_env_may_write_into_its_action(make: Any) -> None:
    class Greedy(gym.Env[Any, Any]):
        observation_space = gym.spaces.Box(-1, 1, (1,))
        action_space = gym.spaces.Box(-1, 1, (2,))

        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[Any, dict[str, Any]]:
            return np.zeros(1, np.float32), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            action[:] = 9.0
            return np.zeros(1, np.float32), 0.0, False, False, {}

    gym.register("TestGreedy-v0", cast("Any", Greedy))
    try:
        envs = make("TestGreedy-v0", "scalar", num_envs=2, members={"a": 1})
        actions = np.zeros((2, 2), np.float32)
        envs.step(actions)
        assert (actions == 0).all()
    finally:
        del gym.registry["TestGreedy-v0"]
