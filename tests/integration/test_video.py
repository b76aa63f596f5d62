from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pygame
import pytest
from numpy.typing import NDArray
from PIL import Image
from policy_factory import balancing_policy, make_policy, make_portable, register_test_envs, registered

import policies.acting.movies
from policies.acting.evaluate import evaluate_policy
from policies.acting.movies import GifWriter, Mp4Writer
from policies.acting.policy import NetworkPolicy, RandomPolicy
from policies.acting.video import record_comparison, record_video
from policies.envs.faults import close_env, env_failed
from policies.errors import CannotRunError, EnvError, NonFiniteWeightsError, SpecError

register_test_envs()
pytestmark = pytest.mark.filterwarnings("ignore:.*CartPole-v0 is out of date")


def read_mp4(path: Path) -> tuple[dict[str, Any], list[NDArray[np.uint8]]]:
    """Size, frames a second and the frames."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]
    return meta, frames


def gif_frames(path: Path) -> tuple[tuple[int, int], int | None, list[tuple[int, NDArray[np.uint8]]]]:
    with Image.open(path) as image:
        frames = []
        for index in range(cast("Any", image).n_frames):
            image.seek(index)
            frames.append((image.info["duration"], np.array(image.convert("RGB"))))
        return image.size, image.info.get("loop"), frames


def test_the_filmed_episode_is_the_evaluated_one_and_plays_in_real_time(tmp_path: Path) -> None:
    policy = balancing_policy(skill="poor")
    mp4, gif = tmp_path / "new" / "a.mp4", tmp_path / "new" / "a.gif"
    episodes = record_video(policy, env_id="CartPole-v0", seeds=[4, 5], mp4=mp4, gif=gif, caption="me")
    assert episodes == evaluate_policy(policy, env_id="CartPole-v0", seeds=[4, 5])
    meta, frames = read_mp4(mp4)
    assert (meta["fps"], meta["pix_fmt"][:7], meta["codec"]) == (50.0, "yuv420p", "h264")
    assert all(length % 2 == 0 for length in meta["size"])
    # A frame for each reset and each step, and a second of the last one after each episode.
    assert len(frames) == sum(episodes.lengths) + 2 + 100
    size, loop, pictures = gif_frames(gif)
    assert (loop, size[0]) == (0, 300)
    assert sum(duration for duration, _ in pictures) == pytest.approx(1000 * len(frames) / 50, abs=60)
    assert sorted(file.name for file in mp4.parent.iterdir()) == ["a.gif", "a.mp4"]
    head = mp4.read_bytes()
    assert 0 < head.find(b"moov") < head.find(b"mdat")  # playable before it has come whole


def test_the_frames_show_the_env_under_a_caption(tmp_path: Path) -> None:
    record_video(balancing_policy(), env_id="CartPole-v0", seeds=0, mp4=tmp_path / "a.mp4", max_steps=3)
    record_video(balancing_policy(), env_id="CartPole-v0", seeds=0, mp4=tmp_path / "b.mp4", max_steps=3, caption="")
    (_, frames), (_, untitled) = read_mp4(tmp_path / "a.mp4"), read_mp4(tmp_path / "b.mp4")
    env = gym.make("CartPole-v0", render_mode="rgb_array")
    env.reset(seed=0)
    picture: Any = env.render()
    scene = frames[0][-picture.shape[0] :].astype(int)
    assert np.abs(scene - picture).mean() < 2  # H.264 is not exact
    strip, without = (film[0][: -picture.shape[0]].astype(int) for film in (frames, untitled))
    half = strip.shape[1] // 2
    assert strip[:, :half].max() > 150 > without[:, :half].max()
    assert strip[:, half:].max() > 150
    assert np.abs(frames[0][:40].astype(int) - frames[3][:40]).max() > 50  # the counters count


def test_a_random_policy_is_filmed_as_it_is_evaluated(tmp_path: Path) -> None:
    policy = RandomPolicy.for_env("CartPole-v1")
    filmed = record_video(policy, env_id="CartPole-v1", seeds=8, gif=tmp_path / "a.gif")
    assert filmed == evaluate_policy(policy, env_id="CartPole-v1", seeds=[8])


def comparison_files(folder: Path) -> dict[str, Any]:
    """Where `record_comparison` writes."""
    names = {"left_mp4": "left.mp4", "right_mp4": "right.mp4", "right_gif": "right.gif", "both_mp4": "both.mp4"}
    return {argument: folder / name for argument, name in names.items()}


def test_two_episodes_are_filmed_alone_and_side_by_side(tmp_path: Path) -> None:
    left, right = balancing_policy(skill="poor"), balancing_policy()
    results = record_comparison(
        left, right, env_id="CartPole-v0", seed=4, captions=("poor", "good"), max_steps=80, **comparison_files(tmp_path)
    )
    for policy, result in zip((left, right), results, strict=True):
        assert result == evaluate_policy(policy, env_id="CartPole-v0", seeds=[4], max_episode_steps=80)
    short, long = results[0].lengths[0], results[1].lengths[0]
    assert short < long == 80
    meta, frames = read_mp4(tmp_path / "both.mp4")
    assert len(frames) == long + 1 + 50
    assert meta["size"][0] == 600 + 12 + 600
    film = np.stack(frames).astype(int)
    # The shorter one holds its last frame.
    assert np.abs(film[short, :, :600] - film[-1, :, :600]).mean() < 0.5
    assert np.abs(film[short, :, 612:] - film[-1, :, 612:]).mean() > 0.5
    for side, name, length in ((slice(0, 600), "left", short), (slice(612, None), "right", long)):
        alone = np.stack(read_mp4(tmp_path / f"{name}.mp4")[1]).astype(int)
        assert len(alone) == length + 1 + 50
        assert np.abs(alone[: length + 1] - film[: length + 1, :, side]).mean() < 2  # H.264 is not exact
    record_video(right, env_id="CartPole-v0", seeds=4, gif=tmp_path / "alone.gif", caption="good", max_steps=80)
    assert (tmp_path / "right.gif").read_bytes() == (tmp_path / "alone.gif").read_bytes()


def test_tiny_frames_are_enlarged(tmp_path: Path) -> None:
    args: dict[str, Any] = {"env_id": "TestWalk-v0", "env_args": {"end": 3.0}, "seeds": 0, "max_steps": 5}
    record_video(make_policy("TestWalk-v0"), mp4=tmp_path / "a.mp4", gif=tmp_path / "a.gif", **args)
    meta, frames = read_mp4(tmp_path / "a.mp4")
    assert meta["fps"] == 20.0
    assert meta["size"][0] == 330
    assert gif_frames(tmp_path / "a.gif")[0][0] == 280
    assert len(frames) == 6 + 20


class OnOneDisplay(gym.Env[Any, Any]):
    """What is drawn on pygame's display, of which a process has one, and closes that with itself."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012 (Gymnasium's)
    observation_space = gym.spaces.Box(0, 255, (2,), np.uint8)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        pygame.init()
        self.screen = pygame.display.set_mode((40, 30))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        self.screen.fill((9, 9, 9))
        return np.zeros(2, np.uint8), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.screen.fill((9, 9, 9))
        return np.full(2, self.steps, np.uint8), 1.0, self.steps == 5, False, {}

    def render(self) -> Any:
        return np.transpose(pygame.surfarray.array3d(self.screen), (1, 0, 2))

    def close(self) -> None:
        pygame.quit()


def test_two_that_share_a_display_are_filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with registered("TestDisplay-v0", OnOneDisplay):
        # That one closes the other's display is what this is about.
        first, second = gym.make("TestDisplay-v0"), gym.make("TestDisplay-v0")
        close_env(second)
        with pytest.raises(pygame.error, match="display Surface quit") as failure:
            first.reset()
        assert "env.own_process: true" in env_failed("It failed", failure.value).hint
        left, right = (RandomPolicy.for_env("TestDisplay-v0") for _ in range(2))
        results = record_comparison(
            left, right, env_id="TestDisplay-v0", seed=1, captions=("left", "right"), **comparison_files(tmp_path)
        )
    assert [result.returns for result in results] == [(5.0,), (5.0,)]
    assert len(read_mp4(tmp_path / "both.mp4")[1]) == 6 + 30


def test_an_env_without_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EnvError, match="TestNotDrawable-v0 cannot be filmed: it has no render mode 'rgb_array'"):
        record_video(make_policy("TestNotDrawable-v0"), env_id="TestNotDrawable-v0", seeds=0, mp4=tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []


def test_an_env_that_raises_leaves_no_file(tmp_path: Path) -> None:
    args: dict[str, Any] = {"env_id": "TestWalk-v0", "env_args": {"fail_at": 4}, "seeds": 0}
    with pytest.raises(EnvError, match="the motor broke"):
        record_video(make_policy("TestWalk-v0"), mp4=tmp_path / "a.mp4", gif=tmp_path / "a.gif", **args)
    assert list(tmp_path.iterdir()) == []


def test_an_env_that_draws_no_frames_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from policy_factory import Walk

    for drawn in (None, np.zeros((4, 4), np.uint8), np.full((4, 4, 3), 1.5)):
        monkeypatch.setattr(Walk, "render", lambda self, drawn=drawn: drawn)
        with pytest.raises(EnvError, match="TestWalk-v0 draws arrays of shape"):
            record_video(make_policy("TestWalk-v0"), env_id="TestWalk-v0", seeds=0, mp4=tmp_path / "a.mp4")
    monkeypatch.setattr(Walk, "render", lambda self: 1 / 0)
    with pytest.raises(EnvError, match="TestWalk-v0 cannot be drawn: ZeroDivisionError"):
        record_video(make_policy("TestWalk-v0"), env_id="TestWalk-v0", seeds=0, mp4=tmp_path / "a.mp4")


def test_what_cannot_be_filmed_is_refused(tmp_path: Path) -> None:
    portable = make_portable("CartPole-v0")
    portable.network.layers[0].weight[0, 0] = np.nan
    with pytest.raises(NonFiniteWeightsError):
        record_video(NetworkPolicy(portable), env_id="CartPole-v0", seeds=0, mp4=tmp_path / "a.mp4")
    with pytest.raises(EnvError, match="observations"):
        record_video(make_policy("Pendulum-v1"), env_id="CartPole-v0", seeds=0, mp4=tmp_path / "a.mp4")
    for fps in (0, -1, float("nan")):
        with pytest.raises(SpecError, match="frames a second"):
            record_video(balancing_policy(), env_id="CartPole-v0", seeds=0, mp4=tmp_path / "a.mp4", fps=fps)
    with pytest.raises(SpecError, match="no seeds"):
        record_video(balancing_policy(), env_id="CartPole-v0", seeds=[], mp4=tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name in ("mp4", "gif"):
        with pytest.raises(CannotRunError, match="Cannot write"):
            record_video(
                balancing_policy(),
                env_id="CartPole-v0",
                seeds=0,
                max_steps=2,
                **cast("dict[str, Any]", {name: tmp_path / "file" / "a"}),
            )


def test_an_encoder_that_fails_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\nread -r line\necho 'no such codec' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(broken))
    picture = Image.fromarray(np.full((400, 600, 3), 10, np.uint8))  # a newline, so that the script's read ends
    with pytest.raises(CannotRunError, match="no such codec"), Mp4Writer(tmp_path / "a.mp4", 30) as writer:
        writer.add(picture, 50)
    assert list(tmp_path.iterdir()) == [broken]

    broken.write_text("#!/bin/sh\ncat > /dev/null\necho 'disk on fire' >&2\nexit 1\n")
    with pytest.raises(CannotRunError, match="disk on fire"), Mp4Writer(tmp_path / "a.mp4", 30) as writer:
        writer.add(picture, 5)
    assert list(tmp_path.iterdir()) == [broken]

    def none_there() -> None:
        raise RuntimeError("no binary for this machine")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", none_there)
    with pytest.raises(CannotRunError, match="No ffmpeg"), Mp4Writer(tmp_path / "a.mp4", 30) as writer:
        writer.add(picture)
    with pytest.raises(CannotRunError, match="no picture"), Mp4Writer(tmp_path / "a.mp4", 30):
        pass


def test_a_gif_stays_within_its_size_and_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policies.acting.movies, "_GIF_MAX_FRAMES", 40)
    rng = np.random.default_rng(0)
    writer = GifWriter(tmp_path / "a.gif", 50, max_bytes=60_000)
    drawn = []

    def noise() -> Image.Image:
        drawn.append(1)
        return Image.fromarray(rng.integers(0, 255, (60, 80, 3), dtype=np.uint8))

    def red() -> Image.Image:
        return Image.new("RGB", (80, 60), (255, 0, 0))

    for step in range(300):
        last = step in {99, 299}
        writer.add(red if last else noise, hold_s=1.0 if last else 0.0)
    assert len(drawn) < 150  # what is passed over is not drawn
    writer.save()
    size, loop, frames = gif_frames(tmp_path / "a.gif")
    assert (tmp_path / "a.gif").stat().st_size <= 60_000
    assert size[0] < 80
    assert loop == 0
    assert sum(duration for duration, _ in frames) == pytest.approx(8000, abs=20)
    assert frames[-1][0] >= 1000
    held = [frame for duration, frame in frames if duration >= 1000]
    assert len(held) == 2
    for frame in held:
        np.testing.assert_allclose(frame.mean(axis=(0, 1)), (255, 0, 0), atol=5)


def test_a_gif_without_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CannotRunError, match="no picture"):
        GifWriter(tmp_path / "a.gif", 50).save()


def test_a_white_background_stays_white_and_nothing_is_printed(tmp_path: Path) -> None:
    code = (
        "from policies.acting.video import record_video; from policies.acting.policy import RandomPolicy; from pathlib "
        "import Path\n"
        "record_video(RandomPolicy.for_env('CartPole-v0'), env_id='CartPole-v0', seeds=1,\n"
        f"             mp4=Path({str(tmp_path / 'a.mp4')!r}), gif=Path({str(tmp_path / 'a.gif')!r}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    assert done.stdout == done.stderr == ""
    _, _, frames = gif_frames(tmp_path / "a.gif")
    assert all(frame[100, 10].min() >= 254 for _, frame in frames)


def test_odd_sizes_become_even(tmp_path: Path) -> None:
    with Mp4Writer(tmp_path / "a.mp4", 12.5) as writer:
        writer.add(Image.new("RGB", (31, 21), (255, 255, 255)), 4)
    meta, frames = read_mp4(tmp_path / "a.mp4")
    assert (meta["size"], meta["fps"], len(frames)) == ((32, 22), 12.5, 4)
