"""What a person sees of a running sweep, on a terminal of known width and without one."""

import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import pytest
import test_monitor
from fake_engine import FakeClock
from rich.console import Console
from test_monitor import make_monitor, make_trial

from tune_jobs.sweeps import live_table as live
from tune_jobs.sweeps.monitor import SweepMonitor


def screen(monitor: SweepMonitor, width: int = 120) -> str:
    """The table as text."""
    console = Console(file=io.StringIO(), width=width, color_system=None, force_terminal=True, legacy_windows=False)
    console.print(live.render(monitor))
    return cast("str", cast("Any", console.file).getvalue())


@pytest.fixture
def running() -> tuple[SweepMonitor, FakeClock]:
    """(monitor, its clock): one trial of six is done, one has failed, two run."""
    clock = FakeClock()
    monitor = make_monitor(*(make_trial(index) for index in range(6)), clock=clock, cap=50_000)
    monitor.update(make_trial(2, "running"))
    clock.now += 10.0
    monitor.update(make_trial(0, "completed", steps=50_000, score=195.25, time_s=10.0))
    clock.now += 65.0
    monitor.update(make_trial(1, "failed", steps=10))
    first = make_trial(2, "running", steps=12_345, score=20.0, time_s=5.0)
    monitor.update(first.model_copy(update={"training_return": 33.04, "evaluation_return": -1.5}))
    monitor.update(make_trial(3, "running"))
    return monitor, clock


def test_the_table_tells_how_far_it_is_what_is_best_and_what_runs(running: tuple[SweepMonitor, FakeClock]) -> None:
    text = screen(running[0])
    lines = text.splitlines()
    assert "mine" in lines[0]
    assert "2 of 6 trials" in lines[0]
    for word in ("2 running", "1 completed", "1 failed", "2 pending"):
        assert word in lines[0]
    assert "stopped" not in text  # what there is none of
    best = next(line for line in lines if line.startswith("best so far"))
    assert "195.2" in best
    assert "lr 0.001" in best
    assert "t0000, at 50,000 env steps" in best
    assert "62,355 env steps in all" in text
    assert "1 min 15 s" in text
    assert "left: about" in text
    first = next(line for line in lines if line.startswith("t0002"))
    assert first.split() == ["t0002", "lr", "0.003", "12,345", "33.0", "-1.5", "2,469"]
    second = next(line for line in lines if line.startswith("t0003"))
    assert second.split() == ["t0003", "lr", "0.004", "0", "-", "-"]
    assert not any(line.startswith(("t0000", "t0001", "t0004")) for line in lines)


def test_before_the_first_score_and_rate_it_says_so() -> None:
    text = screen(make_monitor(make_trial(0)))
    assert "no evaluation yet" in text
    assert "0 of 1 trials" in text
    assert "left: about ?" in text


def test_many_running_trials_do_not_fill_the_screen() -> None:
    monitor = make_monitor(*(make_trial(index) for index in range(40)))
    for index in range(30):
        monitor.update(make_trial(index, "running"))
    text = screen(monitor)
    assert "and 18 more" in text
    assert sum(line.startswith("t00") for line in text.splitlines()) == 12


def test_who_stops_it_is_told_what_happens(running: tuple[SweepMonitor, FakeClock]) -> None:
    monitor, _ = running
    assert "Ctrl-C again" not in screen(monitor)
    monitor.stopping = True
    assert "Stopping: the running trials save a checkpoint. Ctrl-C again ends them now." in screen(monitor)


def test_a_narrow_terminal_still_shows_the_numbers(running: tuple[SweepMonitor, FakeClock]) -> None:
    text = screen(running[0], width=80)
    assert all(len(line) <= 80 for line in text.splitlines())
    assert "12,345" in text
    assert "195.2" in text


def test_values_are_no_markup() -> None:
    """A list among the values looks like rich's markup."""
    trial = make_trial(0, "running", score=1.0, steps=5)
    trial = trial.model_copy(update={"point": {"hidden_sizes": [64, 32], "activation": "[red]"}})
    monitor = make_monitor(trial)
    monitor.update(trial.model_copy(update={"status": "completed"}))
    assert "hidden_sizes 64x32, activation [red]" in screen(monitor)


def test_a_point_without_values_is_named() -> None:
    assert live.describe_point(make_trial(0).model_copy(update={"point": {}})) == "no searched values"


def test_a_line_for_logs_tells_the_same(running: tuple[SweepMonitor, FakeClock]) -> None:
    line = live.summary_line(running[0])
    assert "\n" not in line
    words = ("mine: 1 min 15 s", "2 running", "1 failed", "62,355 env steps", "best 195.2 (t0000: lr 0.001)", "left")
    for word in words:
        assert word in line
    line = live.summary_line(make_monitor(make_trial(0)))
    assert "best" not in line
    assert "left" not in line


# What happens to the real streams has to be seen from outside of the process.
PROGRAM = """
import os, sys
sys.path.insert(0, {here!r})
from pathlib import Path
from test_monitor import make_monitor, make_trial
from tune_jobs.sweeps.live_table import shown
with shown(make_monitor(make_trial(0)), {progress!r}, Path({log!r})):
    print("printed by a library")
    print("a library's warning", file=sys.stderr)
    os.write(2, b"from C++")
print("done")
"""


@pytest.mark.parametrize(("progress", "lines"), [("auto", 1), ("none", 0)])
def test_nothing_else_is_on_the_terminal(tmp_path: Path, progress: str, lines: int) -> None:
    log = tmp_path / "driver.log"
    code = PROGRAM.format(here=os.path.dirname(test_monitor.__file__), progress=progress, log=str(log))  # noqa: PTH120
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "done\n"
    # Without a terminal, a line at the end (and now and then); results are for standard output, so not there.
    assert len(done.stderr.splitlines()) == lines
    assert all(line.startswith("mine: ") for line in done.stderr.splitlines())
    logged = log.read_text()
    for text in ("printed by a library", "a library's warning", "from C++"):
        assert text in logged


@pytest.mark.parametrize(("progress", "first"), [("auto", "note: one\nnote: two\nmine: "), ("none", "")])
def test_the_plans_notes_come_first(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], progress: str, first: str
) -> None:
    with live.shown(make_monitor(make_trial(0)), progress, tmp_path / "driver.log", ["one", "two"]):
        pass
    assert capfd.readouterr().err.startswith(first)
    assert progress == "auto" or not capfd.readouterr().err


def test_streams_come_back_after_an_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        with live.shown(make_monitor(make_trial(0)), "none", tmp_path / "driver.log"):
            os.write(1, b"hidden")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    os.write(1, b"seen")
    assert capfd.readouterr().out == "seen"
