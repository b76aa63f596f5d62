"""Episodes for somebody who watches: those that are evaluated, with what the policy saw, did and thought."""

import base64
import io
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from policies.acting.evaluate import evaluate_policy
from policies.acting.live import LiveActions, LiveStep, watch_episode
from policies.acting.policy import NetworkPolicy, Policy, RandomPolicy
from policies.envs.make import check_env
from policies.envs.spaces import describe_space
from policies.errors import EnvError
from policies.portable.file import PortablePolicy
from policies.portable.network import Layer, NetworkKind, PolicyNetwork


def policy_for(env_id: str, kind: NetworkKind, num_outputs: int, **training: Any) -> NetworkPolicy:
    """A policy of one layer, with weights from fixed random numbers."""
    info, rng = check_env(env_id, {}), np.random.default_rng(0)
    num_inputs = int(np.prod(info.observation_space.shape or ()))
    weight = rng.normal(size=(num_outputs, num_inputs)).astype(np.float32)
    layer = Layer(weight, np.zeros(num_outputs, dtype=np.float32))
    return NetworkPolicy(
        PortablePolicy(
            PolicyNetwork(kind, (layer,)), "dqn" if kind == "q_values" else "ppo", env_id, {},
            describe_space(info.observation_space), describe_space(info.action_space),
            "unsquash" if kind == "gaussian" else "none", training,
        )
    )  # fmt: skip


def watched(policy: Policy, env_id: str, seed: int = 3) -> tuple[Any, list[LiveStep]]:
    info, steps = watch_episode(policy, env_id, {}, seed)
    return info, list(steps)


def test_it_is_the_episode_that_is_evaluated() -> None:
    policy = policy_for("CartPole-v1", "categorical", 2)
    _, steps = watched(policy, "CartPole-v1")
    evaluated = evaluate_policy(policy, env_id="CartPole-v1", seeds=[3])
    assert (steps[-1].total, steps[-1].num_env_steps, steps[-1].over) == (
        evaluated.returns[0],
        evaluated.lengths[0],
        True,
    )
    assert [step.num_env_steps for step in steps] == list(range(len(steps)))
    assert not any(step.over for step in steps[:-1])
    assert [step.ended_by for step in steps] == [None] * (len(steps) - 1) + ["terminated"]


def test_a_step_has_what_the_policy_saw_and_did() -> None:
    policy = policy_for("CartPole-v1", "categorical", 2)
    info, (reset, first, *_) = watched(policy, "CartPole-v1")
    assert (info.env_id, info.fps, info.is_drawn, info.why_not) == ("CartPole-v1", 50.0, True, "")
    assert (reset.observation, reset.action, reset.scores) == (None, None, None)
    env = gym.make("CartPole-v1")
    seen, _ = env.reset(seed=3)
    env.close()  # type: ignore[no-untyped-call]
    assert first.observation == pytest.approx(seen.tolist())
    logits = policy.outputs(seen[None])[0].astype(np.float64)
    assert first.scores == pytest.approx((np.exp(logits) / np.exp(logits).sum()).tolist())
    assert first.score_kind == "probabilities"
    assert first.action == int(np.argmax(logits))


def test_pictures_are_small_and_move() -> None:
    _, steps = watched(policy_for("CartPole-v1", "categorical", 2), "CartPole-v1")
    pictures = [Image.open(io.BytesIO(base64.b64decode(step.picture or ""))) for step in steps[:3]]
    assert {(picture.format, picture.size) for picture in pictures} == {("JPEG", (600, 400))}
    assert len({step.picture for step in steps}) > 1


@pytest.mark.parametrize(("training", "kind"), [({}, "values"), ({"hyperparams": {"dueling": True}}, "advantages")])
def test_q_values_are_told_as_they_are(training: dict[str, Any], kind: str) -> None:
    policy = policy_for("CartPole-v1", "q_values", 2, **training)
    _, (_, first, *_) = watched(policy, "CartPole-v1")
    assert first.score_kind == kind
    assert first.scores == pytest.approx(policy.outputs(np.array([first.observation], dtype=np.float32))[0].tolist())


def test_a_gaussian_policy_tells_its_spread() -> None:
    policy = policy_for("Pendulum-v1", "gaussian", 2)
    _, (_, first, *_) = watched(policy, "Pendulum-v1")
    log_std = policy.outputs(np.array([first.observation], dtype=np.float32))[0][1]
    assert first.score_kind == "gaussian"
    assert first.scores == pytest.approx([float(np.exp(log_std))])
    assert isinstance(first.action, list)


def test_what_actions_there_are_is_told() -> None:
    info, _ = watched(policy_for("CartPole-v1", "categorical", 2), "CartPole-v1")
    assert info.actions == LiveActions(0, ("push left", "push right"), None, None)
    info, _ = watched(RandomPolicy.for_env("Pendulum-v1"), "Pendulum-v1")
    assert info.actions == LiveActions(None, None, [-2.0], [2.0])


def test_steps_that_are_skipped_have_no_pictures() -> None:
    policy = policy_for("CartPole-v1", "categorical", 2)
    _, whole = watched(policy, "CartPole-v1")
    for start in (3, len(whole) - 1, len(whole) + 5):
        _, steps = watch_episode(policy, "CartPole-v1", {}, 3, start=start)
        found = list(steps)
        first = min(start, len(whole) - 1)
        assert found[first:] == whole[first:]
        assert [(step.picture, step.scores) for step in found[:first]] == [(None, None)] * first
        assert [step.total for step in found] == [step.total for step in whole]


def test_a_random_policy_plays_the_same_for_the_same_seed() -> None:
    actions = [
        [step.action for step in watched(RandomPolicy.for_env("CartPole-v1"), "CartPole-v1", seed)[1]]
        for seed in (5, 5, 6)
    ]
    assert actions[0] == actions[1] != actions[2]


class NotDrawn(gym.Env[Any, Any]):
    """Cannot be drawn, and has an observation that is no number."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return np.array([1.0, 2.0], dtype=np.float32), {}

    def step(self, action: Any) -> Any:
        return np.array([3.0, 4.0], dtype=np.float32), 1.0, True, False, {}


@pytest.fixture
def not_drawn() -> Any:
    gym.register("NotDrawn-v0", lambda **_: NotDrawn())
    yield "NotDrawn-v0"
    del gym.registry["NotDrawn-v0"]


def test_what_cannot_be_drawn_is_shown_by_its_observations(not_drawn: str) -> None:
    info, steps = watched(RandomPolicy.for_env(not_drawn), not_drawn)
    assert not info.is_drawn
    assert "can't be drawn" in info.why_not or "render" in info.why_not
    assert [step.picture for step in steps] == [None, None]
    assert steps[1].observation == [1.0, 2.0]


class BadlyDrawn(NotDrawn):
    """Fails where it is to be drawn."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, **given: Any) -> None:
        self.render_mode = given.get("render_mode")

    def render(self) -> Any:
        raise RuntimeError("no canvas")


def test_an_env_that_fails_to_draw_is_said() -> None:
    gym.register("BadlyDrawn-v0", BadlyDrawn)
    try:
        with pytest.raises(EnvError, match="BadlyDrawn-v0 cannot be drawn: RuntimeError: no canvas"):
            watched(RandomPolicy.for_env("BadlyDrawn-v0"), "BadlyDrawn-v0")
    finally:
        del gym.registry["BadlyDrawn-v0"]


def test_a_policy_for_another_env_is_refused() -> None:
    with pytest.raises(EnvError):
        watch_episode(policy_for("CartPole-v1", "categorical", 2), "Acrobot-v1", {}, 0)
