"""What a person sees of a running sweep, on a terminal of known width and without one."""

import contextlib
import io
import os
import pty
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, cast

import pytest
import test_monitor
from fake_engine import FakeClock
from rich.console import Console
from test_monitor import make_monitor, make_trial

from tests.terminals import read_to_the_end
from tune_jobs.sweeps import live_table as live
from tune_jobs.sweeps import live_view
from tune_jobs.sweeps.monitor import SweepMonitor


def screen(monitor: SweepMonitor, width: int = 120, height: int | None = None) -> str:
    """The table as text."""
    console = Console(file=io.StringIO(), width=width, color_system=None, force_terminal=True, legacy_windows=False)
    console.print(live.render(monitor, width, height))
    return cast("str", cast("Any", console.file).getvalue())


def rows(text: str) -> list[list[str]]:
    """The rows of trials, each as its words."""
    return [words for words in map(str.split, text.splitlines()) if len(words) > 1 and words[1].startswith("t0")]


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
    text = screen(running[0], 140)
    lines = text.splitlines()
    # Of 50,000 and 10 env steps that ended trials took, and 50,000 of each of the other four.
    assert lines[0].split()[0] == "mine"
    assert lines[0].split()[-2:] == ["24", "%"]
    assert lines[1].split("   ")[-1].strip() == "2 running  1 completed  1 failed  2 pending"
    assert "2 of 6 ended" in lines[1]
    assert "stopped" not in text  # what there is none of
    assert "62,355 of at most 250,010" in lines[2]
    assert "1 min 15 s" in lines[3]
    assert "left: about" in lines[3]
    assert lines[4].rstrip().split("  ")[-2:] == ["lr 0.001", "(t0000, at 50,000 env steps)"]
    assert re.split("  +", lines[5].strip()) == [
        "rank", "trial", "score", "status", "env steps", "lr", "training", "evaluation", "env steps/s",
    ]  # fmt: skip
    assert rows(text) == [
        ["1", "t0000", "195.2", "completed", "50,000", "0.001", "-", "-"],
        ["2", "t0002", "20.0", "running", "12,345", "0.003", "33.0", "-1.500", "2,469"],
        ["-", "t0003", "-", "running", "0", "0.004", "-", "-"],
    ]


def test_the_bar_moves_by_env_steps() -> None:
    monitor = make_monitor(make_trial(0), make_trial(1), cap=1_000)
    filled = [screen(monitor).splitlines()[0]]
    for steps in (400, 800):
        monitor.update(make_trial(0, "running", steps=steps))
        filled.append(screen(monitor).splitlines()[0])
    assert [line.split()[-2] for line in filled] == ["0", "20", "40"]
    lengths = [line.count("━") for line in filled]
    assert lengths[0] == 0 < lengths[1] < lengths[2]


def test_before_the_first_score_and_rate_it_says_so() -> None:
    text = screen(make_monitor(make_trial(0)))
    assert "no evaluation yet" in text
    assert "0 of 1 ended" in text
    assert "left: not known yet" in text


def test_what_is_done_before_the_trials_train_is_shown_until_the_first_runs() -> None:
    monitor = make_monitor(make_trial(0))
    monitor.phase = "starting Ray"
    assert "starting Ray ..." in screen(monitor)
    assert live.summary_line(monitor) == "mine: 0 s; starting Ray"
    monitor.update(make_trial(0, "pending"))
    assert "starting Ray" in screen(monitor)
    monitor.update(make_trial(0, "running"))
    assert "starting Ray" not in screen(monitor)
    assert "1 running" in live.summary_line(monitor)


def test_the_leader_is_shown_however_many_run() -> None:
    """It ended long ago, and is the last one; of those that run, the best ones are shown."""
    monitor = make_monitor(*(make_trial(index) for index in range(40)))
    monitor.update(make_trial(39, "completed", steps=900, score=99.0))
    monitor.update(make_trial(38, "completed", steps=900, score=98.0))
    for index in range(30):
        monitor.update(make_trial(index, "running", steps=10, score=float(index)))
    text = screen(monitor)
    assert [row[1] for row in rows(text)] == ["t0039", *(f"t{index:04d}" for index in range(29, 18, -1))]
    assert [row[0] for row in rows(text)] == ["1", *map(str, range(3, 14))]
    assert "and 19 more running" in text


def test_a_low_terminal_shows_fewer_trials_and_still_the_leader() -> None:
    monitor = make_monitor(*(make_trial(index) for index in range(40)))
    for index in range(30):
        monitor.update(make_trial(index, "running", steps=10, score=float(index)))
    for height in range(3, 30):
        text = screen(monitor, height=height)
        assert rows(text)[0][1] == "t0029"
        assert len(text.splitlines()) <= max(height, 8)


def test_when_few_run_the_best_of_the_others_are_shown_by_rank() -> None:
    monitor = make_monitor(*(make_trial(index) for index in range(20)))
    for index in range(18):
        monitor.update(make_trial(index, "completed", steps=10, score=float(index)))
    monitor.update(make_trial(18, "running", steps=10, score=-7.0))
    monitor.update(make_trial(19, "running", steps=5))
    assert [row[1] for row in rows(screen(monitor))] == [
        *(f"t{index:04d}" for index in range(17, 7, -1)), "t0018", "t0019",
    ]  # fmt: skip


def test_trials_of_one_point_have_its_rank_and_the_leader_is_of_the_best_point() -> None:
    monitor = make_monitor(*(make_trial(index, point_index=index // 2) for index in range(4)))
    for index, score in enumerate([100.0, 0.0, 60.0, 70.0]):
        monitor.update(make_trial(index, "completed", steps=10, score=score, point_index=index // 2))
    assert [row[:3] for row in rows(screen(monitor))] == [
        ["1", "t0003", "70.0"], ["1", "t0002", "60.0"], ["2", "t0000", "100.0"], ["2", "t0001", "0.0"],
    ]  # fmt: skip


@pytest.mark.parametrize("width", [40, 60, 80, 100, 140, 200])
def test_ids_and_scores_are_whole_on_every_terminal(running: tuple[SweepMonitor, FakeClock], width: int) -> None:
    text = screen(running[0], width)
    assert all(len(line) <= width for line in text.splitlines())
    assert [row[1:3] for row in rows(text)] == [["t0000", "195.2"], ["t0002", "20.0"], ["t0003", "-"]]
    assert "…" not in text


def test_values_have_three_digits_and_those_that_differ_come_first() -> None:
    points = [{"gamma": 0.99, "lr": 0.00123456 * (1 + index), "hidden_sizes": [64, 32]} for index in range(2)]
    trials = [
        make_trial(index, "running", steps=5, score=1.0).model_copy(update={"point": point})
        for index, point in enumerate(points)
    ]
    text = screen(make_monitor(*trials), 80)
    assert ["rank", "trial", "score", "status", "env", "steps", "lr", "gamma", "hidden_sizes"] in [
        line.split() for line in text.splitlines()
    ]
    assert [row[4:] for row in rows(text)] == [["5", "0.00123", "0.99", "64x32"], ["5", "0.00247", "0.99", "64x32"]]
    assert "lr 0.00123, hidden_sizes 64x32" in text.replace("gamma 0.99, ", "")


def test_who_stops_it_is_told_what_happens(running: tuple[SweepMonitor, FakeClock]) -> None:
    monitor, _ = running
    assert "Ctrl-C again" not in screen(monitor)
    monitor.stopping = True
    assert "Stopping: the running trials save a checkpoint. Ctrl-C again ends them now." in screen(monitor)


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
    words = (
        "mine: 1 min 15 s; 24 %, 62,355 env steps;", "2 running", "1 failed", "best 195.2 (t0000: lr 0.001)", "left",
    )  # fmt: skip
    for word in words:
        assert word in line
    line = live.summary_line(make_monitor(make_trial(0)))
    assert "best" not in line
    assert "left" not in line


def test_a_line_stays_short_however_many_values_there_are() -> None:
    point = {f"hyperparameter_{number}": 0.123456 for number in range(20)}
    trial = make_trial(0, "running", steps=5, score=1.0).model_copy(update={"point": point})
    line = live.summary_line(make_monitor(trial))
    assert "hyperparameter_0 0.123, hyperparameter_1 0.123, ..." in line
    assert len(line) < 160


# What happens to the real streams has to be seen from outside of the process.
PROGRAM = """
import os, sys
sys.path.insert(0, {here!r})
from pathlib import Path
from test_monitor import make_monitor, make_trial
from tune_jobs.sweeps.live_view import shown
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
    with live_view.shown(make_monitor(make_trial(0)), progress, tmp_path / "driver.log", ["one", "two"]):
        pass
    shown = capfd.readouterr().err
    assert shown.startswith(first)
    assert progress == "auto" or not shown


def test_streams_come_back_after_an_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        with live_view.shown(make_monitor(make_trial(0)), "none", tmp_path / "driver.log"):
            os.write(1, b"hidden")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    os.write(1, b"seen")
    assert capfd.readouterr().out == "seen"


def test_what_is_left_on_the_screen_is_no_phase(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    monitor = make_monitor(make_trial(0))
    with live_view.shown(monitor, "auto", tmp_path / "driver.log"):
        monitor.phase = "ending Ray"
    assert capfd.readouterr().err == "mine: 0 s; 0 %, 0 env steps; 1 pending\n"


FINISHING = """
import sys, time
from tune_jobs.sweeps import live_view
live_view._LINE_INTERVAL_S = float(sys.argv[1])
with live_view.working("mine", "filming the best policy", sys.argv[2]):
    print("a warning", file=sys.stderr, flush=True)
    for _ in sys.stdin:
        pass
"""


def finishing(interval: str, progress: str, stderr: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", FINISHING, interval, progress], stdin=subprocess.PIPE, stderr=stderr,
        start_new_session=True,
    )  # fmt: skip


@pytest.mark.parametrize("progress", ["auto", "none"])
def test_without_a_terminal_finishing_is_told_only_if_it_takes_long(progress: str) -> None:
    with finishing("1000", progress, subprocess.PIPE) as process:
        assert process.communicate()[1] == b"a warning\n"


def test_without_a_terminal_finishing_that_takes_long_is_told_in_lines() -> None:
    with finishing("0.05", "auto", subprocess.PIPE) as process:
        assert process.stderr is not None
        lines = [process.stderr.readline().decode() for _ in range(3)]
        process.communicate()
    assert lines.pop(lines.index("a warning\n"))
    assert len(lines) == 2
    assert all(re.fullmatch(r"mine: filming the best policy, \d+ s\n", line) for line in lines), lines


def test_on_a_terminal_finishing_is_shown_and_leaves_nothing() -> None:
    ours, theirs = pty.openpty()
    with finishing("1000", "auto", theirs) as process:
        os.close(theirs)
        seen = b""
        while b"filming the best policy ..." not in seen or b"a warning" not in seen:
            seen += os.read(ours, 1_000)
        assert process.stdin is not None
        process.stdin.close()
        rest = read_to_the_end(ours)
    os.close(ours)
    assert process.returncode == 0
    # The line is deleted at the end, and the cursor is shown again.
    assert rest.rfind(b"\x1b[2K") > rest.rfind(b"filming")
    assert rest.rfind(b"\x1b[?25h") >= 0


SAYING = """
import sys
from tune_jobs.sweeps import live_view
live_view._LINE_INTERVAL_S = 0.05
with live_view.working("mine", "choosing the best policy", "auto") as say:
    for line in sys.stdin:
        say(line.strip())
"""


@pytest.mark.parametrize("on_terminal", [False, True])
def test_what_finishing_does_now_takes_the_place_of_what_it_did(*, on_terminal: bool) -> None:
    ours, theirs = pty.openpty() if on_terminal else os.pipe()
    command = [sys.executable, "-c", SAYING]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=theirs, start_new_session=True) as process:
        os.close(theirs)
        assert process.stdin is not None
        seen, until = b"", time.monotonic() + 60
        while b"mine: choosing the best policy" not in seen and time.monotonic() < until:
            seen += os.read(ours, 1_000)
        process.stdin.write(b"confirming the best policy: episode 3 of 100\n")
        process.stdin.flush()
        while b"mine: confirming the best policy: episode 3 of 100" not in seen and time.monotonic() < until:
            seen += os.read(ours, 1_000)
        process.stdin.close()
        seen += read_to_the_end(ours)
    os.close(ours)
    assert process.returncode == 0
    assert -1 < seen.rfind(b"choosing") < seen.find(b"confirming")


def test_on_a_terminal_a_name_with_brackets_is_shown_as_it_is() -> None:
    ours, theirs = pty.openpty()
    code = FINISHING.replace('"mine"', '"./of [/b] [red]mine"')
    command = [sys.executable, "-c", code, "1000", "auto"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=theirs, start_new_session=True) as process:
        os.close(theirs)
        seen, until = b"", time.monotonic() + 60
        with contextlib.suppress(OSError):  # the terminal's end, on Linux
            while b"./of [/b] [red]mine: filming" not in seen and time.monotonic() < until:
                seen += os.read(ours, 1_000)
        assert process.stdin is not None
        process.stdin.close()
    os.close(ours)
    assert process.returncode == 0
    assert b"./of [/b] [red]mine: filming" in seen
