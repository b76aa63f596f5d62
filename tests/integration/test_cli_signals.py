"""Commands that run no trials end in order too: what they had begun to write is removed."""

import os
import signal
import subprocess
import sys
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
        env={**os.environ, "NUMBER": str(int(number))}, capture_output=True, text=True, check=False,
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
