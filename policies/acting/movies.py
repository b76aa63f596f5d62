"""Write pictures to an MP4 or a GIF; the file is complete or not there at all."""

from __future__ import annotations

import io
import itertools
import math
import os
import subprocess
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from PIL import Image

from policies.errors import CannotRunError
from policies.files import atomic_path, write_atomic

GIF_MAX_BYTES = 3_000_000
_GIF_MAX_FPS = 25.0  # GIF delays are whole hundredths of a second, and many viewers slow down those below 3 of them
_GIF_MAX_FRAMES = 500
_LONGEST_CS = 65_535  # hundredths of a second that a GIF can show a frame: its format has two bytes for them
_GIF_COLORS = 128
# Pairs (scale, n): every n-th frame is kept, at this scale; tried in turn until the GIF is small enough.
_GIF_ATTEMPTS = ((1.0, 1), (1.0, 2), (0.75, 2), (0.75, 4), (0.5, 4), (0.5, 8), (0.25, 8))
_STILL_TIMEOUT_S = 30.0
_MIN_SIDE = 320


class Mp4Writer:
    """Writes H.264 in the form that browsers and players accept: yuv420p, even sizes, the index at the front.

    A context manager; the file appears when the block ends without an error. Pictures of another size than the first
    are fitted into it.

    Args:
        path: File to write.
        fps: Pictures per second.

    Raises:
        CannotRunError: There is no encoder for this machine, it failed, or the file cannot be written.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._path, self._fps = path, fps
        self._stack = ExitStack()
        self._process: subprocess.Popen[bytes] | None = None
        self._size = (0, 0)
        self._errors: IO[bytes]
        self._temporary: Path

    def __enter__(self) -> Self:
        self._temporary = self._stack.enter_context(atomic_path(self._path))
        self._errors = self._stack.enter_context(tempfile.TemporaryFile())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        except BaseException as failure:
            self._kill()
            self._stack.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._kill()
        self._stack.__exit__(kind, error, traceback)

    def add(self, picture: Image.Image, times: int = 1) -> None:
        """Add a picture, `times` times in a row."""
        if self._process is None:
            self._size = picture.size
            self._process = self._start(picture.size)
        # The encoder cuts the bytes into pictures by their size alone.
        picture = fitted(picture, self._size)
        data = (picture if picture.mode == "RGB" else picture.convert("RGB")).tobytes()
        assert self._process.stdin is not None
        try:
            for _ in range(times):
                self._process.stdin.write(data)
        except OSError as error:
            raise self._failed() from error

    def _start(self, size: tuple[int, int]) -> subprocess.Popen[bytes]:
        import imageio_ffmpeg

        try:
            program = imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError as error:
            raise CannotRunError(
                f"No ffmpeg was found to write {self._path}: {error}.",
                "Install ffmpeg, or set IMAGEIO_FFMPEG_EXE to one.",
            ) from error
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{self._fps:.6g}"]
        # Odd sizes cannot be halved for the colour planes: one more row or column of background.
        even = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"]
        coding = ["-c:v", "libx264", "-preset", "veryfast", "-crf", "20", "-pix_fmt", "yuv420p"]
        command = [
            program,
            "-v",
            "error",
            "-y",
            *raw,
            "-i",
            "-",
            "-an",
            *even,
            *coding,
            "-movflags",
            "+faststart",
        ]
        return subprocess.Popen(  # noqa: S603  (a fixed command; the path is no shell text)
            [*command, str(self._temporary)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            # Its own group, so that Ctrl-C reaches this process alone and the block decides what happens.
            process_group=0 if os.name == "posix" else None,
        )

    def _finish(self) -> None:
        if self._process is None:
            raise CannotRunError(f"There is no picture to write to {self._path}.", "Record at least one episode.")
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except OSError as error:
            raise self._failed() from error
        if self._process.wait() != 0:
            raise self._failed()

    def _failed(self) -> CannotRunError:
        self._kill()
        self._errors.seek(0)
        detail = self._errors.read().decode(errors="replace").strip()[-500:] or "it gave no message"
        return CannotRunError(
            f"ffmpeg could not write {self._path}: {detail}.",
            "Check the free space of the disk, or set IMAGEIO_FFMPEG_EXE.",
        )

    def _kill(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()


def enlarged(picture: Image.Image, side: int) -> Image.Image:
    """Return a picture whose pixels become squares if the given side of it, in pixels, is too short to be seen."""
    zoom = -(-_MIN_SIDE // side)
    if zoom == 1:
        return picture
    return picture.resize((picture.width * zoom, picture.height * zoom), Image.Resampling.NEAREST)


def fitted(picture: Image.Image, size: tuple[int, int]) -> Image.Image:
    """Return a picture of a size: itself if it has that size, else scaled to fit, in the middle of a black one.

    Args:
        picture: A picture of any size.
        size: The width and the height in pixels.
    """
    if picture.size == size:
        return picture
    scale = min(wanted / length for wanted, length in zip(size, picture.size, strict=True))
    width, height = (max(1, round(length * scale)) for length in picture.size)
    whole = Image.new("RGB", size)
    whole.paste(picture.resize((width, height)), ((size[0] - width) // 2, (size[1] - height) // 2))
    return whole


def still_of(film: Path) -> bytes | None:
    """Return a telling picture of a film, as JPEG, for where films don't play; None: it can't be read."""
    import imageio_ffmpeg

    # The filter chooses the picture that is most like the others of the film's first 200.
    choose = ["-vf", "thumbnail=200", "-frames:v", "1", "-f", "image2pipe", "-c:v", "mjpeg", "-q:v", "4", "-"]
    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
        command = [program, "-v", "error", "-i", str(film), *choose]
        done = subprocess.run(  # noqa: S603  (a fixed command; the path is no shell text)
            command, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=_STILL_TIMEOUT_S
        )
    except (OSError, RuntimeError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 and done.stdout else None


class GifWriter:
    """Writes a looping GIF that plays in real time and has a bounded size.

    It keeps fewer and smaller pictures of a long or colourful episode. Pictures of another size than the first are
    fitted into it.

    Args:
        path: File to write.
        fps: Pictures per second of the episode, one for each call of `add`.
        max_bytes: The size in bytes that the file stays under.
    """

    def __init__(self, path: Path, fps: float, *, max_bytes: int = GIF_MAX_BYTES) -> None:
        self._path, self._fps, self._max_bytes = path, fps, max_bytes
        self._stride = max(1, math.ceil(fps / _GIF_MAX_FPS))
        self._frames: list[tuple[float, bool, Image.Image]] = []  # start in seconds, must stay, picture
        self._time_s = 0.0
        self._count = 0

    def add(self, draw: Callable[[], Image.Image], *, hold_s: float = 0.0) -> None:
        """Add a picture, or skip it: not all are needed, so `draw` is called only for those that are.

        Args:
            draw: Makes the picture.
            hold_s: Seconds that it is shown for in addition; if not 0, the picture is never skipped.
        """
        if hold_s > 0 or self._count % self._stride == 0:
            picture = draw()
            size = self._frames[0][2].size if self._frames else picture.size
            self._frames.append((self._time_s, hold_s > 0, fitted(picture, size)))
        self._count += 1
        self._time_s += 1.0 / self._fps + hold_s
        if len(self._frames) > _GIF_MAX_FRAMES:
            self._stride *= 2
            self._frames = _every(2, self._frames)

    def save(self) -> None:
        """Write the file.

        Raises:
            CannotRunError: There is no picture, or the file cannot be written.
        """
        if not self._frames:
            raise CannotRunError(f"There is no picture to write to {self._path}.", "Record at least one episode.")
        data = b""
        for scale, step in _GIF_ATTEMPTS:
            data = self._encode(scale, step)
            if len(data) <= self._max_bytes:
                break
        write_atomic(self._path, data)

    def _encode(self, scale: float, step: int) -> bytes:
        frames = _every(step, self._frames)
        starts = [round(start * 100) for start, _, _ in frames] + [round(self._time_s * 100)]
        durations = [10 * min(max(2, end - start), _LONGEST_CS) for start, end in itertools.pairwise(starts)]
        pictures = [picture for _, _, picture in frames]
        if scale < 1:
            size = tuple(max(1, round(length * scale)) for length in pictures[0].size)
            pictures = [picture.resize((size[0], size[1]), Image.Resampling.LANCZOS) for picture in pictures]
        # One palette for all, without dithering: unchanged pixels stay equal, and only the others are stored.
        palette = _common_palette(pictures)
        indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
        buffer = io.BytesIO()
        indexed[0].save(
            buffer,
            "GIF",
            save_all=True,
            append_images=indexed[1:],
            duration=durations,
            loop=0,
            optimize=False,
        )
        return buffer.getvalue()


def _every(step: int, frames: list[tuple[float, bool, Image.Image]]) -> list[tuple[float, bool, Image.Image]]:
    return [frame for index, frame in enumerate(frames) if index % step == 0 or frame[1]]


def _common_palette(pictures: list[Image.Image]) -> Image.Image:
    """Return one palette for all pictures, made from up to eight of them."""
    sample = pictures[:: max(1, len(pictures) // 8)][-8:]
    width, height = sample[0].size
    montage = Image.new("RGB", (width, height * len(sample)))
    for index, picture in enumerate(sample):
        montage.paste(picture, (0, index * height))
    # The octree keeps a plain background exactly; the default, median cut, turns white into off-white.
    return montage.quantize(colors=_GIF_COLORS, method=Image.Quantize.FASTOCTREE)
