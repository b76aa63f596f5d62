"""Let a process tell the process that watches it which call of a user's code it is in.

A *call* is one of an environment's constructor or methods, the import of its module, or a policy's `act`. The process
that runs them writes into a *page* of memory that it shares with its watcher. If the count of calls stops rising, a
call hangs; if the process has ended, the call that it was in has ended it. Trials are not watched: nothing is written
there, and it costs nothing.
"""

from __future__ import annotations

import contextlib
import enum
import mmap
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

PAGE_BYTES = 64
_COUNT, _CALL, _STEPS, _RESETS, _RENDERS = range(5)
_Watched = TypeVar("_Watched")


class Call(enum.IntEnum):
    """The call of a user's code that a process is in."""

    NONE = 0
    """No call: the process runs code of this package."""
    IMPORT = 1
    CONSTRUCTOR = 2
    RESET = 3
    STEP = 4
    RENDER = 5
    CLOSE = 6
    ACT = 7

    @property
    def phrase(self) -> str:
        """The words for the call in a message."""
        return _PHRASES.get(self, f"{self.name.lower()}()")


_PHRASES = {
    Call.NONE: "what is around its calls",
    Call.IMPORT: "the import of its module",
    Call.CONSTRUCTOR: "its constructor",
    Call.ACT: "act() of the policy",
}
_ENV_METHODS = {"reset": Call.RESET, "step": Call.STEP, "render": Call.RENDER, "close": Call.CLOSE}


class Page:
    """Shared memory with the call that runs, and the numbers of calls, steps, resets and pictures so far.

    Args:
        number: Descriptor of a file of `PAGE_BYTES` bytes, which both processes have open.
    """

    def __init__(self, number: int) -> None:
        self._cells = memoryview(mmap.mmap(number, PAGE_BYTES)).cast("Q")
        self.last_raised = Call.NONE
        """The outermost call that raised an error last; not shared."""

    @property
    def count(self) -> int:
        """How many calls have begun, plus how many have ended."""
        return self._cells[_COUNT]

    @property
    def call(self) -> Call:
        """The call that the process is in."""
        return Call(self._cells[_CALL])

    @property
    def steps(self) -> int:
        """Steps since its last reset of the environment stepped last, including a step that still runs."""
        return self._cells[_STEPS]

    @property
    def resets(self) -> int:
        """How often environments have been reset so far."""
        return self._cells[_RESETS]

    @property
    def renders(self) -> int:
        """How many pictures environments have drawn so far, including one that is being drawn."""
        return self._cells[_RENDERS]

    @contextlib.contextmanager
    def inside(self, call: Call) -> Iterator[None]:
        """Mark the block as a call of this kind."""
        cells = self._cells
        around = cells[_CALL]
        cells[_CALL] = call
        cells[_COUNT] += 1
        try:
            yield
        except BaseException:
            self.last_raised = call
            raise
        finally:
            cells[_CALL] = around
            cells[_COUNT] += 1

    def telling(self, method: Callable[..., Any], call: Call, steps: list[int]) -> Callable[..., Any]:
        """Return a method that does the same and writes each of its calls to the page.

        Args:
            method: A method of an environment or a policy.
            call: The kind of call that it is.
            steps: A list of one number, the environment's steps since its last reset; its methods share it.
        """
        cells = self._cells

        # `inside` would take ten times as long, and fast environments make hundreds of thousands of calls.
        def told(*args: Any, **kwargs: Any) -> Any:
            around = cells[_CALL]
            cells[_CALL] = call
            cells[_COUNT] += 1
            if call == _STEP:
                steps[0] += 1
                cells[_STEPS] = steps[0]
            elif call == _RESET:
                steps[0] = 0
                cells[_RESETS] += 1
            elif call == _RENDER:
                cells[_RENDERS] += 1
            try:
                return method(*args, **kwargs)
            except BaseException:
                self.last_raised = call
                raise
            finally:
                cells[_CALL] = around
                cells[_COUNT] += 1

        return told


# An enum's members are slow to look up.
_STEP, _RESET, _RENDER = Call.STEP, Call.RESET, Call.RENDER
_page: Page | None = None


def tell(page: Page) -> None:
    """Write every call of this process to a page from now on; for a process that was started to be watched."""
    global _page  # noqa: PLW0603 (as a process has one watcher)
    _page = page


def inside(call: Call) -> contextlib.AbstractContextManager[None]:
    """Mark the block as a call of this kind, if this process is watched."""
    return contextlib.nullcontext() if _page is None else _page.inside(call)


def watch_env(env: _Watched) -> _Watched:
    """Have an environment, scalar or vector, write its calls to the page, if this process is watched.

    No wrapper is put around it, because the classes of an env decide how it is stepped.
    """
    return _watch(env, _ENV_METHODS)


def watch_rows(rows: _Watched) -> _Watched:
    """Have rows of an environment write their starts and steps to the page, if this process is watched."""
    return _watch(rows, {"start": Call.RESET, "step": Call.STEP})


def watch_steps(stepper: _Watched) -> _Watched:
    """Have what steps several environments at once write its steps to the page, if this process is watched."""
    return _watch(stepper, {"step": Call.STEP})


def watch_policy(policy: _Watched) -> _Watched:
    """Have a policy write its calls to the page, if this process is watched."""
    # One of them may call another, as those of a class of the user's own do: that is a call inside a call.
    return _watch(policy, {"act": Call.ACT, "act_on_row": Call.ACT, "act_on_rows": Call.ACT})


def _watch(thing: _Watched, methods: dict[str, Call]) -> _Watched:
    if _page is not None:
        steps = [0]
        for name, call in methods.items():
            setattr(thing, name, _page.telling(getattr(thing, name), call, steps))
    return thing
