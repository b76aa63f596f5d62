"""A launch from Python: what it raises, that its process is as before, and that it goes by the Ray that is there."""

import json
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ray

SCRIPT = Path(__file__).with_name("a_users_script.py")
Told = dict[str, dict[str, Any]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the script runs."""
    return tmp_path_factory.mktemp("script")


@pytest.fixture(scope="module")
def told(folder: Path) -> Told:
    """What the script told of each of its launches."""
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
        ("two threads", "exit code 0; exit code 0; exit code 0"),
        ("too few CPUs", "CannotRunError: One trial needs 2 CPUs; the Ray that this process is connected to has 1."),
        ("another Ray", "CannotRunError: This process is connected to the Ray at "),
        (
            "no free CPU",
            "CannotRunError: One trial needs 1 CPU; the Ray that this process is connected to (of its 1 CPUs",
        ),
        ("the user's Ray", "exit code 0"),
    ],
)
def test_a_launch_leaves_the_process_as_it_was(told: Told, what: str, came_of_it: str) -> None:
    assert told[what]["came of it"].startswith(came_of_it)
    assert told[what]["changed"] == {}


def test_a_created_sweep_that_a_thread_drives_gives_what_a_launch_gives(told: Told, folder: Path) -> None:
    assert "two threads" in told
    launched, driven = (what_it_learned(folder / "sweeps" / name) for name in ("one", "created"))
    assert driven == launched
    assert len(launched) == 3


def what_it_learned(sweep: Path) -> list[Any]:
    """Its records, results and weights, without times and places."""
    trial = sweep / "trials" / "t0000"
    results = [json.loads(line) for line in (trial / "results.jsonl").read_text().splitlines()]
    record = json.loads((trial / "trial.json").read_text())
    for data in (record, *results):
        for name in ("time_s", "node", "pid", "started_at", "ended_at"):
            data.pop(name, None)
    weights = [path.read_bytes() for path in sorted(trial.glob("checkpoints/*/policy.safetensors"))]
    return [record, results, weights]
