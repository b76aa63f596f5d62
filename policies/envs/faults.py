"""Handle the exceptions of an environment's code, which may be of any class.

`SystemExit`, `KeyboardInterrupt` and the like would end the process of a trial, and with it every trial trained there.
Raised by an env, they are treated as any other error of the env; raised for a signal to the process, they pass.
"""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import PurePath
from traceback import walk_tb
from types import FrameType
from typing import Any, NamedTuple, cast

import numpy as np
from gymnasium.error import DependencyNotInstalled

from policies.envs.rendering import display_hint
from policies.envs.requirements import module_of_file, unmet_requirements
from policies.envs.working_folder import leave_removed_folder
from policies.errors import EnvFailedError, said_by

_PACKAGE = PurePath(__file__).parents[1]
_ONE_ALONE = re.compile("(?i)(per|same|each|one|single) process")
"""In an error of an env that can't be in a process twice, such as stable-retro's."""
_PYGAME_IS_CLOSED = re.compile("display Surface quit|(?:video system|font|mixer) not initialized")
"""What pygame says once an environment of the process has called `pygame.quit()`, which closes what all draw on."""
_OLDER_NUMPY = re.compile(
    r"module 'numpy' has no attribute|removed in the NumPy|only 0-dimensional arrays can be converted"
    r"|cannot import name '\w+' from 'numpy'|numpy\.dtype size changed|numpy\.core\.multiarray failed to import"
)
"""What NumPy says to code that was written, or compiled, for a version before it."""
_NO_MODULE = re.compile(r"No module named '?(\w+)")
_INSTALLED_BY = {
    "Box2D": "Box2D==2.3.10",
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "pkg_resources": "setuptools<82",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "yaml": "pyyaml",
}
"""What brings a module that is called otherwise; setuptools had pkg_resources up to version 81."""
_RESET_TAKES_LESS = re.compile(r"\breset\(\) got an unexpected keyword argument '(?:seed|options)'")
"""What Python says where an env has the `reset` of an older Gym, or a part of Gymnasium's."""
_TAKES_NO_MODE = re.compile(r"\bgot an unexpected keyword argument 'render_mode'")
"""What Python says where a class that draws, by its metadata or those of what it wraps, can't be told to."""
_BY_WORDS = (
    (
        BaseException,
        _PYGAME_IS_CLOSED,
        (
            "pygame has one display for all environments of a process: if another one has closed it, give each a "
            "process of its own: env.own_process: true."
        ),
    ),
    (
        TypeError,
        _RESET_TAKES_LESS,
        (
            "Gymnasium's reset is given both by name: def reset(self, *, seed=None, options=None). Mend the env's, or "
            "wrap it in a class of your own that calls it without."
        ),
    ),
    (
        TypeError,
        _TAKES_NO_MODE,
        (
            "To be drawn, it is made with render_mode='rgb_array': let what makes the env take render_mode=None, and "
            "hand it on to the env that it wraps, or draw with it."
        ),
    ),
)
"""What to do about errors of some class with some words."""
_REFUSES = re.compile("(?i)valid|legal|allowed|permitted|feasible|available|masked|admissible|forbid")
_IF_REFUSED = (
    "If it refuses an action that is not allowed at the time, a mask must say so: see 'Actions that are not always "
    "allowed' in docs/guides/own-environment.md."
)
_PLACE = "_place_in_its_process"
_notes_signals = False
_signalled = False


def note_signals() -> None:
    """Let this process tell exceptions raised for its signals from those that its environments raise.

    It is for processes of trials, whose handlers of SIGTERM and SIGINT raise SystemExit and KeyboardInterrupt. Outside
    the main thread it does nothing.
    """
    global _notes_signals  # noqa: PLW0603 (signals are the process's)
    if _notes_signals or threading.current_thread() is not threading.main_thread():
        return
    _notes_signals = True
    for number in (signal.SIGINT, signal.SIGTERM):
        handler = signal.getsignal(number)
        if callable(handler):
            signal.signal(number, _noting(handler))


def _noting(handler: Callable[[int, FrameType | None], Any]) -> Callable[[int, FrameType | None], Any]:
    def note(number: int, frame: FrameType | None) -> Any:
        global _signalled  # noqa: PLW0603 (signals are the process's)
        _signalled = True
        return handler(number, frame)

    return note


def is_of_env(error: BaseException) -> bool:
    """Whether an exception from a call of an env was raised by the env, and not for a signal to this process."""
    if isinstance(error, Exception):
        return True
    if _notes_signals:
        return not _signalled
    # In the process that launched the sweep, only Ctrl-C and signals that act like it raise such an exception.
    return not isinstance(error, KeyboardInterrupt)


def env_failed(
    what: str, error: BaseException, hint: str = "Mend the env, or choose another one.", *, in_step: bool = False
) -> EnvFailedError:
    """Return the error that reports an exception of an env's code.

    Args:
        what: What failed, such as "CartPole-v1 raised an error in step()".
        error: What the env raised.
        hint: What to do, if the error itself does not say.
        in_step: Whether it was given an action, which it may have refused.

    Raises:
        BaseException: The error itself, if it came from a signal to this process.
    """
    if not is_of_env(error):
        raise error
    detail = said_by(error)
    if (place := place_in_env(error)) is not None:
        detail += f" ({place})" if detail else f"at {place}"
    # What this package itself raises says what is wrong with a mask.
    is_of_ours = type(error).__module__.startswith("policies.")
    if in_step and not is_of_ours and _REFUSES.search(f"{type(error).__name__}: {said_by(error)}"):
        hint = f"{hint} {_IF_REFUSED}"
    return EnvFailedError(f"{what}: {type(error).__name__}{f': {detail}' if detail else ''}.", hint_on(error, hint))


def hint_on(error: BaseException, otherwise: str) -> str:
    """Return what to do about an error of an env, with the packages that the env's own package would need.

    Args:
        error: What the env raised.
        otherwise: What to do if the error itself does not say.
    """
    place = place_in_env(error)
    module = None if place is None else module_of_file(place.file)
    return with_requirements(known_hint(error) or otherwise, module, error)


def with_requirements(hint: str, module: str | None, error: BaseException) -> str:
    """Return a hint on an error of a module's code, with the requirements of its package that are not met."""
    if module is None:
        return hint
    unmet = unmet_requirements(module, with_missing=isinstance(error, ImportError | DependencyNotInstalled))
    return hint if unmet is None else f"{hint} {unmet}"


def known_hint(error: BaseException) -> str | None:
    """Return what to do about an error of an env that lacks a package, a display or room; None: another one."""
    said = said_by(error)
    known = next((hint for kind, words, hint in _BY_WORDS if isinstance(error, kind) and words.search(said)), None)
    if (hint := known or display_hint(error)) is not None:
        return hint
    if _ONE_ALONE.search(said):
        return "If a process can hold one such environment only, give each a process of its own: env.own_process: true."
    if (hint := name_hint(error) or numpy_hint(error)) is not None:
        return hint
    if isinstance(error, ImportError | DependencyNotInstalled):
        return "Install the package that the message names, on every machine that runs trials."
    return None


def name_hint(error: BaseException) -> str | None:
    """Return how to install a module that is not there and that its package is not called as; None: it is none such."""
    if not isinstance(error, ImportError) or (missing := _NO_MODULE.match(said_by(error))) is None:
        return None
    package = _INSTALLED_BY.get(missing[1])
    return None if package is None else f'Install it, on every machine that runs trials: pip install "{package}".'


def numpy_hint(error: BaseException) -> str | None:
    """Return what to do about an error of code that was written for an older NumPy; None: it is none such."""
    if _OLDER_NUMPY.search(said_by(error)) is None:
        return None
    return (
        f"It is written for a NumPy older than {np.__version__}: install a newer release of it, or an older NumPy, "
        "on every machine that runs trials."
    )


def place_in_env(error: BaseException) -> Frame | None:
    """Return where in an env's own code an exception comes from; None: from none of it."""
    if (there := vars(error).get(_PLACE)) is not None:
        return cast("Frame", there)
    frames = [
        Frame(frame.f_code.co_filename, line, frame.f_code.co_name) for frame, line in walk_tb(error.__traceback__)
    ]
    # The outermost frame is the caller's.
    return frame_of_env(frames[:0:-1])


def set_place(error: BaseException, place: Frame | None) -> None:
    """Say where an exception comes from that an env raised in another process."""
    vars(error)[_PLACE] = place


class Frame(NamedTuple):
    """A frame of a traceback."""

    file: str
    line: int
    name: str

    def __str__(self) -> str:
        """Its place in the form that editors understand."""
        return f"{self.file}:{self.line} in {self.name}"


def frame_of_env(frames: Sequence[Frame]) -> Frame | None:
    """Return the innermost frame that is the env's own, of the frames of a call of the env, innermost first.

    Gymnasium and its wrappers are outside the env's own frames, and the libraries that the env calls are inside of
    them. Frames whose file is in the folder of the env's outermost frame are its own.

    Returns:
        The frame, or None if all are of this package or of Gymnasium.
    """
    own = [frame for frame in frames if not _is_around(frame.file)]
    if not own:
        return None
    folder = PurePath(own[-1].file).parent
    return next(frame for frame in own if folder in PurePath(frame.file).parents)


def _is_around(file: str) -> bool:
    """Whether a file belongs to this package, or to Gymnasium except its environments."""
    path = PurePath(file)
    # By the one that registers environments they are made, too.
    of_gymnasium = "gymnasium" in path.parts and ("envs" not in path.parts or path.name == "registration.py")
    return of_gymnasium or _PACKAGE in path.parents


def close_env(env: Any) -> None:
    """Close an environment that is not needed any more; errors of closing are ignored."""
    try:
        env.close()
    except BaseException as error:
        if not is_of_env(error):
            raise
    leave_removed_folder()
