"""In the place of Ray's program of this name, where the path of Python means something else to a shell.

By that program a raylet starts a process that is not forked (see `forking`). Ray 2.60 gives the path of Python to a
shell as it is, so that below a folder whose name has a space, say, no process starts. A raylet knows it by its name.

It is run by its path, so that it loads nothing else of this package.
"""

from __future__ import annotations

import runpy
import shlex
import sys
from pathlib import Path
from typing import Any


def main() -> None:
    """Do what Ray's program does, with the path quoted."""
    # The folder of this program, whose modules Ray must not take for its own.
    sys.path[:] = [entry for entry in sys.path if entry != str(Path(__file__).parent)]
    from ray._private.runtime_env.context import RuntimeEnvContext

    context: Any = RuntimeEnvContext
    original = context.exec_worker

    def exec_worker(self: Any, *args: Any) -> None:
        # Another one, of an environment of its own, is a command in a shell's words.
        if self.py_executable == sys.executable:
            self.py_executable = shlex.quote(sys.executable)
        original(self, *args)

    context.exec_worker = exec_worker
    runpy.run_module("ray._private.workers.setup_worker", run_name="__main__")


if __name__ == "__main__":
    main()
