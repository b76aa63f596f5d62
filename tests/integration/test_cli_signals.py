"""Commands that run no trials end in order too: what they had begun to write is removed."""

import os
import pty
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from signal import Signals
from typing import TextIO

import pytest

# A command that begins a film and is sent a signal in the middle; its last argument is its folder.
SCRIPT = """
import os, sys
from pathlib import Path
from policies.files import atomic_path
from tune_jobs.cli import commands as cli
from tune_jobs.sweeps import verbs as sweeps

def video(*_, **__):
    with atomic_path(Path(sys.argv[-1], "film.mp4")) as half:
        half.write_text("half")
        os.kill(os.getpid(), int(os.environ["NUMBER"]))
        half.write_text("whole")
    return {}

sweeps.video = video
cli.main()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_nothing_half_made(tmp_path: Path, number: Signals) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, "video", "random", "--env", "CartPole-v1", "--output", str(tmp_path)],
        env={**os.environ, "NUMBER": str(int(number))}, stdin=subprocess.DEVNULL, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 130, done.stderr
    assert done.stderr == "error: Interrupted.\n"
    assert list(tmp_path.iterdir()) == []


def test_nohup_means_it(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, "video", "random", "--env", "CartPole-v1", "--output", str(tmp_path)],
        env={**os.environ, "NUMBER": str(int(signal.SIGHUP))}, capture_output=True, text=True, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [path.read_text() for path in tmp_path.iterdir()] == ["whole"]


# As the one above, ended by two hangups: one to the process, one to its group.
TWICE = """
import os, signal, sys
from pathlib import Path
from tune_jobs.cli import commands as cli
from tune_jobs.sweeps import verbs as sweeps

def video(*_, **__):
    path = Path(sys.argv[-1], "half.mp4")
    path.write_text("half")
    try:
        os.kill(os.getpid(), signal.SIGHUP)
    finally:
        os.kill(os.getpid(), signal.SIGHUP)
        path.unlink()

sweeps.video = video
cli.main()
"""


def test_two_hangups_are_one(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", TWICE, "video", "random", "--env", "CartPole-v1", "--output", str(tmp_path)],
        capture_output=True, text=True, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (130, "error: Interrupted.\n")
    assert list(tmp_path.iterdir()) == []


# As the first one, by the script's own function; there is something to do at its end.
AT_TERMINAL = f"""
import atexit, os
atexit.register(os.write, 2, b"At its end.\\n")
{SCRIPT.replace("cli.main()", "")}
from tune_jobs.cli.__main__ import main
main()
"""
# As the first one, in a program that goes on.
GOES_ON = f"""
try:
    {SCRIPT.strip().replace(chr(10), chr(10) + "    ")}
except SystemExit as end:
    print("ended with", end.code)
"""


def at_terminal(
    script: str, number: Signals, folder: Path, before: Callable[[], None] | None = None
) -> subprocess.CompletedProcess[str]:
    ours, theirs = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-c", script, "video", "random", "--env", "CartPole-v1", "--output", str(folder)],
        env={**os.environ, "NUMBER": str(int(number))}, stdin=theirs, capture_output=True, text=True, check=False,
        preexec_fn=before,
    )  # fmt: skip
    os.close(ours)
    os.close(theirs)
    return done


@pytest.mark.parametrize("before", [None, lambda: os.close(1)], ids=["all open", "standard output closed"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, -signal.SIGINT), (signal.SIGTERM, 130)])
def test_at_a_terminal_it_dies_of_ctrl_c(
    tmp_path: Path, number: Signals, code: int, before: Callable[[], None] | None
) -> None:
    """A shell goes on with a loop over launches unless the one it waits for has died of it."""
    done = at_terminal(AT_TERMINAL, number, tmp_path, before)
    assert (done.returncode, done.stderr) == (code, "error: Interrupted.\nAt its end.\n")
    assert list(tmp_path.iterdir()) == []


def test_at_a_terminal_a_program_that_calls_it_goes_on_after_ctrl_c(tmp_path: Path) -> None:
    done = at_terminal(GOES_ON, signal.SIGINT, tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ended with 130\n", "error: Interrupted.\n")


# A command that runs a sweep, whose output goes to a pipe that nobody reads or to a full disk.
RUNS = """
import sys
sys.path.insert(0, sys.argv.pop(1))
from fake_sweeps import Result
from tune_jobs.cli import commands as cli
from tune_jobs.cli import output as cli_output
from tune_jobs.sweeps import verbs as sweeps

def show(*_, **__):
    print("x" * 100_000)

sweeps.launch = lambda *_, **__: Result
Result.interrupted, Result.exit_code = False, 3
cli_output.show_result = show
cli_output.show_presets = show
cli.main()
"""


def run_script(*arguments: str, stdout: TextIO) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", RUNS, str(Path(__file__).parents[1] / "unit"), *arguments]
    return subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)


def test_a_sweep_whose_result_nobody_reads_has_not_failed_for_that() -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    with os.fdopen(theirs, "w") as nobody:
        done = run_script("launch", "cartpole-ppo", stdout=nobody)
    assert (done.returncode, done.stderr) == (3, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has this device")
@pytest.mark.parametrize("command", [["presets"], ["presets", "--json"], ["launch", "cartpole-ppo"]])
def test_output_that_cannot_be_written_is_said(command: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        done = run_script(*command, stdout=full)
    assert done.returncode == 5
    assert done.stderr.startswith("error: The output of this command cannot be written: No space left on device.\n")
    assert "Traceback" not in done.stderr


# As a sweep that has run; its last argument is whether it was interrupted.
RAN = """
import sys
sys.path.insert(0, sys.argv.pop(1))
from pathlib import Path
from sweep_folders import make_sweep_folder
from tune_jobs.cli import commands as cli
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.outcome import SweepResult

store = make_sweep_folder(Path("sweeps", "mine"), iterations=1)
interrupted = sys.argv.pop() == "True"
ran = SweepResult(store.place, store.read_record(), store.read_trials(), interrupted=interrupted)
sweeps.launch = sweeps.extend = lambda *_, **__: ran
cli.main()
"""
GO_ON = "tune-jobs resume mine\n"


def ran(cwd: Path, *arguments: str, is_read: str, interrupted: bool) -> subprocess.CompletedProcess[str]:
    """Run it where only one of its streams is read."""
    ours, theirs = os.pipe()
    os.close(ours)
    command = [sys.executable, "-c", RAN, str(Path(__file__).parents[1] / "unit"), *arguments, str(interrupted)]
    out, err = (subprocess.PIPE if is_read == name else theirs for name in ("stdout", "stderr"))
    done = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, cwd=cwd, text=True, check=False)
    os.close(theirs)
    return done


@pytest.mark.parametrize("more", [[], ["--json"]])
@pytest.mark.parametrize("interrupted", [True, False])
def test_ctrl_c_that_ends_the_results_reader_too_leaves_how_to_resume(
    tmp_path: Path, more: list[str], *, interrupted: bool
) -> None:
    done = ran(tmp_path, "launch", "cartpole-ppo", *more, is_read="stderr", interrupted=interrupted)
    assert done.returncode == (130 if interrupted else 0), done.stderr
    assert done.stderr.endswith(GO_ON) if interrupted else done.stderr == ""


def test_a_result_is_printed_though_nobody_reads_what_is_said_beside_it(tmp_path: Path) -> None:
    done = ran(tmp_path, "extend", "mine", "--num-samples", "1", is_read="stdout", interrupted=True)
    assert done.returncode == 130
    assert "4 trials: 4 completed" in done.stdout


def test_a_result_is_printed_where_both_streams_are_read(tmp_path: Path) -> None:
    command = [sys.executable, "-c", RAN, str(Path(__file__).parents[1] / "unit"), "launch", "cartpole-ppo", "True"]
    done = subprocess.run(command, cwd=tmp_path, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert "4 trials: 4 completed" in done.stdout
    assert done.stderr.endswith(GO_ON)
