"""Whoever reads what a sweep shows may go away, and the sweep goes on."""

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import os, sys
from pathlib import Path
from tune_jobs.sweeps.live_view import shown
from tune_jobs.sweeps.monitor import SweepMonitor

monitor = SweepMonitor("mine", [], caps={})
with shown(monitor, "auto", Path(sys.argv[1])):
    os.write(1, b"what a library says")
    sys.stdin.read()
Path(sys.argv[1]).with_name("done").touch()
"""


@pytest.mark.parametrize("terminal", [True, False])
def test_a_sweep_goes_on_when_nobody_reads_it(tmp_path: Path, terminal: bool) -> None:
    ours, theirs = pty.openpty() if terminal else os.pipe()
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "log")]
    # A session of its own: the terminal is not that of this test, nor does it send a signal.
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=theirs, stderr=theirs, start_new_session=True, cwd=tmp_path
    ) as process:
        os.close(theirs)
        if terminal:
            # Something is shown: the table is being drawn.
            assert os.read(ours, 1)
        os.close(ours)
        assert process.stdin is not None
        process.stdin.close()
        process.wait(120)
    assert (tmp_path / "done").exists(), (tmp_path / "log").read_text()
    assert (tmp_path / "log").read_text() == "what a library says"
