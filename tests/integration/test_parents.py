"""Processes end with the one that started them, killed or not, whatever they are doing."""

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from policies.parents import is_gone, this_process
from tests.narrowing import present

# What a child does: nothing that lets other threads run, or waits.
BUSY = "pow(3, 10**10)"
WAITING = "time.sleep(3600)"
CHILD = """
import os, sys, time
from policies.parents import end_with_parent
end_with_parent({arguments})
print(os.getpid(), flush=True)
{work}
"""
PARENT = """
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]])
time.sleep(3600)
"""


def ends_with_its_parent(arguments: str, work: str) -> bool:
    """Start a process and in it a child; kill it when the child is up; wait until the child has ended too."""
    child = CHILD.format(arguments=arguments, work=work)
    parent = subprocess.Popen([sys.executable, "-c", PARENT, child], stdout=subprocess.PIPE)
    pid = int(present(parent.stdout).readline())
    try:
        # The pipe is the child's too: it is closed when both have ended.
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        ready, _, _ = select.select([present(parent.stdout)], [], [], 60)
        return bool(ready) and present(parent.stdout).read() == b""
    finally:
        parent.kill()
        # If it did not end by itself, it must not go on for ever either.
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        present(parent.stdout).close()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux signals the end of a parent")
def test_a_process_inside_code_that_lets_no_thread_run_ends() -> None:
    assert ends_with_its_parent("", BUSY)


def test_a_process_whose_parent_may_be_watched_by_a_thread_alone_ends() -> None:
    assert ends_with_its_parent("by_kernel=False", WAITING)


def test_a_process_ends_once_a_condition_holds_and_one_that_raises_is_none(tmp_path: Path) -> None:
    file = tmp_path / "end"
    arguments = f"[lambda: 1 / 0, lambda: __import__('os').path.exists({str(file)!r})]"
    code = CHILD.format(arguments=arguments, work=WAITING)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    try:
        assert int(present(process.stdout).readline()) == process.pid
        assert process.poll() is None
        file.touch()
        assert process.wait(60) == 1
    finally:
        process.kill()
        present(process.stdout).close()


@pytest.mark.skipif(sys.platform != "linux", reason="read from /proc")
def test_a_process_is_known_again_and_seen_to_be_gone() -> None:
    assert not is_gone(this_process())
    code = "from policies.parents import this_process; print(this_process(), flush=True); input()"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    told = present(process.stdout).readline().strip()
    assert not is_gone(told)
    # It has ended and is not waited for: a zombie is gone.
    present(process.stdin).close()
    deadline = time.monotonic() + 600
    while not is_gone(told):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.wait()
    present(process.stdout).close()
    assert is_gone(told)
    # Another process under its number is not it.
    assert is_gone(" ".join([*this_process().split()[:-1], "1"]))


def test_a_process_that_cannot_be_seen_from_here_is_not_said_to_be_gone() -> None:
    assert not is_gone("")
    assert not is_gone(f"another-boot pid:[1] {os.getpid()} 1")
