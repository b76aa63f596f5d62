"""The `tune-jobs` script: it ends its process as a shell expects it, after Ctrl-C and after pressing Tab."""

from __future__ import annotations

import os
import signal
import sys
import threading

from tune_jobs.cli.commands import main as run
from tune_jobs.process.interruption import EXIT_CODE as INTERRUPTED
from tune_jobs.process.interruption import was_taken

_COMPLETING = "_TUNE_JOBS_COMPLETE"
"""Set by a shell that asks for completions."""


def main() -> None:
    """Run the command of this process; at a terminal, let the process die of SIGINT if that interrupted it.

    A shell that gets Ctrl-C as well ends its loop only if what it waits for died of it, and goes on to the next launch
    after one that exits. `$?` is 130 either way. A program that has no terminal gets the exit code.

    Raises:
        KeyboardInterrupt: It is to die.
    """
    try:
        run()
    except SystemExit as end:
        if end.code == INTERRUPTED and was_taken(signal.SIGINT) and os.isatty(0):
            # Where nobody catches this, Python sends itself the signal, after all else that it does at its end.
            sys.excepthook = lambda *_: None
            raise KeyboardInterrupt from None
        if os.environ.get(_COMPLETING) and threading.active_count() > 1:
            # Python would wait for the threads of requests, whose answers nobody waits for any more.
            os._exit(0)
        raise


if __name__ == "__main__":
    main()
