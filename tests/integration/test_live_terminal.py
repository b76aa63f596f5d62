"""What is on a terminal while a sweep runs: of any height, one that can't redraw, and when Ctrl-C has come."""

import io
import os
import pty
import re
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest
import test_monitor
from rich.console import Console
from test_monitor import make_monitor, make_trial

from tests.terminals import read_to_the_end
from tune_jobs.sweeps import live_table, live_view
from tune_jobs.sweeps.monitor import SweepMonitor

STOPPING = "Stopping: the running trials save a checkpoint. Ctrl-C again ends them now."
CONTROLS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def many(num_values: int) -> SweepMonitor:
    """Sixteen of forty trials run, of points with so many values."""
    point = {f"hyperparameter_{number}": 0.000123456 * (number + 1) for number in range(num_values)}
    trials = [make_trial(index).model_copy(update={"point": point}) for index in range(40)]
    monitor = make_monitor(*trials, cap=100_000)
    for index, status in enumerate(["completed"] * 8 + ["stopped"] * 4 + ["failed"] + ["running"] * 16):
        ran = make_trial(index, status, steps=50_000, score=float(index))
        monitor.update(ran.model_copy(update={"point": point}))
    return monitor


def drawn(monitor: SweepMonitor, width: int, height: int) -> str:
    console = Console(file=io.StringIO(), width=width, color_system=None, force_terminal=True, legacy_windows=False)
    console.print(live_table.render(monitor, width, height))
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


@pytest.mark.parametrize("num_values", [1, 5, 12])
@pytest.mark.parametrize(("width", "height"), [(80, 16), (80, 20), (80, 24), (100, 24), (60, 30)])
def test_the_table_fits_a_terminal_and_says_first_that_it_stops(num_values: int, width: int, height: int) -> None:
    monitor = many(num_values)
    monitor.stopping = True
    lines = drawn(monitor, width, height).splitlines()
    assert STOPPING.startswith(lines[1].strip())
    assert "Ctrl-C again ends them now." in " ".join(lines[1:3])
    # The point alone may have as many lines.
    assert len(lines) < height or num_values == 12


def test_a_line_says_that_it_stops_in_place_of_how_long_it_takes() -> None:
    monitor = make_monitor(make_trial(0))
    monitor.phase = "starting Ray"
    monitor.stopping = True
    assert live_table.summary_line(monitor) == "mine: 0 s; starting Ray; stopping"
    monitor.update(make_trial(0, "running", steps=5, time_s=1.0))
    line = live_table.summary_line(monitor)
    assert line.endswith(f"; {STOPPING[0].lower()}{STOPPING[1:]}")
    assert "left" not in line


def test_a_log_has_that_line_at_once() -> None:
    monitor, stream = make_monitor(make_trial(0)), io.StringIO()
    assert live_view._LINE_INTERVAL_S > 5
    with live_view._view(monitor, stream):
        monitor.stopping = True
        until = time.monotonic() + 5
        while not stream.getvalue() and time.monotonic() < until:
            time.sleep(0.05)
        assert "stopping: the running" in stream.getvalue()


def test_what_is_left_on_the_screen_does_not_stop_any_more(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    monitor = make_monitor(make_trial(0), make_trial(1))
    with live_view.shown(monitor, "auto", tmp_path / "driver.log"):
        monitor.update(make_trial(0, "running", steps=5, time_s=1.0))
        monitor.stopping = True
    left = capfd.readouterr().err.splitlines()[-1]
    assert left.endswith("; 1 pending, 1 running")
    assert "Stopping" not in drawn(monitor, 80, 24)
    assert "left" not in drawn(monitor, 80, 24)


# It prints as libraries do, on both levels, and waits until its standard input ends.
PROGRAM = f"""
import os, sys
sys.path.insert(0, {os.path.dirname(test_monitor.__file__)!r})
from pathlib import Path
from test_monitor import make_monitor, make_trial
from tune_jobs.sweeps import live_view
live_view._LINE_INTERVAL_S = 0.1
with live_view.shown(make_monitor(make_trial(0)), "auto", Path(sys.argv[1])):
    print("a library")
    print("a warning", file=sys.stderr)
    os.write(2, b"from C++")
    sys.stdin.read()
"""  # noqa: PTH120


def begun(log: Path, **environment: str) -> tuple[subprocess.Popen[bytes], int, bytes]:
    """(the process, its terminal, what was on that until the sweep was shown)."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(log)], stdin=subprocess.PIPE, stdout=theirs, stderr=theirs,
        env={**os.environ, "TERM": "xterm", **environment}, start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    seen = b""
    while b"pending" not in seen and select.select([ours], [], [], 30)[0]:
        seen += os.read(ours, 1_000)
    return process, ours, seen


def rest(process: subprocess.Popen[bytes], terminal: int) -> bytes:
    """What is on the terminal until the process has ended."""
    assert process.stdin is not None
    process.stdin.close()
    seen = read_to_the_end(terminal)
    os.close(terminal)
    assert process.wait(60) == 0
    return seen


def test_on_a_terminal_too_what_libraries_print_is_in_the_log(tmp_path: Path) -> None:
    process, terminal, seen = begun(tmp_path / "driver.log")
    shown = CONTROLS.sub("", (seen + rest(process, terminal)).decode())
    assert "best so far" in shown
    logged = (tmp_path / "driver.log").read_text()
    for text in ("a library", "a warning", "from C++"):
        assert text in logged
        assert text not in shown


@pytest.mark.parametrize("environment", [{"TERM": "dumb"}, {"TTY_COMPATIBLE": "0"}, {"FORCE_COLOR": ""}])
def test_a_terminal_that_cannot_redraw_gets_lines(tmp_path: Path, environment: dict[str, str]) -> None:
    process, terminal, seen = begun(tmp_path / "driver.log", **environment)
    # While it runs, not only at its end.
    assert seen.startswith(b"mine: 0 s; 0 %, 0 env steps; 1 pending")
    assert b"best so far" not in rest(process, terminal)


def test_between_two_frames_the_cursor_is_shown(tmp_path: Path) -> None:
    """Ctrl-Z and a kill leave it so, and a shell shows none by itself."""
    process, terminal, seen = begun(tmp_path / "driver.log")
    frames = (seen + rest(process, terminal)).decode().split("pending")
    assert len(frames) > 2
    for frame in frames[1:]:
        assert "\x1b[?25h" in frame
