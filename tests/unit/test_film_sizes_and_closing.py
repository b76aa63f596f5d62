"""Frames that change their size in a film, and environments that are closed though nothing is played."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageDraw
from policy_factory import registered

from analysis.wording import return_text
from policies.acting import video
from policies.acting.baselines import ConstantPolicy
from policies.acting.live import watch_episode
from policies.acting.movies import GifWriter, Mp4Writer, fitted
from policies.acting.video import record_video
from policies.envs.rendering import frames_per_second, picture_of
from policies.errors import EnvError
from tests.narrowing import present

ENV = "TestGrows-v0"
RED = (200, 0, 0)


class Grows(gym.Env[Any, Any]):
    """Its picture, all red, is larger after each step; counts who is open."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    num_open = 0

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode, self.steps = render_mode, 0
        Grows.num_open += 1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return np.zeros(2, np.float32), 1.0, self.steps == 4, False, {}

    def render(self) -> Any:
        return np.full((100 + 37 * self.steps, 340 + 22 * self.steps, 3), RED, np.uint8)

    def close(self) -> None:
        Grows.num_open -= 1


@pytest.fixture(autouse=True)
def _env(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(Grows, "num_open", 0)
    with registered(ENV, Grows):
        yield


def policy(num_actions: int = 2) -> ConstantPolicy:
    return ConstantPolicy(Grows.observation_space, gym.spaces.Discrete(num_actions), 0, env_id=ENV)


def frames_of(path: Path) -> list[Any]:
    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return [np.frombuffer(frame, np.uint8).reshape(height, width, 3).astype(int) for frame in reader]


def test_a_picture_is_fitted_into_a_size() -> None:
    red = Image.new("RGB", (20, 40), RED)
    assert fitted(red, (20, 40)) is red
    pixels = np.array(fitted(red, (40, 20)))
    assert pixels.shape == (20, 40, 3)
    assert (pixels[:, 15:25] == RED).all()
    assert not pixels[:, :15].any()
    assert not pixels[:, 25:].any()


def test_an_mp4_takes_pictures_of_other_sizes(tmp_path: Path) -> None:
    sizes = [(64, 48), (70, 48), (64, 20), (30, 90), (64, 48)]
    with Mp4Writer(tmp_path / "a.mp4", 10) as writer:
        for size in sizes:
            writer.add(Image.new("RGB", size, RED))
    frames = frames_of(tmp_path / "a.mp4")
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * len(sizes)
    for frame in frames:
        assert np.abs(frame[20:28, 28:36] - RED).max() < 30
    assert np.abs(frames[-1] - RED).max() < 30


@pytest.mark.parametrize("max_bytes", [3_000_000, 100])
def test_a_gif_takes_pictures_of_other_sizes(tmp_path: Path, max_bytes: int) -> None:
    writer = GifWriter(tmp_path / "a.gif", 10, max_bytes=max_bytes)
    for number, size in enumerate([(64, 48), (128, 96), (32, 24)]):
        writer.add(lambda size=size, number=number: Image.new("RGB", size, (200, 0, 20 * number)), hold_s=0.1)  # type: ignore[misc]
    writer.save()
    with Image.open(tmp_path / "a.gif") as image:
        for index in range(3):
            image.seek(index)
            pixels = np.array(image.convert("RGB")).astype(int)
            assert (np.abs(pixels - (200, 0, 20 * index)).max(axis=-1) < 15).all()


def test_a_film_of_an_env_whose_pictures_grow(tmp_path: Path) -> None:
    record_video(policy(), env_id=ENV, seeds=[0, 1], mp4=tmp_path / "a.mp4", gif=tmp_path / "a.gif", caption="a")
    frames = frames_of(tmp_path / "a.mp4")
    assert {frame.shape for frame in frames} == {(126, 340, 3)}
    for frame in frames:
        assert np.abs(frame[40:110, 150:190] - RED).max() < 40
        # The caption stays where it is, and as large as it is.
        assert frame[4:22, -80:].max() > 150
        assert np.abs(frame[:26, 200] - (24, 27, 34)).max() < 40
    assert Grows.num_open == 0


@pytest.mark.parametrize("drawn", [
    np.full((60, 340, 4), (*RED, 0), np.uint8),
    np.full((60, 340, 3), RED) / 255,
    np.full((60, 340, 4), (*RED, 0), np.float32) / 255,
])  # fmt: skip
def test_pictures_as_matplotlib_knows_them_are_filmed_and_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drawn: Any
) -> None:
    monkeypatch.setattr(Grows, "render", lambda self: drawn)
    record_video(policy(), env_id=ENV, seeds=0, mp4=tmp_path / "a.mp4")
    for frame in frames_of(tmp_path / "a.mp4"):
        assert np.abs(frame[40:70, 150:190] - RED).max() < 40
    for step in watch_episode(policy(), ENV, {}, 0)[1]:
        with Image.open(io.BytesIO(base64.b64decode(step.picture or ""))) as picture:
            assert np.abs(np.array(picture).astype(int) - RED).max() < 40


def test_each_number_of_0_to_1_becomes_the_nearest_byte() -> None:
    numbers = [0, 0.001, 0.0019, 0.5, 0.9981, 0.999, 1]
    picture = present(picture_of(np.array(numbers).reshape(7, 1, 1) * np.ones(3)))
    assert picture[:, 0, 0].tolist() == [0, 0, 0, 128, 255, 255, 255]


def test_small_pictures_are_shown_with_squares_for_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = np.zeros((10, 10, 3), np.uint8)
    drawn[3, 4] = RED
    monkeypatch.setattr(Grows, "render", lambda self: drawn)
    _, steps = watch_episode(policy(), ENV, {}, 0)
    with Image.open(io.BytesIO(base64.b64decode(next(steps).picture or ""))) as picture:
        pixels = np.array(picture).astype(int)
    steps.close()  # type: ignore[attr-defined]
    assert pixels.shape == (320, 320, 3)
    assert np.abs(pixels[98:126, 130:158] - RED).max() < 40
    assert pixels[:90].max() < 40


@pytest.mark.parametrize(
    ("rows", "columns", "size"), [(400, 1, (1, 400)), (20, 10, (160, 320)), (1, 100, (400, 4)), (900, 3, (2, 640))]
)
def test_a_narrow_picture_is_enlarged_at_play_by_its_longer_side(
    monkeypatch: pytest.MonkeyPatch, rows: int, columns: int, size: tuple[int, int]
) -> None:
    monkeypatch.setattr(Grows, "render", lambda self: np.zeros((rows, columns, 3), np.uint8))
    _, steps = watch_episode(policy(), ENV, {}, 0)
    with Image.open(io.BytesIO(base64.b64decode(next(steps).picture or ""))) as picture:
        assert picture.size == size
    steps.close()  # type: ignore[attr-defined]


@pytest.mark.parametrize("number", [-0.01, 1.01, np.nan, np.inf, 1])
def test_other_numbers_are_no_picture(number: float) -> None:
    drawn: Any = np.zeros((2, 2, 3), type(number))
    drawn[1, 1, 1] = number
    assert picture_of(drawn) is None


@pytest.mark.parametrize("shape", [(0, 0, 3), (60, 0, 3), (60, 80, 2), (60, 80, 5)])
def test_pictures_of_other_shapes_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, ...]
) -> None:
    monkeypatch.setattr(Grows, "render", lambda self: np.zeros(shape, np.uint8))
    with pytest.raises(EnvError, match=f"draws arrays of shape {re.escape(str(shape))}"):
        record_video(policy(), env_id=ENV, seeds=0, mp4=tmp_path / "a.mp4")
    assert {step.picture for step in watch_episode(policy(), ENV, {}, 0)[1]} == {None}
    assert list(tmp_path.iterdir()) == []
    assert Grows.num_open == 0


def drawn_texts(monkeypatch: pytest.MonkeyPatch, total: float, width: int = 600) -> dict[str, tuple[float, float]]:
    """The texts of a caption, each with its left and its right end."""
    ends: dict[str, tuple[float, float]] = {}

    def note(draw: Any, at: tuple[float, float], text: str, *, font: Any, anchor: str, **_: Any) -> None:
        left, _, right, _ = draw.textbbox(at, text, font=font, anchor=anchor)
        ends[text] = left, right

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", note)
    video._captioned(video._Panel(Image.new("RGB", (width, 400)), "me " * 90, 7, total, over=False), 1.0)
    return ends


@pytest.mark.parametrize(
    ("total", "shown"),
    [
        (0.955, "0.955"), (-0.04, "-0.040"), (200.0, "200"), (0.0, "0"), (-0.0, "0"), (-3, "-3"), (1.999, "1.999"),
        (195.04, "195.0"), (-0.00123, "-0.00123"), (1.5e-12, "1.5e-12"), (-np.inf, "-inf"), (np.nan, "nan"),
    ],
)  # fmt: skip
def test_a_film_tells_a_return_as_reports_do(monkeypatch: pytest.MonkeyPatch, total: float, shown: str) -> None:
    assert f"return {shown}" in drawn_texts(monkeypatch, total)
    if total and np.isfinite(total) and not float(total).is_integer():
        assert shown == return_text(total)


@pytest.mark.parametrize("width", [330, 600])
def test_no_words_move_or_meet_while_a_small_return_grows(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    places = []
    for total in (0.0, 0.955, -0.955, 1.5, -200.0):
        (title, step, told) = sorted(drawn_texts(monkeypatch, total, width).values())
        assert title[1] < step[0] < step[1] < told[0] < told[1] < width
        places.append((title, step))
    assert len(set(places)) == 1


@pytest.mark.parametrize(
    ("max_steps", "steps", "is_cut"), [(None, 3, True), (2, 2, True), (4, 4, False), (9, 4, False)]
)
def test_without_a_limit_of_the_env_a_film_is_cut_off_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, max_steps: int | None, steps: int, *, is_cut: bool
) -> None:
    monkeypatch.setattr(video, "MAX_ENDLESS_STEPS", 3)
    filmed = record_video(policy(), env_id=ENV, seeds=0, mp4=tmp_path / "a.mp4", max_steps=max_steps, caption="a")
    assert filmed.lengths == (steps,)
    before, last = (frame[:26, :150] for frame in (frames_of(tmp_path / "a.mp4")[index] for index in (steps - 1, -1)))
    assert bool(np.abs(before - last).max() > 100) is is_cut


def test_what_the_env_limits_itself_is_filmed_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "MAX_ENDLESS_STEPS", 2)
    limited = {"max_episode_steps": 3}
    filmed = record_video(policy(), env_id=ENV, env_args=limited, seeds=0, mp4=tmp_path / "a.mp4", caption="a")
    assert filmed.lengths == (3,)
    before, last = (frame[:26, :150] for frame in (frames_of(tmp_path / "a.mp4")[index] for index in (2, -1)))
    assert np.abs(before - last).max() < 50


def test_a_policy_that_cannot_be_filmed_leaves_no_env_open(tmp_path: Path) -> None:
    with pytest.raises(EnvError, match="whose actions are"):
        record_video(policy(3), env_id=ENV, seeds=0, mp4=tmp_path / "a.mp4")
    with pytest.raises(EnvError, match="cap on episode steps"):
        record_video(policy(), env_id=ENV, seeds=0, mp4=tmp_path / "a.mp4", max_steps=0)
    assert Grows.num_open == 0


def test_an_episode_that_nobody_watches_leaves_no_env_open() -> None:
    _, steps = watch_episode(policy(), ENV, {}, 0)
    assert Grows.num_open == 1
    steps.close()  # type: ignore[attr-defined]
    assert Grows.num_open == 0
    _, steps = watch_episode(policy(), ENV, {}, 0)
    del steps
    assert Grows.num_open == 0
    assert len(list(watch_episode(policy(), ENV, {}, 0)[1])) == 5
    assert Grows.num_open == 0


def test_render_modes_that_are_no_names_are_told_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(Grows, "metadata", {"render_modes": [None, "human"]})
    policy = ConstantPolicy(Grows.observation_space, Grows.action_space, 0, env_id=ENV)
    with pytest.raises(EnvError, match=r"cannot be filmed: .*\(it has: None, human\)"):
        record_video(policy, env_id=ENV, seeds=1, mp4=tmp_path / "a.mp4")


@pytest.mark.parametrize(("told", "filmed"), [(1000, 999.0), (-5, 30.0), (10, 10.0)])
def test_an_environment_is_filmed_whatever_rate_it_tells(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, told: int, filmed: float
) -> None:
    monkeypatch.setitem(Grows.metadata, "render_fps", told)
    assert record_video(policy(), env_id=ENV, seeds=0, mp4=tmp_path / "a.mp4", max_steps=2).lengths == (2,)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert next(reader)["fps"] == filmed
    reader.close()


@pytest.mark.parametrize("told", [1 / 900, 1e-6, 5e-324])
def test_an_environment_of_slow_time_is_filmed_faster(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, told: float
) -> None:
    """A step may be of a quarter of an hour."""
    monkeypatch.setitem(Grows.metadata, "render_fps", told)
    mp4, gif = tmp_path / "a.mp4", tmp_path / "a.gif"
    assert record_video(policy(), env_id=ENV, seeds=0, mp4=mp4, gif=gif, max_steps=2).lengths == (2,)
    with Image.open(gif) as film:
        assert film.info["duration"] == 10_000
    reader = imageio_ffmpeg.read_frames(str(mp4))
    assert next(reader)["fps"] == 0.1
    reader.close()


def test_a_frame_of_a_gif_is_shown_no_longer_than_one_can_be(tmp_path: Path) -> None:
    writer = GifWriter(tmp_path / "a.gif", 1 / 900)
    for shade in (0, 90, 180):
        writer.add(lambda shade=shade: Image.new("RGB", (40, 30), (shade, 0, 0)))  # type: ignore[misc]
    writer.save()
    with Image.open(tmp_path / "a.gif") as film:
        assert (film.n_frames, film.info["duration"]) == (3, 655_350)  # type: ignore[attr-defined]


@pytest.mark.parametrize("told", [10**400, None, 0, -5, np.nan, np.inf, "fast", [30, 30], np.array([1, 2])])
def test_a_rate_that_is_none_is_as_if_it_were_not_told(monkeypatch: pytest.MonkeyPatch, told: Any) -> None:
    monkeypatch.setitem(Grows.metadata, "render_fps", told)
    info, steps = watch_episode(policy(), ENV, {}, 0)
    assert info.fps == frames_per_second({}) == 30.0
    steps.close()  # type: ignore[attr-defined]
    assert [frames_per_second({"render_fps": rate}) for rate in (0.5, 1000, "20")] == [0.5, 1000.0, 20.0]
