"""Frames, pixels and the failure penalty, in scalar and vector environments."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from policies.acting.evaluate import evaluate_policy
from policies.acting.policy import RandomPolicy
from policies.envs.failures import FailureRule, failure_rule
from policies.envs.make import check_env, make_env, make_vector_env
from policies.envs.wrappers import FailurePenalty, StackFrames, shrink_to_grey
from policies.errors import EnvError
from tests.narrowing import present

ROOT = Path(__file__).parents[2]


class Counter(gym.Env[Any, Any]):
    """The observation is [100 * episode + step, -step]; its reward is 2, and it ends after `end` steps."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, end: int = 3, image: bool = False, render_mode: str | None = None, reward: float = 2.0) -> None:
        self.end, self.image, self.reward, self.render_mode = end, image, reward, render_mode
        shape = (4, 5, 2) if image else (2,)
        self.observation_space = gym.spaces.Box(-1000, 1000, shape, np.float32)
        self.action_space = gym.spaces.Discrete(2)
        self.episode = self.ticks = 0

    def _observation(self) -> NDArray[np.float32]:
        pair = np.array([100 * self.episode + self.ticks, -self.ticks], np.float32)
        return np.broadcast_to(pair, present(self.observation_space.shape)).copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.episode, self.ticks = self.episode + 1, 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.ticks += 1
        return self._observation(), self.reward, self.ticks >= self.end, False, {}

    def render(self) -> Any:
        return np.full((130, 65, 3), 10 * self.ticks, np.uint8)


class Careful(Counter):
    metadata = {"render_modes": [], "failure": "terminated"}  # noqa: RUF012


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    gym.register("TestCounter-v0", cast("Any", Counter))
    gym.register("TestCareful-v0", cast("Any", Careful))
    yield
    del gym.registry["TestCounter-v0"], gym.registry["TestCareful-v0"]


def test_stacked_vectors_are_joined_oldest_first_and_begin_with_the_resets() -> None:
    env = make_env("TestCounter-v0", {"frame_stack": 3})
    assert env.observation_space.shape == (6,)
    first, _ = env.reset()
    assert first.tolist() == [100, 0] * 3
    seen = [env.step(0)[0] for _ in range(3)]
    assert [one.tolist() for one in seen] == [
        [100, 0, 100, 0, 101, -1],
        [100, 0, 101, -1, 102, -2],
        [101, -1, 102, -2, 103, -3],
    ]
    assert first.tolist() == [100, 0] * 3  # what was returned stays as it was
    assert env.reset()[0].tolist() == [200, 0] * 3


def test_stacked_images_are_joined_along_their_channels() -> None:
    env = make_env("TestCounter-v0", {"frame_stack": 2, "image": True})
    assert env.observation_space.shape == (4, 5, 4)
    env.reset()
    observation = env.step(0)[0]
    assert observation.shape == (4, 5, 4)
    assert observation[2, 3].tolist() == [100, 0, 101, -1]


@pytest.mark.parametrize("args", [{"frame_stack": 3}, {"frame_stack": 2, "image": True}])
def test_stacked_frames_of_a_vector_env_are_those_of_its_parts(args: dict[str, bool | int]) -> None:
    vector = make_vector_env("TestCounter-v0", args, 2)
    scalar = make_env("TestCounter-v0", args)
    assert vector.single_observation_space == scalar.observation_space
    observations, _ = vector.reset()
    expected, _ = scalar.reset()
    assert vector.observation_space.contains(observations)
    ended = False
    for _ in range(9):  # two episodes, each with a step that only resets
        np.testing.assert_array_equal(observations, [expected, expected])
        observations, _, terminated, _, _ = vector.step(np.zeros(2, np.int64))
        if ended:
            (expected, _), ended = scalar.reset(), False
        else:
            expected, _, ended, _, _ = scalar.step(0)
        assert terminated.tolist() == [ended, ended]


def test_stacked_frames_of_the_vectorised_cartpole_begin_anew_for_each_part() -> None:
    env = make_vector_env("CartPole-v1", {"frame_stack": 2}, 4)
    assert env.unwrapped.spec.kwargs["vectorization_mode"] == "vector_entry_point"
    last, _ = env.reset(seed=1)
    np.testing.assert_array_equal(last[:, :4], last[:, 4:])
    ended, resets = np.zeros(4, bool), 0
    for step in range(60):
        observations, _, terminated, _, _ = env.step(np.full(4, step % 3 == 0, np.int64))
        for index in range(4):
            before = observations[index, 4:] if ended[index] else last[index, 4:]
            np.testing.assert_array_equal(observations[index, :4], before)
        resets += int(ended.sum())
        last, ended = observations, terminated
    assert resets > 4


def test_what_is_neither_vector_nor_image_is_made_a_vector_and_stacked() -> None:
    gym.register("TestGrid-v0", cast("Any", lambda: gym.wrappers.ReshapeObservation(Counter(), (1, 2))))
    try:
        env = make_env("TestGrid-v0", {"frame_stack": 2})
        plain = make_env("TestGrid-v0")
    finally:
        del gym.registry["TestGrid-v0"]
    first, second = plain.reset()[0], plain.step(0)[0]
    assert first.shape == (2,)
    np.testing.assert_array_equal(env.reset()[0], [*first, *first])
    np.testing.assert_array_equal(env.step(0)[0], [*first, *second])


def test_vectors_behind_a_mask_are_stacked_whatever_their_bounds() -> None:
    class Far(Counter):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space = gym.spaces.Box(-1e300, np.array([1e300, 5.0]), (2,), np.float64)

        def action_masks(self) -> list[int]:
            return [1, self.ticks % 2]

    gym.register("TestFar-v0", cast("Any", Far))
    try:
        env = make_env("TestFar-v0", {"frame_stack": 2})
        space = check_env("TestFar-v0", {"frame_stack": 2}).observation_space
    finally:
        del gym.registry["TestFar-v0"]
    first, _ = env.reset()
    assert first.tolist() == [1, 0, *first[2:4], *first[2:4]]
    second = env.step(0)[0]
    assert second.tolist() == [1, 1, *first[2:4], *second[4:]]
    assert isinstance(space, gym.spaces.Box)
    assert space.dtype == np.float32
    assert space.high.tolist() == [1, 1, np.inf, 5, np.inf, 5]


def test_what_no_vector_can_be_made_of_does_not_stack() -> None:
    class Reads(Counter):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space = gym.spaces.Text(3)

    gym.register("TestText-v0", cast("Any", Reads))
    try:
        with pytest.raises(EnvError, match=r"TestText-v0 has frame_stack 2, .*Text"):
            make_env("TestText-v0", {"frame_stack": 2})
    finally:
        del gym.registry["TestText-v0"]


@pytest.mark.parametrize("value", [0, -1, 2.0, True, "4", None])
def test_a_number_of_frames_that_is_none_is_refused(value: bool | float | str | None) -> None:
    with pytest.raises(EnvError, match="frame_stack is"):
        make_env("CartPole-v1", {"frame_stack": value})


def test_pixels_are_refused_where_nothing_is_drawn_or_the_value_is_none() -> None:
    with pytest.raises(EnvError, match=r"TestCareful-v0 has pixels.*rgb_array"):
        make_vector_env("TestCareful-v0", {"pixels": True}, 2)
    with pytest.raises(EnvError, match="pixels is 1"):
        make_env("CartPole-v1", {"pixels": 1})
    with pytest.raises(EnvError, match="human"):
        make_env("CartPole-v1", {"pixels": True}, render_mode="human")


def test_a_picture_shrinks_to_the_mean_brightness_of_its_blocks() -> None:
    picture = np.zeros((400, 600, 3), np.uint8)
    picture[10:20, 30:40] = 200  # one whole block
    picture[50:60, 70:75] = 100  # half of one
    picture[90:100, 90:100, 1] = 255  # green alone
    small = shrink_to_grey(picture)
    assert small.shape == (40, 60, 1)
    assert small.dtype == np.uint8
    assert (small[1, 3, 0], small[5, 7, 0], small[9, 9, 0]) == (200, 50, round(255 * 0.587))
    assert np.count_nonzero(small) == 3


@pytest.mark.parametrize(
    ("shape", "small"),
    [((64, 64), (64, 64)), ((3, 5), (3, 5)), ((65, 64), (32, 32)), ((131, 70), (43, 23)), ((640, 3), (1, 1))],
)
def test_pictures_of_any_size_shrink_to_few_rows_and_columns(shape: tuple[int, int], small: tuple[int, int]) -> None:
    picture = np.full((*shape, 3), 77, np.uint8)
    assert shrink_to_grey(picture).shape == (*small, 1)
    assert np.unique(shrink_to_grey(picture)).tolist() == [77]


def test_pixels_are_the_same_in_every_form_of_a_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = np.random.default_rng(1).integers(0, 256, (130, 65, 4), np.uint8)
    observations = []
    for drawn in (plain[:, :, :3], plain, plain / 255, plain.astype(np.float64)):
        monkeypatch.setattr(Counter, "render", lambda self, drawn=drawn: drawn)
        observations.append(make_env("TestCounter-v0", {"pixels": True}).reset()[0])
    for others in observations[1:]:
        np.testing.assert_array_equal(others, observations[0])


def test_pixels_show_what_the_env_renders_and_a_video_shows_all_of_it() -> None:
    env = make_env("TestCounter-v0", {"pixels": True, "frame_stack": 2}, render_mode="rgb_array")
    assert env.observation_space == gym.spaces.Box(0, 255, (43, 21, 2), np.uint8)
    env.reset()
    observation = env.step(0)[0]
    assert [np.unique(observation[..., channel]).tolist() for channel in (0, 1)] == [[0], [10]]
    assert cast("Any", present(env.render())).shape == (130, 65, 3)


def test_cartpole_can_be_seen_in_its_pixels_without_a_display() -> None:
    code = (
        "import numpy as np\n"
        "from policies.envs.make import check_env, make_env, make_vector_env\n"
        "info = check_env('CartPole-v1', {'pixels': True}, 'ppo')\n"
        "assert info.observes_images and info.observation_space.shape == (40, 60, 1), info\n"
        "assert not info.has_vector_entry_point\n"
        "env = make_env('CartPole-v1', {'pixels': True})\n"
        "first, _ = env.reset(seed=1)\n"
        "for _ in range(8): last = env.step(1)[0]\n"
        "assert first.dtype == np.uint8 and (first < 128).sum() > 5 and (first != last).any()\n"
        "vector = make_vector_env('CartPole-v1', {'pixels': True}, 2)\n"
        "assert (vector.reset(seed=1)[0][0] == first).all()\n"
    )
    env = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    env = {key: value for key, value in env.items() if not key.startswith(("SDL_", "PYGAME_"))}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_evaluation_observes_what_training_did() -> None:
    shapes = set()

    class Looking(RandomPolicy):
        def _act_batch(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
            shapes.add(observations.shape[1:])
            return super()._act_batch(observations)

    args = {"frame_stack": 3, "max_episode_steps": 5}
    info = check_env("CartPole-v1", args)
    policy = Looking(info.observation_space, info.action_space, env_id="CartPole-v1", env_args=args)
    evaluate_policy(policy, env_id="CartPole-v1", env_args=args, seeds=[1, 2])
    assert shapes == {(12,)}


def test_a_failure_gets_the_penalty_and_the_own_rewards_are_kept() -> None:
    env = make_vector_env("TestCareful-v0", {"end": 2}, 2, failure_penalty=-7)
    assert isinstance(env, FailurePenalty)
    env.reset()
    seen = []
    for _ in range(4):
        _, rewards, _, _, _ = env.step(np.zeros(2, np.int64))
        seen.append((rewards[0], env.own_rewards[0]))
    # The third step only resets.
    assert seen == [(2.0, 2.0), (-7.0, 2.0), (0.0, 0.0), (2.0, 2.0)]


def test_a_truncated_cartpole_has_not_failed_and_keeps_its_vectorised_physics() -> None:
    env = make_vector_env("CartPole-v1", {"max_episode_steps": 12}, 8, failure_penalty=-100)
    assert env.unwrapped.spec.kwargs["vectorization_mode"] == "vector_entry_point"
    env.reset(seed=0)
    fell = ran_out = 0
    for step in range(200):
        # Half of the carts are pushed one way for ever, half are balanced for twelve steps.
        _, rewards, terminated, truncated, _ = env.step(np.where(np.arange(8) < 4, 1, step % 2))
        assert np.array_equal(rewards == -100, terminated)
        assert set(cast("Any", env).own_rewards) <= {0.0, 1.0}
        fell += int(terminated.sum())
        ran_out += int((truncated & ~terminated).sum())
    assert fell
    assert ran_out


@pytest.mark.parametrize("env_id", ["Acrobot-v1", "MountainCar-v0", "Pendulum-v1", "TestCounter-v0"])
def test_a_penalty_without_failure_is_refused_with_both_names(env_id: str) -> None:
    assert check_env(env_id, None).failure is None
    with pytest.raises(EnvError, match=rf"failure_penalty is -1, but {env_id}") as caught:
        make_vector_env(env_id, None, 2, failure_penalty=-1)
    assert "metadata" in caught.value.hint


def test_only_a_crash_of_the_lander_is_a_failure() -> None:
    pytest.importorskip("Box2D")
    rule = present(check_env("LunarLander-v3", None).failure)
    rewards, terminated = np.array([-100.0, 100.0, -100.0, 1.0]), np.array([True, True, False, False])
    assert rule.failed(rewards, terminated).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    "env_id", ["CartPole-v0", "InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Hopper-v5", "Walker2d-v4",
               "Humanoid-v5", "Ant-v5"],
)  # fmt: skip
def test_falls_are_failures(env_id: str) -> None:
    spec = gym.registry[env_id]
    assert failure_rule(env_id, spec, {}, {}) == FailureRule()
    if env_id.startswith(("Hopper", "Walker", "Humanoid", "Ant")):
        assert failure_rule(env_id, spec, {}, {"terminate_when_unhealthy": False}) is None


def test_an_unknown_kind_of_failure_is_refused() -> None:
    spec = gym.registry["TestCareful-v0"]
    with pytest.raises(EnvError, match=r"metadata\['failure'\] = 'fall'"):
        failure_rule("TestCareful-v0", spec, {"failure": "fall"}, {})


@pytest.mark.parametrize("name", ["failure_penalty", "allowed_modules"])
def test_what_only_env_runners_are_told_is_no_argument_of_an_env(name: str) -> None:
    gym.register("TestAnything-v0", lambda **kwargs: Counter(len(kwargs)))
    try:
        cast("Any", make_env("TestAnything-v0", {"other": 1})).close()
        with pytest.raises(EnvError, match=f"{name!r}.*cannot be set"):
            make_env("TestAnything-v0", {name: -1})
    finally:
        del gym.registry["TestAnything-v0"]


def test_the_wrapper_of_frames_can_be_used_alone() -> None:
    env = StackFrames(Counter(), 2)
    assert env.reset()[0].tolist() == [100, 0, 100, 0]
