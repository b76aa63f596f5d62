"""Rewards are normalised as Gymnasium and Stable-Baselines3 do it, in training alone, and checkpoints keep how."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers.utils import RunningMeanStd
from numpy.typing import NDArray

from policies.errors import CheckpointError
from policies.hyperparams import PPOHyperparams
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from policies.packed.state import load_member, save_member
from policies.return_statistics import ReturnStatistics, discounted_returns

if TYPE_CHECKING:
    from policies.packed.ppo.stack import Fragment, PPOStack

SMALL: dict[str, Any] = {"hidden_sizes": (4,), "num_envs": 4, "train_batch_size": 128, "minibatch_size": 64, "lr": 1e-2}
GAMMA = 0.9


class Scripted(gym.vector.VectorEnv[Any, Any, Any]):
    """Gives the rewards of a script, (T, N), and never ends an episode."""

    def __init__(self, rewards: NDArray[np.float64]) -> None:
        self.num_envs = rewards.shape[1]
        self._rewards = iter(rewards)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        no = np.zeros(self.num_envs, dtype=np.bool_)
        return np.zeros(self.num_envs), next(self._rewards), no, no, {}


def test_statistics_and_rewards_are_those_of_gymnasiums_wrapper() -> None:
    rewards = np.random.default_rng(0).normal(-1.0, 3.0, size=(60, 3))
    wrapper = gym.wrappers.vector.NormalizeReward(Scripted(rewards), gamma=GAMMA)
    statistics, before = ReturnStatistics(), np.zeros(3)
    for start in range(0, 60, 20):
        for _ in range(20):
            _, theirs, *_ = wrapper.step(None)
        part = rewards[start : start + 20]
        returns, before = discounted_returns(part, np.zeros(part.shape, dtype=np.bool_), GAMMA, before)
        statistics.add(returns)
        rms = wrapper.return_rms
        assert vars(statistics) == pytest.approx({"mean": rms.mean, "var": rms.var, "count": rms.count}, rel=1e-9)
        # After the iteration's last step both divide by the same number.
        np.testing.assert_allclose(statistics.scale(part)[-1], theirs, rtol=1e-6)


def test_returns_begin_anew_after_the_last_step_of_an_episode() -> None:
    """As in Stable-Baselines3: `returns = returns * gamma + reward`, statistics, `returns[dones] = 0`."""
    rng = np.random.default_rng(1)
    rewards, ended = rng.normal(size=(50, 4)), rng.random((50, 4)) < 0.2
    rms, running, expected = RunningMeanStd(), np.zeros(4), []  # type: ignore[no-untyped-call]
    for reward, done in zip(rewards, ended, strict=True):
        running = running * GAMMA + reward
        rms.update(running)  # type: ignore[no-untyped-call]
        expected.append(running.copy())
        running[done] = 0.0
    statistics, before, found = ReturnStatistics(), np.zeros(4), []
    for steps in (slice(0, 7), slice(7, 8), slice(8, 50)):
        returns, before = discounted_returns(rewards[steps], ended[steps], GAMMA, before)
        statistics.add(returns)
        found.append(returns)
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=1e-12)
    np.testing.assert_allclose(before, running, rtol=1e-12)
    assert (statistics.mean, statistics.var) == pytest.approx((rms.mean, rms.var), rel=1e-9)


def test_normalised_rewards_are_clipped_and_keep_their_sign() -> None:
    statistics = ReturnStatistics(mean=100.0, var=4.0, count=10.0)
    np.testing.assert_allclose(statistics.scale(np.array([3.0, -1.0, 0.0, 21.0, -1e9])), [1.5, -0.5, 0, 10, -10])
    # Rewards that are all the same number, or none: the deviation is small, never 0.
    statistics = ReturnStatistics()
    statistics.add(np.zeros((50, 2)))
    assert np.isfinite(statistics.scale(np.ones(3))).all()
    assert not statistics.scale(np.zeros(3)).any()


# -- in a pack


def stack_of(*members: dict[str, Any], env_id: str = "CartPole-v1", env_args: dict[str, Any] | None = None) -> PPOStack:
    settings = [PPOHyperparams(**{**SMALL, "gamma": GAMMA, **values}) for values in members]
    envs = make_packed_envs(env_id, env_args or {}, 4, kind="scalar")
    stack = cast("PPOStack", make_stack(settings[0], envs))
    for index, hyperparams in enumerate(settings):
        stack.add(new_member(f"m{index}", hyperparams, 3, envs.observation_space, envs.action_space), 3)
    return stack


def fragments_of(stack: PPOStack, num_iterations: int, monkeypatch: pytest.MonkeyPatch) -> list[Fragment]:
    found, take = [], stack._sample

    def taking(num_steps: int) -> Fragment:
        found.append(take(num_steps))
        return found[-1]

    monkeypatch.setattr(stack, "_sample", taking)
    for _ in range(num_iterations):
        stack.train_iteration()
    return found


@pytest.mark.parametrize("env_args", [{}, {"max_episode_steps": 9}])
def test_a_pack_learns_from_normalised_rewards(env_args: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes that end, and such that are cut off at 9 steps; the returns of both go over iterations."""
    stack = stack_of({"normalize_rewards": True}, env_args=env_args)
    rms, running = RunningMeanStd(), np.zeros(4)  # type: ignore[no-untyped-call]
    fragments = fragments_of(stack, 3, monkeypatch)
    for fragment in fragments:
        for reward, done in zip(fragment.own_rewards, fragment.ended, strict=True):
            running = running * GAMMA + reward
            rms.update(running)  # type: ignore[no-untyped-call]
            running[done] = 0.0
        scale = np.sqrt(rms.var + 1e-8)
        np.testing.assert_allclose(fragment.rewards, np.clip(fragment.own_rewards / scale, -10, 10), rtol=1e-6)
    np.testing.assert_array_equal([fragment.own_rewards for fragment in fragments], 1.0)
    assert any(fragment.cuts for fragment in fragments) is bool(env_args)
    member = stack.member("m0")
    assert (member.return_statistics.mean, member.return_statistics.var) == pytest.approx((rms.mean, rms.var))
    stack.envs.close()


def test_it_changes_training_only_where_it_is_on_and_never_what_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    stack = stack_of({}, {"normalize_rewards": True})
    stats = stack.train_iteration()
    # Sampled by the same policy with the same seeds: returns are the env's own.
    assert stats["m0"].episodes == stats["m1"].episodes
    assert len(stats["m0"].episodes) > 2
    assert all(value == length for value, length in stats["m1"].episodes)
    assert stats["m0"].learner["vf_loss"] != pytest.approx(stats["m1"].learner["vf_loss"], rel=0.1)
    (fragment,) = fragments_of(stack, 1, monkeypatch)
    places = {member.member_id: slice(4 * row, 4 * row + 4) for row, member in enumerate(stack.members)}
    np.testing.assert_array_equal(fragment.rewards[:, places["m0"]], 1.0)
    assert fragment.rewards[:, places["m1"]].max() < 0.9
    off, on = stack.member("m0"), stack.member("m1")
    assert any(np.abs(on.weights[name] - value).max() > 1e-3 for name, value in off.weights.items())
    assert off.return_statistics == ReturnStatistics()
    stack.envs.close()


def test_checkpoints_keep_the_statistics(tmp_path: Path) -> None:
    stack = stack_of({"normalize_rewards": True}, {})
    stack.train_iteration()
    on, off = stack.member("m0"), stack.member("m1")
    for name, member in (("on", on), ("off", off)):
        save_member(member, tmp_path / name)
    loaded = cast("Any", load_member(tmp_path / "on", "m0"))
    assert loaded.return_statistics == on.return_statistics
    assert on.return_statistics.count == pytest.approx(128)
    assert cast("Any", load_member(tmp_path / "off", "m1")).return_statistics == ReturnStatistics()
    # It goes on with them; its environments begin new episodes.
    stack.remove("m0")
    stack.add(loaded, 5)
    stack.train_iteration()
    assert stack.member("m0").return_statistics.count == pytest.approx(256)
    stack.envs.close()
    state = tmp_path / "on" / "state.json"
    description = json.loads(state.read_text())
    assert "return_statistics" not in json.loads((tmp_path / "off" / "state.json").read_text())
    del description["return_statistics"]
    state.write_text(json.dumps(description))
    with pytest.raises(CheckpointError, match="return_statistics"):
        load_member(tmp_path / "on", "m0")
