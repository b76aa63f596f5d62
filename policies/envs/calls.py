"""Which call of a user's code a process is in, told to the process that watches it.

A *call* is one of an environment's constructor or methods, the import of its module, or a policy's `act`. The process
that runs them writes into a *page* of memory that it shares with its watcher: where the count goes up no more, a call
has hung; where the process ended, the call that it was in has ended it. Where nobody watches, in trials, nothing is
told and nothing costs.
"""

from __future__ import annotations

import contextlib
import enum
import mmap
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

PAGE_BYTES = 64
_COUNT, _CALL, _STEPS = range(3)
_Watched = TypeVar("_Watched")


class Call(enum.IntEnum):
    """What a process is in."""

    NONE = 0
    """Code of this package."""
    IMPORT = 1
    CONSTRUCTOR = 2
    RESET = 3
    STEP = 4
    RENDER = 5
    CLOSE = 6
    ACT = 7

    @property
    def phrase(self) -> str:
        """In a message."""
        return _PHRASES.get(self, f"{self.name.lower()}()")


_PHRASES = {
    Call.NONE: "what is around its calls",
    Call.IMPORT: "the import of its module",
    Call.CONSTRUCTOR: "its constructor",
    Call.ACT: "act() of the policy",
}
_ENV_METHODS = {"reset": Call.RESET, "step": Call.STEP, "render": Call.RENDER, "close": Call.CLOSE}


class Page:
    """Shared memory: what is told, and what was.

    Args:
        number: Descriptor of a file of `PAGE_BYTES`, which both processes have open.
    """

    def __init__(self, number: int) -> None:
        self._cells = memoryview(mmap.mmap(number, PAGE_BYTES)).cast("Q")
        self.last_raised = Call.NONE
        """The outermost call that raised last; not shared."""

    @property
    def count(self) -> int:
        """Begins and ends of calls so far."""
        return self._cells[_COUNT]

    @property
    def call(self) -> Call:
        """What the process is in."""
        return Call(self._cells[_CALL])

    @property
    def steps(self) -> int:
        """Of the environment that was stepped last: its steps since its last reset, the one that runs included."""
        return self._cells[_STEPS]

    @contextlib.contextmanager
    def inside(self, call: Call) -> Iterator[None]:
        """Tell that the block is such a call."""
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
        """The method, which tells of each time that it is called.

        Args:
            method: Of an environment or a policy.
            call: Which it is.
            steps: Of the same environment's methods: one number, its steps since its last reset.
        """
        cells = self._cells

        # Not by `inside`, which takes ten times as long: fast environments make hundreds of thousands of calls.
        def told(*args: Any, **kwargs: Any) -> Any:
            around = cells[_CALL]
            cells[_CALL] = call
            cells[_COUNT] += 1
            if call == _STEP:
                steps[0] += 1
                cells[_STEPS] = steps[0]
            elif call == _RESET:
                steps[0] = 0
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
_STEP, _RESET = Call.STEP, Call.RESET
_page: Page | None = None


def tell(page: Page) -> None:
    """Tell a page from now on what this process is in; it was started to be watched."""
    global _page  # noqa: PLW0603 (as a process has one watcher)
    _page = page


def inside(call: Call) -> contextlib.AbstractContextManager[None]:
    """Tell that the block is such a call, if anybody watches."""
    return contextlib.nullcontext() if _page is None else _page.inside(call)


def watch_env(env: _Watched) -> _Watched:
    """Let an environment, scalar or vector, tell of its calls, if anybody watches.

    It stays what it is: no wrapper is put around it, because what an env is made of decides how it is stepped.
    """
    return _watch(env, _ENV_METHODS)


def watch_policy(policy: _Watched) -> _Watched:
    """Let a policy tell of its calls, if anybody watches."""
    return _watch(policy, {"act": Call.ACT})


def _watch(thing: _Watched, methods: dict[str, Call]) -> _Watched:
    if _page is not None:
        steps = [0]
        for name, call in methods.items():
            setattr(thing, name, _page.telling(getattr(thing, name), call, steps))
    return thing
