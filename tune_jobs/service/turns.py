"""Turns at what takes long, such as planning a sweep: few at once, so that threads are left for other requests."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass, field


class Turns:
    """Gives turns to those who wait, in the order in which they came; nobody has more than some at once.

    Event loops and threads may share it.

    Args:
        at_once: How many turns go on at once.
        of_one: How many of them are one person's.
        wait_s: How long one waits for a turn at most, in seconds.
    """

    def __init__(self, at_once: int = 4, of_one: int = 2, wait_s: float = 60.0) -> None:
        self.at_once, self.of_one, self.wait_s = at_once, of_one, wait_s
        self._going: Counter[str] = Counter()
        self._waiting: list[Turn] = []
        self._lock = threading.Lock()
        self.is_closed = False

    def close(self) -> None:
        """Let those who wait, and those who come later, have no turn."""
        with self._lock:
            self.is_closed = True
            for turn in self._waiting:
                turn.wake()

    @contextlib.asynccontextmanager
    async def turn(self, who: str) -> AsyncIterator[Turn]:
        """Wait for a turn, which ends with the block; it may not have come in time.

        Args:
            who: Whose it is.
        """
        turn = Turn(self, who)
        with self._lock:
            self._waiting.append(turn)
            self._call()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0 if self.is_closed else self.wait_s):
                    await turn.called.wait()
            with self._lock:
                turn.has_come = turn not in self._waiting
            yield turn
        finally:
            self.end(turn)

    def end(self, turn: Turn) -> None:
        """End a turn, or the waiting for it; it may have ended before."""
        with self._lock:
            if turn in self._waiting:
                self._waiting.remove(turn)
            elif not turn.has_ended:
                self._going[turn.who] -= 1
                # Whoever has none is forgotten.
                self._going += Counter()
            turn.has_ended = True
            self._call()

    def _call(self) -> None:
        """Call those whose turn has come; the lock is held."""
        for turn in list(self._waiting):
            if self._going.total() >= self.at_once or self.is_closed:
                break
            if self._going[turn.who] < self.of_one:
                self._waiting.remove(turn)
                self._going[turn.who] += 1
                turn.wake()


@dataclass(eq=False)
class Turn:
    """A turn, or the waiting for one."""

    turns: Turns
    who: str
    has_come: bool = False
    has_ended: bool = False
    called: asyncio.Event = field(default_factory=asyncio.Event)
    loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop)

    def wake(self) -> None:
        """Let who waits for it look whether it has come."""
        # The loop of one who is gone may have been closed; whatever made it wait ends the turn.
        with contextlib.suppress(RuntimeError):
            self.loop.call_soon_threadsafe(self.called.set)

    def end(self) -> None:
        """End it before its block ends."""
        self.turns.end(self)
