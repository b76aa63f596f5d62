from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from policy_factory import balancing_policy, make_policy, make_portable, register_test_envs

import policies.acting.classic_players
from policies.acting.evaluate import Episodes, Evaluator, episode_steps, evaluate_policy, play_episode
from policies.acting.policy import NetworkPolicy, Policy, RandomPolicy
from policies.envs import calls
from policies.envs.make import make_env
from policies.errors import EnvError, NonFiniteWeightsError, SpecError
from policies.packed.evaluation import evaluate_many
from tests.narrowing import present

register_test_envs()
pytestmark = pytest.mark.filterwarnings("ignore:.*CartPole-v0 is out of date")


def by_hand(
    policy: NetworkPolicy,
    env_id: str,
    seeds: range | Sequence[int] | tuple[int, ...],
    max_steps: int = 10**9,
    **env_args: Any,
) -> Episodes:
    """The definition of an episode, in a few lines of its own."""
    env = gym.make(env_id, **env_args)
    returns, lengths = [], []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        returns.append(0.0)
        lengths.append(0)
        ended = False
        while not ended and lengths[-1] < max_steps:
            observation, reward, terminated, truncated, _ = env.step(policy.act(observation))
            returns[-1] += float(reward)
            lengths[-1] += 1
            ended = terminated or truncated
    return Episodes(tuple(seeds), tuple(returns), tuple(lengths))


@pytest.mark.parametrize("env_id", ["CartPole-v0", "CartPole-v1"])
@pytest.mark.parametrize("skill", ["good", "fair", "wobbly", "poor"])
def test_vectorised_cartpole_plays_the_scalar_env_s_episodes(env_id: str, skill: str) -> None:
    policy, seeds = balancing_policy(env_id, skill), tuple(range(1000, 1100))
    expected = by_hand(policy, env_id, seeds)
    assert evaluate_policy(policy, env_id=env_id, seeds=seeds) == expected
    if skill == "good":
        assert set(expected.lengths) == {200 if env_id == "CartPole-v0" else 500}
    if skill in {"wobbly", "poor"}:
        assert len(set(expected.lengths)) > 20  # or the test would see little


@pytest.mark.parametrize("skill", ["good", "poor"])
def test_vectorised_cartpole_has_the_scalar_env_s_other_reward(skill: str) -> None:
    policy, seeds = balancing_policy("CartPole-v1", skill), tuple(range(20))
    expected = by_hand(policy, "CartPole-v1", seeds, sutton_barto_reward=True)
    assert set(expected.returns) == ({0.0} if skill == "good" else {-1.0})
    ours = evaluate_policy(policy, env_id="CartPole-v1", env_args={"sutton_barto_reward": True}, seeds=seeds)
    assert ours == expected


@pytest.mark.parametrize("env_id", ["MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1", "Acrobot-v1"])
def test_rows_of_classic_control_play_the_scalar_env_s_episodes(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policies.acting.classic_players, "_MAX_ROWS", 5)
    some, seeds = [make_policy(env_id, seed=seed) for seed in (1, 2, 3)], tuple(range(1000, 1012))
    expected = [by_hand(policy, env_id, seeds, 300) for policy in some]
    assert len({total for episodes in expected for total in episodes.returns}) > 3 or env_id == "MountainCar-v0"
    with Evaluator(env_id, None, seeds, max_episode_steps=300) as evaluator:
        assert evaluator.starts is not None
        assert [evaluator.run(policy) for policy in some] == expected
        assert evaluate_many(evaluator, some) == expected


def test_of_another_env_none_is_made_to_see_whether_it_has_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def counted(env_id: str, *args: Any, **kwargs: Any) -> Any:
        made.append(env_id)
        return make_env(env_id, *args, **kwargs)

    for module in ("policies.acting.evaluate", "policies.envs.classic_rows"):
        monkeypatch.setattr(f"{module}.make_env", counted)
    Evaluator("TestWalk-v0", None, (1, 2)).close()
    assert made == ["TestWalk-v0"]


def test_a_watched_process_says_that_it_steps_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    number = os.memfd_create("page")
    os.truncate(number, calls.PAGE_BYTES)
    page = calls.Page(number)
    monkeypatch.setattr(calls, "_page", page)
    with Evaluator("Acrobot-v1", None, (1, 2), max_episode_steps=20) as evaluator:
        before = page.count
        evaluator.run(make_policy("Acrobot-v1", seed=2))
    os.close(number)
    assert page.count >= before + 40
    assert page.steps == 20


def test_actions_that_are_no_numbers_are_the_policy_s_own_failure() -> None:
    # Finite weights, of which outputs get infinite, and infinity less infinity is no number.
    portable = make_portable("Pendulum-v1", seed=1)
    layers = [
        dataclasses.replace(layer, weight=layer.weight * np.float32(5e37), activation=activation)
        for layer, activation in zip(portable.network.layers, ("relu", "relu", "linear"), strict=True)
    ]
    wild = dataclasses.replace(portable, network=dataclasses.replace(portable.network, layers=tuple(layers)))
    broken, sane = NetworkPolicy(wild), make_policy("Pendulum-v1", seed=2)
    with np.errstate(all="ignore"), Evaluator("Pendulum-v1", None, (1, 2, 3), max_episode_steps=20) as evaluator:
        with pytest.raises(EnvError, match=r"(reward|observation) .* of Pendulum-v1 was NaN"):
            evaluator.run(broken)
        failed, played = evaluate_many(evaluator, [broken, sane])
    assert isinstance(failed, EnvError)
    assert played == by_hand(sane, "Pendulum-v1", (1, 2, 3), 20)


@pytest.mark.parametrize("args", [{"pixels": True}, {"frame_stack": 3}, {"pixels": True, "frame_stack": 2}])
def test_cartpole_in_wrappers_is_played_with_them(args: dict[str, bool | int]) -> None:
    class Parity(Policy):
        """Acts by the whole observation, whatever its shape."""

        def _act_batch(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
            return np.array([int(1000 * abs(observation.sum(dtype=np.float64))) % 2 for observation in observations])

    env, seeds = make_env("CartPole-v1", args), tuple(range(8))
    policy = Parity(env.observation_space, env.action_space, env_id="CartPole-v1", env_args=args, description="parity")
    expected = [play_episode(policy, env, seed, max_episode_steps=40) for seed in seeds]
    assert len(set(expected)) > 1
    played = evaluate_policy(policy, env_id="CartPole-v1", env_args=args, seeds=seeds, max_episode_steps=40)
    assert list(zip(played.returns, played.lengths, strict=True)) == expected


def test_vectorised_cartpole_sees_the_scalar_env_s_observations_to_the_last_bit() -> None:
    seen = []

    class Spy(NetworkPolicy):
        def act(self, observations: Any, mask: Any = None) -> Any:
            seen.append(np.array(observations))
            return super().act(observations, mask)

    policy = Spy(make_portable("CartPole-v1", seed=2))
    episodes = evaluate_policy(policy, env_id="CartPole-v1", seeds=[11, 12])
    vectorised, seen = list(seen), []
    for side, seed in enumerate((11, 12)):
        seen = []
        by_hand(policy, "CartPole-v1", [seed])
        assert len(seen) == episodes.lengths[side]
        for step, observation in enumerate(seen):
            np.testing.assert_array_equal(observation, vectorised[step][side])


@pytest.mark.parametrize("env_id", ["CartPole-v0", "Pendulum-v1", "TestWalk-v0"])
def test_an_episode_depends_on_its_seed_alone(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policies.acting.classic_players, "_MAX_CARTPOLES", 8)
    policy = balancing_policy(env_id, "poor") if env_id == "CartPole-v0" else make_policy(env_id, seed=1)
    seeds = tuple(int(seed) for seed in np.random.default_rng(0).permutation(40)[:21])
    whole = evaluate_policy(policy, env_id=env_id, seeds=seeds, max_episode_steps=60)
    assert whole.seeds == seeds
    assert whole == by_hand(policy, env_id, seeds, 60)
    back = evaluate_policy(policy, env_id=env_id, seeds=seeds[::-1], max_episode_steps=60)
    assert (back.returns[::-1], back.lengths[::-1]) == (whole.returns, whole.lengths)
    alone = [evaluate_policy(policy, env_id=env_id, seeds=[seed], max_episode_steps=60).returns[0] for seed in seeds]
    assert tuple(alone) == whole.returns


def test_an_evaluator_can_be_used_again_and_again() -> None:
    first, second = balancing_policy(skill="poor"), balancing_policy(skill="wobbly")
    with Evaluator("CartPole-v0", None, range(12)) as evaluator:
        results = [evaluator.run(policy) for policy in (first, second, first)]
    assert results[0] == results[2] != results[1]
    assert results[1] == by_hand(second, "CartPole-v0", range(12))


def test_other_envs_run_side_by_side_and_a_free_one_takes_the_next_seed() -> None:
    policy, seeds = make_policy("TestWalk-v0", seed=1), tuple(range(17))
    with Evaluator("TestWalk-v0", {"end": 2.0}, seeds, max_episode_steps=300, max_envs=3) as evaluator:
        result = evaluator.run(policy)
        assert len(evaluator._envs) == 3
        assert evaluator.run(policy) == result
    assert result == by_hand(policy, "TestWalk-v0", seeds, 300, end=2.0)
    assert len(set(result.lengths)) > 5


def test_continuous_actions() -> None:
    policy = make_policy("Pendulum-v1", seed=3)
    result = evaluate_policy(policy, env_id="Pendulum-v1", seeds=range(5))
    assert result == by_hand(policy, "Pendulum-v1", range(5))
    assert result.lengths == (200,) * 5
    assert result.mean_return == pytest.approx(np.mean(result.returns))


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_a_random_policy_repeats_itself(env_id: str) -> None:
    policy = RandomPolicy.for_env(env_id, seed=1)
    first = evaluate_policy(policy, env_id=env_id, seeds=range(6))
    policy.act(np.zeros(policy.observation_space.shape))
    assert evaluate_policy(policy, env_id=env_id, seeds=range(6)) == first
    assert evaluate_policy(RandomPolicy.for_env(env_id), env_id=env_id, seeds=range(3)).returns == first.returns[:3]
    assert len(set(first.returns)) > 1


def test_a_random_policy_scores_what_is_known_of_it() -> None:
    result = evaluate_policy(RandomPolicy.for_env("CartPole-v1"), env_id="CartPole-v1", seeds=range(300))
    assert 19 < result.mean_return < 26


def test_an_endless_episode_is_cut_off() -> None:
    policy = make_policy("TestWalk-v0")
    assert evaluate_policy(policy, env_id="TestWalk-v0", seeds=[0]).lengths == (10_000,)
    assert evaluate_policy(policy, env_id="TestWalk-v0", seeds=[0], max_episode_steps=7).lengths == (7,)
    short = evaluate_policy(balancing_policy(), env_id="CartPole-v0", seeds=[0, 1], max_episode_steps=7)
    assert (short.lengths, short.returns) == ((7, 7), (7.0, 7.0))
    for env_id in ("CartPole-v0", "Pendulum-v1"):  # the env's own limit holds below the cap
        policy = balancing_policy() if env_id == "CartPole-v0" else make_policy(env_id)
        assert evaluate_policy(policy, env_id=env_id, seeds=[0], max_episode_steps=999).lengths == (200,)
    capped = evaluate_policy(
        balancing_policy("CartPole-v1"),
        env_id="CartPole-v1",
        env_args={"max_episode_steps": 40},
        seeds=[0, 1],
    )
    assert capped.lengths == (40, 40)


@pytest.mark.parametrize("env_id", ["CartPole-v0", "Pendulum-v1"])
def test_weights_that_are_not_finite_are_refused(env_id: str) -> None:
    portable = make_portable(env_id)
    portable.network.layers[0].weight[0, 0] = np.nan
    with pytest.raises(NonFiniteWeightsError, match="layer 0"):
        evaluate_policy(NetworkPolicy(portable), env_id=env_id, seeds=[0])


@pytest.mark.parametrize(
    ("policy_env", "env_id", "words"),
    [
        ("CartPole-v1", "Pendulum-v1", "observations"),
        ("CartPole-v1", "Acrobot-v1", "observations"),
        ("MountainCar-v0", "MountainCarContinuous-v0", "actions"),
        ("MountainCar-v0", "TestWalk-v0", "actions"),
    ],
)
def test_a_policy_for_another_env_is_refused(policy_env: str, env_id: str, words: str) -> None:
    with pytest.raises(EnvError, match=f"is for {policy_env}, whose {words}"):
        evaluate_policy(make_policy(policy_env), env_id=env_id, seeds=[0])


def test_a_policy_for_one_cartpole_may_act_in_the_other() -> None:
    assert evaluate_policy(balancing_policy("CartPole-v0"), env_id="CartPole-v1", seeds=[0]).lengths == (500,)


@pytest.mark.parametrize("policy", [make_policy("TestWalk-v0"), RandomPolicy.for_env("TestWalk-v0")])
def test_an_env_that_raises_is_one_clear_error(policy: NetworkPolicy | RandomPolicy) -> None:
    with pytest.raises(
        EnvError, match=r"step\(\) of the episode with seed 5, after 2 steps: RuntimeError: the motor broke"
    ):
        evaluate_policy(policy, env_id="TestWalk-v0", env_args={"fail_at": 3}, seeds=[5])


@pytest.mark.parametrize(("seeds", "cap"), [([], None), ([1, -1], None), ([1], 0)])
def test_seeds_and_caps_out_of_range_are_refused(seeds: list[int], cap: int | None) -> None:
    with pytest.raises(SpecError):
        evaluate_policy(balancing_policy(), env_id="CartPole-v0", seeds=seeds, max_episode_steps=cap)


def test_an_episode_step_by_step() -> None:
    policy, env = balancing_policy(skill="poor"), make_env("CartPole-v0")
    steps = list(episode_steps(policy, env, 3, max_episode_steps=200))
    assert [moment.num_env_steps for moment in steps] == list(range(len(steps)))
    assert [moment.over for moment in steps] == [False] * (len(steps) - 1) + [True]
    assert play_episode(policy, env, 3, max_episode_steps=200) == (steps[-1].total, steps[-1].num_env_steps)
    assert steps[-1].ended_by == "terminated"
    assert (steps[0].observation, steps[0].action) == (None, None)
    assert [moment.action for moment in steps[1:]] == [policy.act(present(moment.observation)) for moment in steps[1:]]


@pytest.mark.parametrize(("limit", "cap", "ended_by"), [(5, 200, "truncated"), (200, 5, "cap")])
def test_it_is_said_how_an_episode_ended(limit: int, cap: int, ended_by: str) -> None:
    env = make_env("CartPole-v0", {"max_episode_steps": limit})
    *_, last = episode_steps(balancing_policy(), env, 3, max_episode_steps=cap)
    assert (last.num_env_steps, last.ended_by) == (5, ended_by)


class SameArray(gym.Env[Any, Any]):
    """Writes each observation into the array that it has given before."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self) -> None:
        self.numbers = np.zeros(1, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.numbers, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.numbers += 1
        return self.numbers, 1.0, bool(self.numbers[0] == 3), False, {}


def test_a_moment_has_what_the_policy_saw_where_an_env_writes_over_it() -> None:
    env = SameArray()
    policy = RandomPolicy(env.observation_space, env.action_space, env_id="SameArray")
    _, *steps = episode_steps(policy, env, 0, max_episode_steps=9)
    assert [present(moment.observation).tolist() for moment in steps] == [[0.0], [1.0], [2.0]]


def test_episodes_are_plain_values() -> None:
    episodes = evaluate_policy(balancing_policy(), env_id="CartPole-v0", seeds=cast("Any", np.arange(2)))
    for values, kind in ((episodes.seeds, int), (episodes.returns, float), (episodes.lengths, int)):
        assert isinstance(values, tuple)
        assert all(type(value) is kind for value in values)
    assert dataclasses.asdict(episodes)["lengths"] == (200, 200)
