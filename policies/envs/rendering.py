"""Draw environments where there is no display."""

from __future__ import annotations

import contextlib
import math
import os
import re
import subprocess
import sys
import traceback
from collections.abc import Callable, Mapping
from functools import cache
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from policies.envs.signatures import signature
from policies.errors import said_by

_Made = TypeVar("_Made")

_DEFAULT_FPS = 30.0
"""Frames a second of an environment whose metadata has no `render_fps`, or one that is no rate."""
_RENDER_MODE = "render_mode"
_MUJOCO_GL = "MUJOCO_GL"
_MUJOCO_BACKENDS = ("egl", "osmesa")
"""What MuJoCo draws with in memory, on a GPU if there is one, then on CPUs."""
_CHOOSES_WHEN_IMPORTED = "dm_control"
"""A package that draws with MuJoCo's backends, by the variable's value when it is imported."""
_DISPLAY = re.compile("(?i:display)(?![_a-z])")
"""In the name or the words of an error; no part of another word, as in display_mode."""
_GRAPHICS = re.compile(
    "(?i:opengl|(?<![a-z])egl|osmesa|glx|glfw|vulkan|libgl|gladload|framebuffer is not|video device"
    "|(?:x11|wayland|kmsdrm) not available|pip install)"
)
"""In the words of an error of what draws, or of what is missing to draw with."""
_GRAPHICS_PACKAGES = frozenset({"OpenGL", "dm_control", "glfw", "mujoco", "pygame", "pyglet"})
"""Which raise errors that say nothing of it, such as that None has no attribute."""
_SAYS_WHO_ERRED = "pygame"
"""The one of them whose own class of errors is also that of what its caller did wrong, as to draw without a font."""
_TRIAL_TIMEOUT_S = 30.0


def frames_per_second(metadata: Mapping[str, Any]) -> float:
    """Return the frames a second of an environment's own time, by its metadata."""
    try:
        rate = float(metadata.get("render_fps") or _DEFAULT_FPS)
    except (TypeError, ValueError, OverflowError):  # whatever it is, it is no number
        return _DEFAULT_FPS
    return rate if 0 < rate < math.inf else _DEFAULT_FPS


def draw_without_display() -> None:
    """Let pygame and MuJoCo draw into memory if this machine has no display; call it before an env that draws is made.

    MuJoCo's part is done once the process has imported it: whoever draws nothing of it need not wait for a trial of its
    libraries, which takes half a second. Where dm_control is installed, it is done in any case, as that would be too
    late.
    """
    # Otherwise pygame prints a greeting on standard output and connects to a display.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    if not _lacks_display():
        return
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
    if "mujoco" in sys.modules or find_spec(_CHOOSES_WHEN_IMPORTED):
        _choose_backend()


def choose_before_import() -> None:
    """Let what an env's module imports find its way to draw chosen; call it before that, if the env may be drawn later.

    Nothing is done where MuJoCo is imported already: `draw_without_display` does that where something is drawn.
    """
    if _lacks_display() and "mujoco" not in sys.modules and find_spec(_CHOOSES_WHEN_IMPORTED):
        _choose_backend()


def _choose_backend() -> None:
    if _MUJOCO_GL not in os.environ and (name := _mujoco_backend()) is not None:
        os.environ[_MUJOCO_GL] = name


def without_window(
    make: Callable[..., _Made],
    env_args: Mapping[str, Any],
    creator: Callable[..., Any] | None,
    given: Mapping[str, Any],
) -> _Made:
    """Make an environment, or several, that open no window though "human" is the render mode they have by default.

    Args:
        make: Makes it of the arguments.
        env_args: The arguments; with a render mode among them, they are taken as they are.
        creator: The env's class, or the function that makes it; None: it is not known.
        given: The arguments with which it is registered.
    """
    if {**_defaults(creator), **given, **env_args}.get(_RENDER_MODE) == "human" and _RENDER_MODE not in env_args:
        with contextlib.suppress(Exception):  # what takes no such mode is made as it wants, or raises again
            return make(**{**env_args, _RENDER_MODE: None})
    return make(**env_args)


def _defaults(creator: Callable[..., Any] | None) -> dict[str, Any]:
    """Return the defaults of the parameters of what makes an env."""
    parameters = signature(creator).parameters if creator is not None else {}
    return {name: parameter.default for name, parameter in parameters.items()}


def display_hint(error: BaseException) -> str | None:
    """Return what to do about an error that speaks of a display on a machine without one; None: it is none such."""
    # A module that is missing is missed with a display, too, whatever it is called.
    if isinstance(error, ModuleNotFoundError) or not _lacks_display():
        return None
    if not _DISPLAY.search(f"{type(error).__name__} {said_by(error)}"):
        return None
    return (
        "It wants a display, and there is none here: `xvfb-run -a tune-jobs ...` gives it one (Debian's xvfb, xauth)."
    )


def drawing_hint(error: BaseException) -> str:
    """Return what to do about an error that an environment's `render()` raised."""
    if (hint := display_hint(error)) is not None:
        return hint
    by = {
        str(frame.f_globals.get("__name__", "")).partition(".")[0]
        for frame, _ in traceback.walk_tb(error.__traceback__)
    }
    # What is raised in C leaves no frame of its package.
    by |= {type(error).__module__.partition(".")[0]} - {_SAYS_WHO_ERRED}
    told = f"{type(error).__name__} {said_by(error)}"
    if isinstance(error, ImportError) or by & _GRAPHICS_PACKAGES or _GRAPHICS.search(told):
        return (
            "Install what it needs to draw without a display (for MuJoCo EGL or OSMesa: Debian's libegl1 or "
            "libosmesa6)."
        )
    return "Mend its render()."


def picture_of(drawn: Any) -> NDArray[np.uint8] | None:
    """Return a picture (rows, columns, 3) of what an env drew; None: it is no picture.

    As matplotlib's, it may have a fourth channel, for what shines through, which is left out, and its numbers may be
    floating-point numbers of 0 to 1, as MinAtar's are, in place of bytes.
    """
    picture = np.asarray(drawn)
    if picture.ndim != 3 or picture.shape[2] not in (3, 4) or picture.size == 0:
        return None
    colours = picture[:, :, :3]
    if colours.dtype == np.uint8:
        return colours
    if np.issubdtype(colours.dtype, np.floating) and colours.min() >= 0 and colours.max() <= 1:
        return np.round(255 * colours).astype(np.uint8)
    return None


def _lacks_display() -> bool:
    return sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@cache
def _mujoco_backend() -> str | None:
    """Return the first of the backends that draws on this machine; None: none does.

    Gymnasium tries a window first, and takes one that could not be opened for an open one: its next attempts are never
    made. A library that is there may still find no device, and what was imported for one backend can't be taken back
    for another; so each is tried in a process of its own.
    """
    return next((name for name in _MUJOCO_BACKENDS if _draws(name)), None)


def _draws(backend: str) -> bool:
    code = f"from mujoco.{backend} import GLContext; GLContext(8, 8).make_current()"
    try:
        done = subprocess.run(  # noqa: S603  (a fixed command)
            [sys.executable, "-c", code],
            env={**os.environ, _MUJOCO_GL: backend},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
            timeout=_TRIAL_TIMEOUT_S,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0
