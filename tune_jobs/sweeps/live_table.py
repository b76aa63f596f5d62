"""Draw a running sweep: as a table for a terminal, or in one line."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from analysis.points import searched_names, value_text
from analysis.records import FINISHED, TrialRecord, TrialStatus
from analysis.selection import Selection
from analysis.tables import shown_point
from analysis.wording import PLAIN_NONE, counted, duration, return_text, short_text
from tune_jobs.sweeps.columns import fit
from tune_jobs.sweeps.fitting_console import FittingConsole
from tune_jobs.sweeps.monitor import Row, SweepMonitor

STATUS_STYLES: dict[TrialStatus, str] = {
    "running": "bold cyan", "completed": "green", "stopped": "yellow", "failed": "bold red", "paused": "magenta",
    "pending": "dim",
}  # fmt: skip
_MAX_ROWS = 12
_ROOM_FOR_OTHERS = 3
"""Lines of a terminal that are neither for trials nor above their table: its titles, and what follows."""
_GAP = 2
_STOPPING = "the running trials save a checkpoint. Ctrl-C again ends them now."
_WAITS = "no trial runs: waiting for a node that has room for one"
_MAX_MEASURED = 200
_MAX_POINT = 300


def describe_point(record: TrialRecord, most: int | None = None) -> str:
    """Describe the sampled values that a trial's score was reached with in one line.

    Args:
        record: The trial.
        most: About how many characters it may have; None: all values are named.
    """
    if not record.has_point:
        return "chosen at its start"
    text = ""
    for name, value in shown_point(record).items():
        more = f"{text}{', ' if text else ''}{name} {short_text(value)}"
        if most is not None and len(more) > most:
            return f"{text}, ..." if text else f"{more[:most]} ..."
        text = more
    return text or "no searched values"


def render(monitor: SweepMonitor, width: int = 120, height: int | None = None) -> RenderableType:
    """Return the live table of a sweep.

    Args:
        monitor: The sweep.
        width: Characters of a line; of trials, as many columns are shown as fit.
        height: Lines of the terminal; None: any number.
    """
    monitor.look()
    parts: list[RenderableType] = [_head(monitor, width)]
    if monitor.stopping:
        # First, as the end is cut where a terminal is too low: who sees nothing presses Ctrl-C again.
        parts.append(Text(f"Stopping: {_STOPPING}", "yellow"))
    parts.append(_facts(monitor))
    most = _MAX_ROWS
    if height is not None:
        most = max(1, min(most, height - _num_lines(Group(*parts), width) - _ROOM_FOR_OTHERS))
    rows, left_out = monitor.rows(most)
    if rows:
        parts.append(_trials(monitor, rows, width))
    if left_out:
        parts.append(Text(f"and {left_out:,} more running", "dim"))
    return Group(*parts)


def _num_lines(what: RenderableType, width: int) -> int:
    """Return how many lines something has on a terminal, where it is wrapped."""
    console = FittingConsole(file=io.StringIO(), width=width)
    return len(console.render_lines(what, pad=False))


def _head(monitor: SweepMonitor, width: int) -> RenderableType:
    progress = monitor.progress()
    head = Table.grid(padding=(0, 2))
    head.add_column(no_wrap=True)
    head.add_column()
    head.add_column(no_wrap=True)
    total = max(1, progress.max_env_steps)
    head.add_row(
        Text(monitor.title, style="bold"),
        ProgressBar(total=total, completed=progress.num_env_steps, width=max(8, min(40, width // 3))),
        f"{100 * progress.num_env_steps // total} %",
    )
    return head


def _facts(monitor: SweepMonitor) -> RenderableType:
    speed = monitor.env_steps_per_s()
    progress = monitor.progress()
    grid = Table.grid(padding=(0, 2))
    counts = monitor.counts()
    ended = sum(count for status, count in counts.items() if status in FINISHED)
    grid.add_row(
        "trials", Text(f"{ended:,} of {len(monitor.records):,} ended   ").append_text(_status_line(monitor, counts))
    )
    steps = f"{progress.num_env_steps:,}"
    if progress.num_env_steps < progress.max_env_steps:
        steps += f" of at most {progress.max_env_steps:,}"
    rate = "" if speed is None else f"   {speed:,.0f} a second"
    grid.add_row("env steps", f"{steps}{rate}")
    time = Text(duration(monitor.elapsed_s, tenths=False))
    if monitor.phase:
        time.append(f"   {monitor.phase} ...", "cyan")
    elif monitor.waits:
        time.append(f"   {_WAITS} ...", "cyan")
    else:
        time.append(_time_left(monitor))
    grid.add_row("time", time)
    grid.add_row("best so far", _best_text(monitor.best()))
    return grid


def _time_left(monitor: SweepMonitor) -> str:
    if monitor.stopping or monitor.is_over:
        return ""
    if all(record.status in FINISHED for record in list(monitor.records.values())):
        return ""
    seconds = monitor.progress().time_left_s
    if seconds is None:
        return "   left: not known yet"
    return f"   left: about {duration(seconds, tenths=False, none=PLAIN_NONE)}"


def _told(monitor: SweepMonitor, status: TrialStatus, count: str) -> str:
    """Return how many trials have a status, as words: "2 running (1 evaluating)"."""
    evaluating = monitor.num_evaluating if status == "running" else 0
    return f"{count} {status}{f' ({evaluating:,} evaluating)' if evaluating else ''}"


def _status_line(monitor: SweepMonitor, counts: dict[TrialStatus, int]) -> Text:
    words = [
        Text(_told(monitor, status, f"{counts[status]:,}"), style=style)
        for status, style in STATUS_STYLES.items()
        if counts.get(status)
    ]
    return Text("  ").join(words)


def _best_text(best: Selection | None) -> Text:
    if best is None:
        return Text("no evaluation yet", style="dim")
    where = f"{best.trial.trial_id}, at {best.checkpoint.num_env_steps:,} env steps"
    # The rest has no style of its own: in a notebook the style "default" is black, on a dark page too.
    return Text.assemble(
        (return_text(best.point_score), "bold green"), f"  {describe_point(best.trial, _MAX_POINT)}  ({where})"
    )


def _trials(monitor: SweepMonitor, rows: Sequence[Row], width: int) -> Table:
    """Return the table of some trials, with as many columns as fit, the most important ones first."""
    # One width for the whole run, or columns would come and go while numbers grow.
    measured = [row.trial for row in rows]
    measured += itertools.islice(list(monitor.records.values()), _MAX_MEASURED)
    texts = [{name: short_text(value) for name, value in shown_point(trial).items()} for trial in measured]
    names = searched_names(texts)
    names.sort(key=lambda name: len({values.get(name) for values in texts}) == 1)
    titles = ["rank", "trial", "score", "status", "env steps", *names, "training", "evaluation", "env steps/s"]
    most_steps = f"{monitor.progress().max_env_steps // max(1, len(monitor.records)):,}"
    widest = [
        ["", "", "-100.0", "completed", most_steps, *(values.get(name, "") for name in names), "-100.0", "", ""]
        for values in texts
    ]
    cells = [_cells(row, names) for row in rows]
    fitting = fit(titles, [*cells, *widest], width, gap=_GAP, num_always=3)
    table = Table(box=None, padding=(0, _GAP, 0, 0), pad_edge=False, header_style="dim", show_edge=False)
    for position in fitting.shown:
        is_text = titles[position] in ("trial", "status", *names)
        table.add_column(titles[position], justify="left" if is_text else "right", no_wrap=True)
    for row, texts_of_row in zip(rows, cells, strict=True):
        style = "bold" if row is rows[0] and row.rank == 1 else ""
        styles = ["", "", "", STATUS_STYLES[row.trial.status], *[""] * len(titles)]
        # Passed as Text, because rich would read brackets as a style.
        shown = (Text(texts_of_row[position], style=styles[position]) for position in fitting.shown)
        table.add_row(*shown, style=style)
    return table


def _cells(row: Row, names: Sequence[str]) -> list[str]:
    trial = row.trial
    speed = trial.num_env_steps / trial.time_s if trial.status == "running" and trial.time_s else None
    point = shown_point(trial) if trial.has_point else {}
    return [
        PLAIN_NONE if row.rank is None else str(row.rank),
        trial.trial_id,
        return_text(row.score, none=PLAIN_NONE),
        trial.status,
        f"{trial.num_env_steps:,}",
        *(value_text(point, name, short_text) for name in names),
        return_text(trial.training_return, none=PLAIN_NONE),
        return_text(trial.evaluation_return, none=PLAIN_NONE),
        "" if speed is None else f"{speed:,.0f}",
    ]


def summary_line(monitor: SweepMonitor) -> str:
    """Describe the state of a sweep in one short line, for logs."""
    monitor.look()
    elapsed = f"{monitor.title}: {duration(monitor.elapsed_s, tenths=False)}"
    if monitor.phase:
        return f"{elapsed}; {monitor.phase}{'; stopping' if monitor.stopping else ''}"
    progress = monitor.progress()
    share = 100 * progress.num_env_steps // max(1, progress.max_env_steps)
    words = [
        elapsed,
        f"{share} %, {counted(progress.num_env_steps, 'env step')}",
        ", ".join(_told(monitor, status, str(count)) for status, count in sorted(monitor.counts().items())),
    ]
    if monitor.waits:
        words.append(_WAITS)
    best = monitor.best()
    if best is not None:
        words.append(f"best {return_text(best.point_score)} ({best.trial.trial_id}: {describe_point(best.trial, 60)})")
    seconds = progress.time_left_s
    if monitor.stopping:
        words.append(f"stopping: {_STOPPING}")
    elif seconds and not monitor.is_over:
        words.append(f"about {duration(seconds, tenths=False, none=PLAIN_NONE)} left")
    return "; ".join(words)
