"""Show a running sweep: a table that is redrawn on a terminal, or else a line from time to time."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from analysis.records import FINISHED, TrialRecord, TrialStatus
from analysis.selection import Selection
from analysis.wording import PLAIN_NONE, duration, return_text, setting_text
from tune_jobs.process.streams import quiet
from tune_jobs.sweeps.monitor import SweepMonitor

_REFRESH_PER_S = 4
_LINE_INTERVAL_S = 10.0
_STATUS_STYLES: dict[TrialStatus, str] = {
    "running": "bold cyan", "completed": "green", "stopped": "yellow", "failed": "bold red", "paused": "magenta",
    "pending": "dim",
}  # fmt: skip
_MAX_RUNNING_ROWS = 12

_shares_terminal = False


def share_terminal() -> None:
    """Print lines on a terminal too from now on, because another process writes there and would break a table."""
    global _shares_terminal  # noqa: PLW0603 (a process has one standard error)
    _shares_terminal = True


def describe_point(record: TrialRecord) -> str:
    """Describe a trial's sampled values in one line."""
    if not record.has_point:
        return "chosen at its start"
    return ", ".join(f"{name} {setting_text(value)}" for name, value in record.point.items()) or "no searched values"


def render(monitor: SweepMonitor) -> RenderableType:
    """Return the live table of a sweep."""
    counts = monitor.counts()
    total = len(monitor.records)
    finished = sum(count for status, count in counts.items() if status in FINISHED)
    head = Table.grid(padding=(0, 2))
    head.add_row(
        Text(monitor.name, style="bold"),
        ProgressBar(total=max(1, total), completed=finished, width=24),
        f"{finished} of {total} trials",
        _status_line(counts),
    )
    parts: list[RenderableType] = [head, _facts(monitor)]
    if counts.get("running"):
        parts.append(_running(monitor))
    if monitor.stopping:
        parts.append(Text("Stopping: the running trials save a checkpoint. Ctrl-C again ends them now.", "yellow"))
    return Group(*parts)


def _status_line(counts: dict[TrialStatus, int]) -> Text:
    words = [
        Text(f"{counts[status]} {status}", style=style)
        for status, style in _STATUS_STYLES.items()
        if counts.get(status)
    ]
    return Text("  ").join(words)


def _facts(monitor: SweepMonitor) -> RenderableType:
    estimate = monitor.estimate()
    left = "?" if estimate.time_left_s is None else duration(estimate.time_left_s, tenths=False, none=PLAIN_NONE)
    rate = "?" if estimate.env_steps_per_s is None else f"{estimate.env_steps_per_s:,.0f}"
    grid = Table.grid(padding=(0, 2))
    grid.add_row("best so far", _best_text(monitor.best()))
    grid.add_row("env steps/s", f"{rate}   ({monitor.num_env_steps:,} env steps in all)")
    unfinished = any(record.status not in FINISHED for record in monitor.records.values())
    time_left = f"   left: about {left}" if unfinished and not monitor.stopping else ""
    grid.add_row("time", f"{duration(monitor.elapsed_s, tenths=False)}{time_left}")
    return grid


def _best_text(best: Selection | None) -> Text:
    if best is None:
        return Text("no evaluation yet", style="dim")
    text = Text(f"{return_text(best.point_score)}", style="bold green")
    text.append(
        f"  {describe_point(best.trial)}  ({best.trial.trial_id}, at {best.checkpoint.num_env_steps:,} env steps)",
        style="default",
    )
    return text


def _running(monitor: SweepMonitor) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim", show_edge=False)
    for column in ("trial", "values"):
        table.add_column(column)
    for column in ("env steps", "training return", "evaluation return", "env steps/s"):
        table.add_column(column, justify="right")
    running = [record for record in monitor.records.values() if record.status == "running"]
    for record in running[:_MAX_RUNNING_ROWS]:
        speed = record.num_env_steps / record.time_s if record.time_s else None
        table.add_row(
            record.trial_id,
            describe_point(record),
            f"{record.num_env_steps:,}",
            return_text(record.training_return, none=PLAIN_NONE),
            return_text(record.evaluation_return, none=PLAIN_NONE),
            "" if speed is None else f"{speed:,.0f}",
        )
    if len(running) > _MAX_RUNNING_ROWS:
        table.add_row(f"and {len(running) - _MAX_RUNNING_ROWS} more", "", "", "", "", "")
    return table


def summary_line(monitor: SweepMonitor) -> str:
    """Describe the state of a sweep in one line, for logs."""
    counts = ", ".join(f"{count} {status}" for status, count in sorted(monitor.counts().items()))
    estimate = monitor.estimate()
    best = monitor.best()
    words = [
        f"{monitor.name}: {duration(monitor.elapsed_s, tenths=False)}",
        counts,
        f"{monitor.num_env_steps:,} env steps",
    ]
    if best is not None:
        words.append(f"best {return_text(best.point_score)} ({best.trial.trial_id}: {describe_point(best.trial)})")
    if estimate.time_left_s:
        words.append(f"about {duration(estimate.time_left_s, tenths=False, none=PLAIN_NONE)} left")
    return "; ".join(words)


class _Lines:
    """Prints a line at regular intervals and at the end."""

    def __init__(self, monitor: SweepMonitor, stream: IO[str]) -> None:
        self._monitor = monitor
        self._stream = stream
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._print()

    def _run(self) -> None:
        while not self._over.wait(_LINE_INTERVAL_S):
            self._print()

    def _print(self) -> None:
        print(summary_line(self._monitor), file=self._stream, flush=True)


class _Screen:
    """Gives rich the present table each time it redraws."""

    def __init__(self, monitor: SweepMonitor) -> None:
        self._monitor = monitor

    def __rich__(self) -> RenderableType:
        return render(self._monitor)


@contextlib.contextmanager
def shown(monitor: SweepMonitor, progress: str, log: Path, notes: Sequence[str] = ()) -> Iterator[None]:
    """Show a sweep on standard error while the block runs; what libraries print there goes to a file instead.

    Args:
        monitor: The monitor of the sweep to show.
        progress: `auto`: a table on a terminal, else lines; `none`: nothing.
        log: File for everything else that this process prints.
        notes: Notes of the plan, which are shown first.
    """
    with quiet(log) as stream:
        if progress != "none":
            for note in notes:
                print(f"note: {note}", file=stream, flush=True)
        if progress == "none":
            yield
        elif stream.isatty() and not _shares_terminal:
            console = Console(file=stream)
            with Live(_Screen(monitor), console=console, refresh_per_second=_REFRESH_PER_S):
                yield
        else:
            with _Lines(monitor, stream):
                yield
