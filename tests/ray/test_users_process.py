"""A launch from Python: what it raises, that its process is as before, and that it goes by the Ray that is there."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.ray

SCRIPT = Path(__file__).with_name("a_users_script.py")


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What the script told of each of its launches."""
    folder = tmp_path_factory.mktemp("script")
    # What "another Ray" is said to listen at.
    with socket.create_server(("127.0.0.1", 0)) as server, (folder / "errors").open("w") as errors:
        command = [sys.executable, str(SCRIPT), str(folder / "sweeps"), str(server.getsockname()[1])]
        done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=errors, text=True, timeout=900)  # noqa: PLW1510
    said = (folder / "errors").read_text()
    assert done.returncode == 0, said[-3000:]
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return {line["what"]: line for line in lines}


@pytest.mark.parametrize(
    ("what", "came_of_it"),
    [
        ("a launch", "exit code 0"),
        ("a bad spec", "WrongSpecError: sweep: algorithm: 'sac'"),
        ("a signal", "SweepInterrupted: "),
        ("two threads", "exit code 0; CannotRunError: Another thread of this process is running a sweep"),
        ("too few CPUs", "CannotRunError: One trial needs 2 CPUs; the Ray that this process is connected to has 1."),
        ("another Ray", "CannotRunError: This process is connected to the Ray at "),
        (
            "no free CPU",
            "CannotRunError: One trial needs 1 CPU; the Ray that this process is connected to (of its 1 CPUs",
        ),
        ("the user's Ray", "exit code 0"),
    ],
)
def test_a_launch_leaves_the_process_as_it_was(told, what, came_of_it):
    assert told[what]["came of it"].startswith(came_of_it)
    assert told[what]["changed"] == {}
