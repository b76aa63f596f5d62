"""Show a running sweep: a table that is redrawn on a terminal or in a notebook, or else a line from time to time."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import IO

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.live import Live
from rich.spinner import Spinner
from rich.text import Text

from analysis.wording import duration
from policies.errors import fit
from tune_jobs.process.streams import patient_stream, quiet
from tune_jobs.sweeps.fitting_console import FittingConsole
from tune_jobs.sweeps.live_table import render, summary_line
from tune_jobs.sweeps.monitor import SweepMonitor
from tune_jobs.sweeps.notebook_view import WIDTH, NotebookView, kernel_shell

_REFRESH_PER_S = 4
_LINE_INTERVAL_S = 10.0
_LOOK_S = 0.5
"""How soon a line tells what somebody waits for."""
_KEPT_TIMES = 10
"""A table is shown so many times as long as it took to draw: the sweep is driven in the same process."""
_MOST_KEPT_S = 3.0

Say = Callable[[str], None]
"""Takes what is done now, such as "writing the report"."""

_shares_terminal = False


def share_terminal() -> None:
    """Print lines on a terminal too from now on, because another process writes there and would break a table."""
    global _shares_terminal  # noqa: PLW0603 (a process has one standard error)
    _shares_terminal = True


class _Lines:
    """Prints a line at regular intervals, once as soon as there is news, and at the end if asked to."""

    def __init__(
        self,
        line: Callable[[], str],
        stream: IO[str],
        *,
        at_the_end: bool,
        has_news: Callable[[], bool] = lambda: False,
    ) -> None:
        self._line = line
        self._stream = stream
        self._at_the_end = at_the_end
        self._has_news = has_news
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        if self._at_the_end:
            self._print()

    def _run(self) -> None:
        told_at, had_news = time.monotonic(), False
        while not self._over.wait(min(_LOOK_S, _LINE_INTERVAL_S)):
            has_news = self._has_news()
            if has_news > had_news or time.monotonic() - told_at >= _LINE_INTERVAL_S:
                told_at = time.monotonic()
                self._print()
            had_news = has_news

    def _print(self) -> None:
        print(fit(self._line()), file=self._stream, flush=True)


class _Screen:
    """Gives rich the present table each time it redraws: of thousands of trials, one that is a moment old."""

    def __init__(self, monitor: SweepMonitor) -> None:
        self._monitor = monitor
        self._table: RenderableType = ""
        self._drawn_for: tuple[object, ...] = ()
        self._kept_until = 0.0

    def table(self, width: int, height: int | None = None) -> RenderableType:
        """Return the table: a new one at the end, when it stops and in another size, else as often as it is cheap."""
        asked_for = (width, height, self._monitor.stopping)
        began = time.monotonic()
        if self._monitor.is_over or asked_for != self._drawn_for or began >= self._kept_until:
            self._table, self._drawn_for = render(self._monitor, width, height), asked_for
            now = time.monotonic()
            self._kept_until = now + min(_KEPT_TIMES * (now - began), _MOST_KEPT_S)
        return self._table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield self.table(options.max_width, console.height)


class _Drawing(Live):
    """Hides the cursor only while it draws: Ctrl-Z and a kill leave the terminal as it is, and a shell needs one."""

    def refresh(self) -> None:
        """Draw anew, in one piece with the controls around it."""
        with self._lock, self.console:
            self.console.show_cursor(False)  # noqa: FBT003 (rich's signature)
            super().refresh()
            self.console.show_cursor(True)  # noqa: FBT003


@contextlib.contextmanager
def shown(monitor: SweepMonitor, progress: str, log: Path, notes: Sequence[str] = ()) -> Iterator[None]:
    """Show a sweep on standard error while the block runs; what libraries print there goes to a file instead.

    Args:
        monitor: The monitor of the sweep to show.
        progress: `auto`: a table on a terminal and in a notebook, else lines; `none`: nothing.
        log: File for everything else that this process prints.
        notes: Notes of the plan, which are shown first.
    """
    with quiet(log) as stream:
        if progress != "none":
            for note in notes:
                print(fit(f"note: {note}"), file=stream, flush=True)
        with contextlib.ExitStack() as stack:
            if progress != "none":
                stack.enter_context(_view(monitor, stream))
            # What is left on the screen afterwards is the result.
            stack.callback(monitor.end)
            yield


def _view(monitor: SweepMonitor, stream: IO[str]) -> AbstractContextManager[object]:
    screen = _Screen(monitor)
    if kernel_shell() is not None:
        return NotebookView(monitor.name, lambda: screen.table(WIDTH), is_line=False)
    console = FittingConsole(file=stream)
    if _can_redraw(stream, console):
        # Rich would take what is printed meanwhile to the terminal, and it is for the log.
        return _Drawing(
            screen, console=console, refresh_per_second=_REFRESH_PER_S, redirect_stdout=False, redirect_stderr=False
        )
    return _Lines(lambda: summary_line(monitor), stream, at_the_end=True, has_news=lambda: monitor.stopping)


def _can_redraw(stream: IO[str], console: Console) -> bool:
    """Whether a table can be drawn again and again; where rich doesn't think so, it draws none until the end."""
    is_able = console.is_terminal and console.is_interactive and not console.is_dumb_terminal
    return stream.isatty() and is_able and not _shares_terminal


@contextlib.contextmanager
def working(name: str, what: str, progress: str) -> Iterator[Say]:
    """Show on standard error what is done after the trials while the block does it; nothing of it stays on a terminal.

    The block is given what says something else from then on.

    Args:
        name: The sweep's name.
        what: What is done, such as "writing the report". Without a terminal, a line says it if it takes long.
        progress: The same as for `shown`.
    """
    started = time.monotonic()
    spinner = Spinner("line", style="cyan")

    def line() -> str:
        return f"{name}: {what}, {duration(time.monotonic() - started, tenths=False)}"

    def say(present: str) -> None:
        nonlocal what
        what = present
        # Not a plain string, in which rich would take what a path has in brackets for a style.
        spinner.update(text=Text(f"{name}: {what} ..."))

    say(what)
    if progress == "none":
        yield say
        return
    if kernel_shell() is not None:
        with NotebookView(name, lambda: f"{line()} ...", is_line=True):
            yield say
        return
    # Unlike `shown`, this leaves the streams alone: warnings of libraries are seen.
    with patient_stream() as stream:
        console = FittingConsole(file=stream)
        if _can_redraw(stream, console):
            with _Drawing(spinner, console=console, refresh_per_second=_REFRESH_PER_S, transient=True):
                yield say
        else:
            with _Lines(line, stream, at_the_end=False):
                yield say
