"""Film episodes of any policy as MP4 and GIF, with a caption strip that shows the steps and the return so far.

The episodes are those that `policies.acting.evaluate` plays on the same seeds. Frames go to the encoder as they are
drawn, so a long episode needs no memory for its MP4; the GIF keeps a bounded number of small frames.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from policies.acting.evaluate import Episodes, check_policy, check_seeds, episode_cap, episode_steps
from policies.acting.movies import GifWriter, Mp4Writer, enlarged, fitted
from policies.acting.policy import Policy
from policies.envs.faults import close_env
from policies.envs.make import make_env
from policies.envs.rendering import draw_without_display, drawing_hint, frames_per_second, picture_of
from policies.errors import EnvError, SpecError, said_by

MAX_ENDLESS_STEPS = 3_000
"""Env steps of an episode that are filmed where the env sets no limit to them: 100 s at 30 frames a second."""
_HOLD_S = 1.0  # the last picture stays, so that the final return can be read
_LEAST_FPS, _MOST_FPS = 0.1, 999.0  # of an environment with less or more, a film is as much faster or slower
_GIF_SCALE = 0.5
_GIF_MIN_WIDTH = 280
_BACKGROUND = (24, 27, 34)
_TEXT = (240, 242, 246)
_DIM = (158, 164, 176)


@dataclass(frozen=True, eq=False)
class _Panel:
    """A frame and the contents of its caption strip; a frame that is held is the very same object each time."""

    frame: Image.Image
    title: str
    steps: int
    total: float
    over: bool


def record_video(
    policy: Policy,
    *,
    env_id: str,
    env_args: Mapping[str, Any] | None = None,
    seeds: int | Sequence[int],
    mp4: Path | None = None,
    gif: Path | None = None,
    caption: str | None = None,
    fps: float | None = None,
    max_steps: int | None = None,
) -> Episodes:
    """Film one greedy episode for each seed, one after the other.

    Args:
        policy: The policy that acts.
        env_id: Gymnasium id.
        env_args: Arguments of the env's constructor; None: none.
        seeds: One seed or several.
        mp4: File to write (H.264); None: no MP4.
        gif: File to write (looping, half the size, at most about 3 MB); None: no GIF.
        caption: Text in the left half of the caption strip; None: the policy's description.
        fps: Frames a second; None: the env's `render_fps`, so that it plays in real time, but 999 if that is more,
            0.1 if it is less, and 30 if it has none, or one that is no rate.
        max_steps: Cap on the env steps of an episode; None: the env's limit, or `MAX_ENDLESS_STEPS` if it sets none.

    Returns:
        The episodes that were filmed.

    Raises:
        EnvError: The environment cannot be made or drawn, does not go with the policy, or raised an error.
        NonFiniteWeightsError: The policy's weights are NaN or infinite.
        CannotRunError: A file cannot be written, or there is no video encoder.
    """
    filmed = check_seeds([seeds] if isinstance(seeds, int | np.integer) else seeds)
    title = policy.description if caption is None else caption
    ends = []
    _check_drawable(env_id, env_args)
    with ExitStack() as stack:
        stage = stack.enter_context(_Stage(policy, env_id, env_args, title, max_steps))
        film = stack.enter_context(_Film(mp4, gif, stage.fps if fps is None else fps))
        for seed in filmed:
            for panel in stage.play(seed):
                film.add([panel], last=panel.over)
            ends.append(panel)
    return Episodes(filmed, tuple(end.total for end in ends), tuple(end.steps for end in ends))


def record_comparison(
    left: Policy,
    right: Policy,
    *,
    env_id: str,
    env_args: Mapping[str, Any] | None = None,
    seed: int,
    captions: tuple[str, str],
    left_mp4: Path,
    right_mp4: Path,
    right_gif: Path,
    both_mp4: Path,
    max_steps: int | None = None,
) -> tuple[Episodes, Episodes]:
    """Film one episode of each of two policies, alone and next to each other, drawing each frame once.

    Args:
        left: The policy shown on the left.
        right: The policy shown on the right.
        env_id: Gymnasium id.
        env_args: Arguments of the env's constructor; None: none.
        seed: The seed of both episodes.
        captions: The captions of the left and of the right episode.
        left_mp4: File to write with the left episode alone.
        right_mp4: File to write with the right episode alone.
        right_gif: File to write with the right episode as a GIF.
        both_mp4: File to write with the two side by side; the shorter one holds its last frame.
        max_steps: Cap on the env steps of an episode; None: the env's limit, or `MAX_ENDLESS_STEPS` if it sets none.

    Returns:
        The left policy's episodes and the right policy's episodes.

    Raises:
        EnvError: The environment cannot be made or drawn, does not go with a policy, or raised an error.
        NonFiniteWeightsError: A policy's weights are NaN or infinite.
        CannotRunError: A file cannot be written, or there is no video encoder.
    """
    (seed,) = check_seeds([seed])
    # Before either is made: what is closed may close a display that all environments of the process draw on.
    _check_drawable(env_id, env_args)
    with ExitStack() as stack:
        stages = [
            stack.enter_context(_Stage(policy, env_id, env_args, title, max_steps))
            for policy, title in zip((left, right), captions, strict=True)
        ]
        fps = stages[0].fps
        alone = [stack.enter_context(_Film(mp4, gif, fps)) for mp4, gif in ((left_mp4, None), (right_mp4, right_gif))]
        both = stack.enter_context(_Film(both_mp4, None, fps))
        before: list[_Panel | None] = [None, None]
        panels: list[_Panel] = []
        for panels in _in_step([stage.play(seed) for stage in stages]):
            for film, panel, known in zip(alone, panels, before, strict=True):
                if panel is not known:
                    film.add([panel], last=panel.over)
            both.add(panels, last=all(panel.over for panel in panels))
            before = list(panels)
    first, second = (Episodes((seed,), (panel.total,), (panel.steps,)) for panel in panels)
    return first, second


class _Stage:
    """An environment that can be filmed, and the policy that acts in it; a context manager."""

    def __init__(
        self,
        policy: Policy,
        env_id: str,
        env_args: Mapping[str, Any] | None,
        title: str,
        max_steps: int | None,
    ) -> None:
        self._policy, self._title = policy, title
        with warnings.catch_warnings():
            # Gymnasium warns of a render mode that the env does not list; it was refused before.
            warnings.simplefilter("ignore")
            self._env = make_env(env_id, env_args, render_mode="rgb_array")
        self._size: tuple[int, int] | None = None
        try:
            check_policy(policy, self._env)
            self._cap = episode_cap(self._env, max_steps, unlimited=MAX_ENDLESS_STEPS)
            # A sweep's films are made at its end: they are not lost over a rate that none can have.
            self.fps = max(_LEAST_FPS, min(frames_per_second(self._env.metadata), _MOST_FPS))
        except BaseException:
            close_env(self._env)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        close_env(self._env)

    def play(self, seed: int) -> Iterator[_Panel]:
        """Play the episode of a seed, and yield a panel for the reset and for each step."""
        for moment in episode_steps(self._policy, self._env, seed, max_episode_steps=self._cap):
            title = f"cut off: {self._title}" if moment.ended_by == "cap" else self._title
            yield _Panel(self._draw(), title, moment.num_env_steps, moment.total, moment.over)

    def _draw(self) -> Image.Image:
        env_id = self._env.spec.id if self._env.spec is not None else "The env"
        try:
            drawn: Any = self._env.render()
            frame = picture_of(drawn)
        except Exception as error:  # an env may raise anything
            raise EnvError(
                f"{env_id} cannot be drawn: {type(error).__name__}: {said_by(error)}.",
                drawing_hint(error),
            ) from error
        if frame is None:
            raise EnvError(
                f"{env_id} draws arrays of shape {np.shape(drawn)} and dtype {np.asarray(drawn).dtype}, not frames.",
                "Mend its render(): it must return a uint8 array (height, width, 3), or floats of 0 to 1.",
            )
        picture = Image.fromarray(frame)
        picture = enlarged(picture, picture.width)  # or the caption would not fit
        # Here and not only where it is written, or the caption would be scaled with it.
        self._size = self._size or picture.size
        return fitted(picture, self._size)


class _Film:
    """The files that are being written; a context manager: they appear when the block ends without an error."""

    def __init__(self, mp4: Path | None, gif: Path | None, fps: float) -> None:
        if not 0 < fps < 1000:
            raise SpecError(f"A video of {fps} frames a second cannot be made.", "Use a number such as 30.")
        self._fps = fps
        self._mp4 = None if mp4 is None else Mp4Writer(Path(mp4), fps)
        self._gif = None if gif is None else GifWriter(Path(gif), fps)

    def __enter__(self) -> Self:
        if self._mp4 is not None:
            self._mp4.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._mp4 is not None:
            self._mp4.__exit__(kind, error, traceback)
        if self._gif is not None and kind is None:
            self._gif.save()

    def add(self, panels: Sequence[_Panel], *, last: bool) -> None:
        """Add the next frame of each film; the last one of an episode is held."""
        if self._mp4 is not None:
            self._mp4.add(_picture(panels, 1.0), 1 + round(self._fps * _HOLD_S) if last else 1)
        if self._gif is not None:
            scale = min(1.0, max(_GIF_SCALE, _GIF_MIN_WIDTH / panels[0].frame.width))
            self._gif.add(lambda: _picture(panels, scale), hold_s=_HOLD_S if last else 0.0)


def _check_drawable(env_id: str, env_args: Mapping[str, Any] | None) -> None:
    """Check that an environment draws pictures, and let it do so in memory where there is no display."""
    draw_without_display()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plain = make_env(env_id, env_args)
    modes = list(map(str, plain.metadata.get("render_modes") or []))
    close_env(plain)
    if "rgb_array" not in modes:
        raise EnvError(
            f"{env_id} cannot be filmed: it has no render mode 'rgb_array' (it has: {', '.join(modes) or 'none'}).",
            "Evaluate it without a video, or add the render mode to the env.",
        )


def _in_step(plays: Sequence[Iterator[_Panel]]) -> Iterator[list[_Panel]]:
    """Yield the panels of several episodes until the longest is over; the others hold their last panel."""
    panels = [next(play) for play in plays]
    yield panels
    while not all(panel.over for panel in panels):
        panels = [panel if panel.over else next(play) for panel, play in zip(panels, plays, strict=True)]
        yield panels


def _picture(panels: Sequence[_Panel], scale: float) -> Image.Image:
    """Return a picture of the panels next to each other, each with its caption strip."""
    parts = [_captioned(panel, scale) for panel in panels]
    gap = max(2, round(12 * scale)) if len(parts) > 1 else 0
    width = sum(part.width for part in parts) + gap * (len(parts) - 1)
    picture = Image.new("RGB", (width, max(part.height for part in parts)), _BACKGROUND)
    x = 0
    for part in parts:
        picture.paste(part, (x, 0))
        x += part.width + gap
    return picture


# Enough for both panels at both scales: the same panels go into several films, or are held.
@lru_cache(maxsize=4)
def _captioned(panel: _Panel, scale: float) -> Image.Image:
    width, height = (max(1, round(length * scale)) for length in panel.frame.size)
    # Text is drawn at the final size: scaled down it could not be read in a GIF.
    strip = min(44, max(26, round(width * 0.066)))
    strip += (height + strip) % 2  # H.264 wants even heights
    picture = Image.new("RGB", (width, height + strip), _BACKGROUND)
    frame = panel.frame if scale == 1.0 else panel.frame.resize((width, height), _filter(scale))
    picture.paste(frame, (0, strip))
    draw = ImageDraw.Draw(picture)
    font = _font(round(strip * 0.46))
    pad, middle = round(strip * 0.3), strip / 2
    # Two columns of fixed width, or the words would move whenever the numbers grow.
    right: float = width - pad
    columns = (("return", _total_text(panel.total), "-0.000", _TEXT), ("step", str(panel.steps), "000", _DIM))
    for label, number, room, colour in columns:
        draw.text((right, middle), f"{label} {number}", font=font, fill=colour, anchor="rm")
        right -= max(draw.textlength(f"{label} {digits}", font) for digits in (room, number)) + pad
    draw.text((pad, middle), _shorten(panel.title, draw, font, right - pad), font=font, fill=_TEXT, anchor="lm")
    return picture


def _total_text(total: float) -> str:
    """Return the text of a return: one decimal; more where it is small, as reports have them; none of a whole one."""
    size = abs(float(total))
    if size.is_integer() or not math.isfinite(size):
        return f"{total:z.0f}"
    if size >= 2.0:
        return f"{total:z.1f}"
    decimals = 3 if size >= 0.01 else 2 - math.floor(math.log10(size))
    return f"{total:z.{decimals}f}" if decimals <= 8 else f"{total:z.3g}"


def _filter(scale: float) -> Image.Resampling:
    # Where the scale is one over a whole number, the mean of whole pixels is as good, and four times as fast.
    return Image.Resampling.BOX if (1.0 / scale).is_integer() else Image.Resampling.LANCZOS


@cache
def _font(size: int) -> Any:
    return ImageFont.load_default(size)  # unpacks the font each time


def _shorten(text: str, draw: ImageDraw.ImageDraw, font: Any, width: float) -> str:
    text = " ".join(text.split())
    if draw.textlength(text, font) <= width:
        return text
    while text and draw.textlength(text + "…", font) > width:
        text = text[:-1]
    return text.rstrip() + "…"
