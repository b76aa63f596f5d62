"""On Windows, whose Python has no POSIX, the command says where it runs."""

import subprocess
import sys

AS_ON_WINDOWS = """
import os, signal, sys, tune_jobs
for missing in ("fcntl", "resource"):
    sys.modules[missing] = None
del signal.SIGUSR1, signal.SIGHUP
os.name = "nt"
sys.argv = ["tune-jobs", "--version"]
from tune_jobs.cli.commands import main
main()
"""


def test_the_command_says_that_it_does_not_run_there() -> None:
    done = subprocess.run([sys.executable, "-c", AS_ON_WINDOWS], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (5, "")
    assert done.stderr.splitlines() == [
        "error: tune-jobs runs on Linux and macOS, not on Windows.", "Install and run it in WSL.",
    ]  # fmt: skip
