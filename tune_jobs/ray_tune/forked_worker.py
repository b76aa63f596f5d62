"""In the place of the command by which a raylet starts a process: it lets `fork_server` fork one, and ends.

If that one does not answer, or the process needs an environment of its own, this becomes Ray's own command.

It is run by its path, so that it loads nothing else of this package.
"""

from __future__ import annotations

import array
import contextlib
import json
import os
import resource
import signal
import socket
import sys
from pathlib import Path

_PATIENCE_S = 40.0
"""Less than Ray 2.60 waits for a process: 60 s."""
_CONTEXT, _LANGUAGE = "--serialized-runtime-env-context=", "--language="


def forkable(command: list[str]) -> list[str] | None:
    """Return the program and options that Ray's command leads to; None: it does more than to start them.

    Args:
        command: Python, Ray's own program that sets it up, and what that one is given.
    """
    passed = []
    for part in command[2:]:
        if part.startswith(_CONTEXT):
            context = json.loads(part.removeprefix(_CONTEXT))
            own = {key: value for key, value in context.items() if value}
            if own.pop("py_executable", sys.executable) != sys.executable or own:
                return None
        elif part.startswith(_LANGUAGE):
            if part != f"{_LANGUAGE}PYTHON":
                return None
        else:
            passed.append(part)
    return passed if passed and passed[0].endswith("default_worker.py") else None


def ask(address: str, command: list[str]) -> bool:
    """Ask for a process; return whether there is one."""
    score = ""
    folder = None
    with contextlib.suppress(OSError):
        folder = str(Path.cwd())
    with contextlib.suppress(OSError):
        score = Path("/proc/self/oom_score_adj").read_text(encoding="ascii")
    asked = {
        "command": command,
        "environment": dict(os.environ),
        # None: it was removed, and what is forked is in no other.
        "folder": folder,
        "blocked": [int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, [])],
        "ignored": [
            int(number)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD)
            if signal.getsignal(number) is signal.SIG_IGN
        ],
        "oom_score_adj": score,
        "files": resource.getrlimit(resource.RLIMIT_NOFILE),
    }
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.connect(address)
            content = json.dumps(asked).encode() + b"\n"
            streams = array.array("i", [0, 1, 2])
            sent = connection.sendmsg([content], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, streams)])
            if rest := content[sent:]:
                # To send nothing is to fail where the answer is here, and who answered has closed.
                connection.sendall(rest)
            connection.settimeout(_PATIENCE_S)
            # It answers when it has imported everything.
            if not connection.recv(32):
                return False
            # The forked process begins when it is told to, and ends if it is not: there are never two for a command.
            connection.sendall(b"\n")
            return True
    except OSError:
        return False


def main() -> None:
    """Ask for a process, or be it."""
    address, command = sys.argv[1], sys.argv[2:]
    passed = forkable(command)
    if passed is None or not ask(address, passed):
        os.execv(command[0], command)  # noqa: S606


if __name__ == "__main__":
    main()
