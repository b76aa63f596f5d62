"""The command line: it parses, calls the functions of `tune_jobs.sweeps.verbs`, and prints."""

import os
import sys

if os.name == "nt":
    # Ahead of the commands: what they import fails where there are no signals and locks of POSIX.
    sys.stderr.write("error: tune-jobs runs on Linux and macOS, not on Windows.\nInstall and run it in WSL.\n")
    sys.exit(5)  # as CannotRunError
