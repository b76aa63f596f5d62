"""What Ray's raylet started ends when a driver is killed, though nobody tells it."""

import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.narrowing import present

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

# Called as Ray's is, with a child that would go on.
RAYLET = """
import ctypes, subprocess, sys, time
ctypes.CDLL(None).prctl(15, b"raylet")
subprocess.Popen([sys.executable, "-c", "import time; print('up', flush=True); time.sleep(3600)"])
ctypes.CDLL(None).prctl(1, 9)
time.sleep(3600)
"""
# The other child is the user's own.
DRIVER = """
import subprocess, sys, time
from tune_jobs.ray_tune.reaper import reaping
with reaping():
    subprocess.Popen([sys.executable, "-c", sys.argv[1]])
    subprocess.Popen([sys.executable, "-c", "print(1, flush=True); input(); print('mine')"], stdin=sys.stdin)
    time.sleep(3600)
"""


def names_of_children(pid: int) -> list[str]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [Path(f"/proc/{child}/comm").read_text().strip() for child in children]


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 600
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_what_a_raylet_started_ends_with_the_driver_and_nothing_else_does() -> None:
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER, RAYLET],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        told = sorted(present(driver.stdout).readline().strip() for _ in range(2))
        assert told[1] == "up"
        wait_until(lambda: "reaper of 1" in names_of_children(driver.pid))
        driver.send_signal(signal.SIGKILL)
        driver.wait()
        # The user's own process still reads. Its output is the same pipe as that of the raylet's child.
        present(driver.stdin).write("go on\n")
        present(driver.stdin).flush()
        assert present(driver.stdout).readline() == "mine\n"
        ready, _, _ = select.select([present(driver.stdout)], [], [], 60)
        assert ready
        assert present(driver.stdout).read() == ""
    finally:
        driver.kill()
        present(driver.stdin).close()
        present(driver.stdout).close()
