"""What is said of an environment that hangs or ends the guard's child."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path

from policies.envs.calls import Call, Page
from policies.errors import EnvFailedError

_MAX_FRAMES = 8
_PACKAGE = Path(__file__).parents[1]
_C_STACK = "Current thread's C stack trace"
"""What Python's fault handler writes after the frames of a crash, from Python 3.14 on."""


def hung(env_id: str, where: str, limit_s: float, frames: Sequence[str]) -> EnvFailedError:
    """Return the error of an environment that hangs.

    Args:
        env_id: The environment.
        where: What `place_of` returned while it hung.
        limit_s: How long nothing came back, in seconds.
        frames: The frames of the user's code, innermost first.
    """
    return EnvFailedError(
        f"{env_id} hangs in {where}: nothing came back for {limit_s:g} s{_shown(frames)}",
        "Mend what it waits for, or set iteration_timeout_s higher if one call may take so long.",
    )


def died(env_id: str, page: Page, code: int | None, frames: Sequence[str]) -> EnvFailedError:
    """Return the error of an environment whose process ended.

    Args:
        env_id: The environment.
        page: What the process wrote its calls to.
        code: Its exit code; None: it has closed its connection and still runs.
        frames: The frames of the user's code, innermost first.
    """
    how = "closed its connection" if code is None else f"ended with exit code {code}"
    hint = "Mend the env: it must raise an error, not end the process that it runs in."
    if page.call is Call.NONE:
        hint = "See what it printed to standard error."
    if code is not None and code < 0:
        name, said = _signal_name(-code), (signal.strsignal(-code) or "").lower()
        how = f"was ended by {name} ({said})" if said else f"was ended by {name}"
        if -code == signal.SIGKILL:
            hint = "Look at this machine's memory: the system ends processes that take too much."
    return EnvFailedError(f"The process of {env_id} {how} in {place_of(page)}{_shown(frames)}", hint)


def place_of(page: Page) -> str:
    """Return the words for the call that a process is in."""
    call = page.call
    if call is Call.STEP and page.steps:
        return f"{call.phrase}, step {page.steps} after reset()"
    return call.phrase


def frames_in(dump: str) -> list[str]:
    """Return the frames of the user's code, innermost first, of what Python's fault handler wrote."""
    frames: list[str] = []
    # The main thread's frames come last, after those of other threads.
    for line in dump.partition(_C_STACK)[0].rpartition("(most recent call first):")[2].splitlines():
        place = line.strip()
        if place.startswith(f'File "{_PACKAGE}'):
            break
        if place.startswith("File "):
            frames.append(place)
    if any("gymnasium" not in frame for frame in frames):
        while "gymnasium" in frames[-1]:  # Gymnasium's wrappers, which the call came through
            frames.pop()
    return frames[:_MAX_FRAMES]


def _shown(frames: Sequence[str]) -> str:
    return ":\n" + "\n".join(f"  {frame}" for frame in frames) if frames else "."


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
