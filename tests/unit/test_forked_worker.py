"""Which of Ray's commands are done by a fork, and which are left to Ray."""

import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from tune_jobs.ray_tune import fork_server
from tune_jobs.ray_tune.forked_worker import ask, forkable

PROGRAM = "/ray/workers/default_worker.py"


def command(*options: str, program: str = PROGRAM) -> list[str]:
    return [sys.executable, "/ray/workers/setup_worker.py", program, "--node-id=1", *options]


def context(**parts: object) -> str:
    return "--serialized-runtime-env-context=" + json.dumps(parts)


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--language=PYTHON", "--serialized-runtime-env-context={}"],
        [context(command_prefix=[], env_vars={}, py_executable=sys.executable, override_worker_entrypoint=None)],
    ],
)
def test_a_command_that_only_starts_the_program_is_a_fork(options: list[str]) -> None:
    assert forkable(command(*options, "--worker-id=2")) == [PROGRAM, "--node-id=1", "--worker-id=2"]


@pytest.mark.parametrize(
    "options",
    [
        ["--language=CPP"],
        [context(command_prefix=["podman", "run"])],
        [context(env_vars={"A": "b"})],
        [context(py_executable="/another/python")],
        [context(override_worker_entrypoint="/another.py")],
        [context(something_new="that a later Ray has")],
    ],
)
def test_a_command_that_does_more_is_left_to_ray(options: list[str]) -> None:
    assert forkable(command(*options)) is None


@pytest.mark.parametrize("program", ["-s", "/ray/util/client/server"])
def test_another_program_is_left_to_ray(program: str) -> None:
    assert forkable(command(program=program)) is None


@pytest.mark.parametrize("num_answered", [0, 1])
def test_an_answer_counts_that_comes_before_who_asked_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, num_answered: int
) -> None:
    """On a machine with much to do: else there were the forked process and Ray's own for one command."""
    has_answered, told = threading.Event(), []

    class Slow(socket.socket):
        def sendmsg(self, *content: Any) -> int:
            sent = super().sendmsg(*content)
            assert has_answered.wait(10)
            return sent

    def answer(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection:
            while not connection.recv(1 << 16).endswith(b"\n"):
                pass
            forked = connection.dup()
            connection.sendall(b"7" * num_answered)
        if not num_answered:
            forked.close()
        has_answered.set()
        if num_answered:
            with forked:
                told.append(forked.recv(1))

    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(tmp_path / "asked"))
        listener.listen()
        thread = threading.Thread(target=answer, args=[listener])
        thread.start()
        monkeypatch.setattr(socket, "socket", Slow)
        assert ask(str(tmp_path / "asked"), [PROGRAM]) == bool(num_answered)
        monkeypatch.undo()
        thread.join(10)
    assert not thread.is_alive()
    assert told == [b"\n"] * num_answered


FORKED = """\
import os, resource, socket, sys
from tune_jobs.ray_tune import fork_server, forked_worker
program, address, told = sys.argv[1:]
_, most = resource.getrlimit(resource.RLIMIT_NOFILE)
resource.setrlimit(resource.RLIMIT_NOFILE, (200, most))
listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
listener.bind(address)
listener.listen()
pid = os.fork()
if pid == 0:
    connection, _ = listener.accept()
    asked, streams = fork_server._receive(connection)
    if told == "other things":
        del asked["files"]
    connection.sendall(b"7")
    connection.recv(1)
    fork_server._work(asked, streams)
    os._exit(0)
resource.setrlimit(resource.RLIMIT_NOFILE, (300, most))
assert forked_worker.ask(address, [program])
os.waitpid(pid, 0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="nothing is forked elsewhere")
@pytest.mark.parametrize(("told", "expected"), [("the limit", 300), ("other things", 200)])
def test_a_forked_process_may_open_as_many_files_as_who_asked(tmp_path: Path, told: str, expected: int) -> None:
    """Ray raises the limit when it is joined, and what processes are forked from was started before."""
    program = tmp_path / "default_worker.py"
    program.write_text("import resource; print(resource.getrlimit(resource.RLIMIT_NOFILE)[0], flush=True)")
    done = subprocess.run(
        [sys.executable, "-c", FORKED, str(program), str(tmp_path / "asked"), told],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.stdout == f"{expected}\n", done.stderr


IN_NO_FOLDER = """\
import os, socket, sys
from tune_jobs.ray_tune import fork_server, forked_worker
program, address, gone = sys.argv[1:]
listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
listener.bind(address)
listener.listen()
os.mkdir(gone)
os.chdir(gone)
os.rmdir(gone)
if os.fork() == 0:
    connection, _ = listener.accept()
    asked, streams = fork_server._receive(connection)
    connection.sendall(b"7")
    connection.recv(1)
    fork_server._work(asked, streams)
    os._exit(0)
assert forked_worker.ask(address, [program])
os.wait()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="nothing is forked elsewhere")
def test_a_process_is_forked_where_the_folder_is_removed_that_it_was_launched_in(tmp_path: Path) -> None:
    """The env runners of a sweep's later trials would never come, and the trials wait until they count as hung."""
    program = tmp_path / "default_worker.py"
    program.write_text("print('it works', flush=True)")
    done = subprocess.run(
        [sys.executable, "-c", IN_NO_FOLDER, str(program), str(tmp_path / "asked"), str(tmp_path / "gone")],
        cwd=Path(__file__).parents[2], env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.stdout == "it works\n", done.stderr


# What it imports is said by what its modules print, which is its own only as long as it is run here.
IMPORTS = """\
import runpy, sys
program, name, *path = sys.argv[1:]
sys.path[:] = path
found = runpy.run_path(program, run_name="not the program")
found["_import"](name)
print(sys.modules[name].__file__, sys.path == path)
"""


@pytest.mark.parametrize("is_installed", [True, False])
def test_packages_that_bear_the_names_of_pythons_modules_do_not_come_before_these(
    tmp_path: Path, *, is_installed: bool
) -> None:
    """Old packages bring `dataclasses`, with which nothing could be imported; they lie where tune-jobs is installed."""
    program = tmp_path / "tune_jobs" / "ray_tune" / "fork_server.py"
    program.parent.mkdir(parents=True)
    program.write_text(Path(fork_server.__file__).read_text())
    (tmp_path / "colorsys.py").write_text("")
    path = [each for each in sys.path if Path(each).name != "site-packages" and each] + [str(tmp_path)] * is_installed
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", IMPORTS, str(program), "colorsys", *path],
        capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    found, is_as_before = done.stdout.split()
    assert (Path(found).parent == tmp_path, is_as_before) == (not is_installed, "True")


@pytest.mark.parametrize("safe", ["", "1"])
def test_the_folders_of_pythonpath_are_those_of_what_is_forked(tmp_path: Path, safe: str) -> None:
    """With PYTHONSAFEPATH the first of them is no folder of this program."""
    text = Path(fork_server.__file__).read_text()
    begins = text.index("import array")
    program = tmp_path / "fork_server.py"
    program.write_text(text[:begins] + "print(*sys.path, sep='\\n')\n")
    folders = [str(tmp_path / name) for name in ("first", "second")]
    done = subprocess.run(
        [sys.executable, str(program)], capture_output=True, text=True, check=True, timeout=60,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders), "PYTHONSAFEPATH": safe},
    )  # fmt: skip
    assert done.stdout.splitlines()[:2] == folders
