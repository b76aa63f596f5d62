"""Commands that run no trials end in order too: what they had begun to write is removed."""

import os
import signal
import subprocess
import sys

import pytest

# A command that begins a film and is sent a signal in the middle; its last argument is its folder.
SCRIPT = """
import os, sys
from pathlib import Path
from policies.files import atomic_path
from tune_jobs import cli, sweeps

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
def test_a_signal_leaves_nothing_half_made(tmp_path, number):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, "video", "random", "--env", "CartPole-v1", "--output", str(tmp_path)],
        env={**os.environ, "NUMBER": str(int(number))}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 130, done.stderr
    assert done.stderr == "error: Interrupted.\n"
    assert list(tmp_path.iterdir()) == []


def test_nohup_means_it(tmp_path):
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
from tune_jobs import cli, sweeps

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


def test_two_hangups_are_one(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", TWICE, "video", "random", "--env", "CartPole-v1", "--output", str(tmp_path)],
        capture_output=True, text=True, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (130, "error: Interrupted.\n")
    assert list(tmp_path.iterdir()) == []
