"""What `make faults` starts ends with it, however it ends."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.kills.processes import Family

# A parent as the harness is: it starts a program in a session of its own, and a fork of itself.
_PARENT = """
import os, subprocess, time
from tests.kills.processes import end_with_parent

child = subprocess.Popen(["sleep", "600"], start_new_session=True, preexec_fn=end_with_parent)
if os.fork() == 0:
    end_with_parent()
    os.setsid()
    print("started", flush=True)
time.sleep(600)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a child that its parent has ended")
def test_what_a_killed_parent_has_started_ends_too() -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", _PARENT], cwd=Path(__file__).parents[2], stdout=subprocess.PIPE, text=True
    )
    with parent, Family(parent.pid) as family:
        try:
            assert parent.stdout is not None
            assert parent.stdout.readline() == "started\n"
            family.look()
            assert len(family.alive()) == 3
            parent.kill()
            parent.wait()
            assert family.wait_until_gone(10) is not None, family.left
        finally:
            family.kill_all()
