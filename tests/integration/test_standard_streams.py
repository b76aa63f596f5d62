"""Processes without standard streams, as daemons are: what they open next is not written over."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from policies.standard_streams import standard_streams

# Closes descriptors, then starts a guard's child, and sends what is printed to a log, as a sweep does.
SCRIPT = """
import json, os, sys
from pathlib import Path
for number in json.loads(sys.argv[1]):
    os.close(number)
sys.stdout = None

from policies.guard.guarded import check_env
from tune_jobs.process.streams import quiet
from tune_jobs.process.state import given_back

said = {"env": check_env("CartPole-v1", {}).env_id}
with given_back(), Path("mine.txt").open("w") as mine:
    with quiet(Path("log.txt")):
        print("by Python")
        os.write(1, b"by a library")
    mine.write("mine")
said["stdout"] = sys.stdout is None
said["open"] = [number for number in range(3) if os.path.exists(f"/proc/self/fd/{number}")]
Path("said.json").write_text(json.dumps(said))
"""


@pytest.mark.parametrize("closed", [[1], [2], [0, 1, 2]])
def test_a_process_without_standard_streams_works_and_stays_without(tmp_path: Path, closed: list[int]) -> None:
    subprocess.run(
        [sys.executable, "-c", SCRIPT, json.dumps(closed)], check=True, cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    said = json.loads((tmp_path / "said.json").read_text())
    assert said == {"env": "CartPole-v1", "stdout": True, "open": [n for n in range(3) if n not in closed]}
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert "by a library" in (tmp_path / "log.txt").read_text()


# Started without standard error, so that its first file gets that number.
WITHOUT_ERRORS = """
from pathlib import Path
mine = Path("mine.txt").open("w")
assert mine.fileno() == 2

from policies.guard import guard
from policies.guard.guarded import check_env
from tune_jobs.process.state import given_back
from tune_jobs.process.streams import patient_stream, quiet, standard_error

with patient_stream() as stream:
    print("told by what follows the trials", file=stream)
with given_back(), quiet(Path("log.txt")) as stream:
    print("told by a sweep", file=stream)
popen, started = guard.subprocess.Popen, []
guard.subprocess.Popen = lambda *args, **kwargs: started.append(popen(*args, **kwargs)) or started[-1]
with guard.guarding():
    check_env("CartPole-v1", {})
    place = Path(f"/proc/{started[0].pid}/fd/2").readlink()
mine.write(f"{place} {standard_error()}")
"""


def test_what_is_told_and_what_children_print_goes_to_no_file_of_a_process_that_has_no_standard_error(
    tmp_path: Path,
) -> None:
    subprocess.run(
        [sys.executable, "-c", WITHOUT_ERRORS], check=True, cwd=tmp_path, preexec_fn=lambda: os.close(2),
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    assert (tmp_path / "mine.txt").read_text() == f"{os.devnull} {subprocess.DEVNULL}"


WITH_A_PROCESS_FOR_ITS_ENV = """
from pathlib import Path
mine = Path("mine.txt").open("w")
assert mine.fileno() == 2

from policies.envs.make import make_env
from policies.envs.modules import allow_modules

allow_modules(["lone_envs"])
env = make_env("lone_envs:Lone", {"own_process": True})
mine.write(str(Path(f"/proc/{env.reset()[1]['pid']}/fd/2").readlink()))
env.close()
"""


def test_what_an_environment_prints_in_its_own_process_goes_to_no_file_either(tmp_path: Path) -> None:
    path = os.pathsep.join(map(str, (Path(__file__).parents[2], Path(__file__).parents[1] / "unit")))
    subprocess.run(
        [sys.executable, "-c", WITH_A_PROCESS_FOR_ITS_ENV], check=True, cwd=tmp_path, preexec_fn=lambda: os.close(2),
        env=os.environ | {"PYTHONPATH": path},
    )  # fmt: skip
    assert (tmp_path / "mine.txt").read_text() == os.devnull


@pytest.mark.parametrize("closed", [(1,), (0, 1, 2)])
def test_commands_run_where_nobody_listens(tmp_path: Path, closed: tuple[int, ...]) -> None:
    def close_them() -> None:
        for number in closed:
            os.close(number)

    done = subprocess.run(
        [sys.executable, "-m", "tune_jobs.cli.commands", "list", "--storage", str(tmp_path)],
        preexec_fn=close_them,
        stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


def test_streams_that_are_there_stay_as_they_are() -> None:
    before = [(os.fstat(number), getattr(sys, name)) for number, name in enumerate(("stdin", "stdout", "stderr"))]
    with standard_streams():
        now = [(os.fstat(number), getattr(sys, name)) for number, name in enumerate(("stdin", "stdout", "stderr"))]
        assert now == before
