"""Be the first process of a container: take the end of others' processes, and pass signals on.

The system makes the first process (PID 1) of a container the parent of each process whose own parent has ended, and
keeps a little of an ended process until its parent asks how it ended. A killed driver leaves a dozen of Ray's behind.
Asking for all of them in the program itself would take from its libraries the ends of processes that they started; so
the program goes on in a child, and what is left of the first process does nothing else. Docker's --init and
Kubernetes' shared process namespace put such a process there by themselves; this does it where nobody has.
"""

from __future__ import annotations

import contextlib
import os
import signal

_FIRST = 1
# Those that the system sends because of what a process itself did are not for another one.
_OWN = (signal.SIGCHLD, signal.SIGTTIN, signal.SIGTTOU, signal.SIGSEGV, signal.SIGFPE, signal.SIGILL, signal.SIGBUS,
        signal.SIGABRT, signal.SIGTRAP, signal.SIGSYS)  # fmt: skip


def leave_first_place() -> None:
    """If this is the first process of a container, go on in a child of it; elsewhere do nothing.

    To be called before there are threads. The first process ends with the child's exit code, 128 more than the number
    of a signal that ended it; the system then ends what else runs in the container.
    """
    if os.getpid() == _FIRST:
        _leave()


def _leave() -> None:
    passed_on = signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP, *_OWN}
    # Held back, not lost, until they are waited for: the first process is sent none that it does not handle.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {*passed_on, signal.SIGCHLD})
    child = os.fork()
    if child == 0:
        # Not in the terminal's group: Ctrl-C would come twice, as it is passed on.
        os.setsid()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return
    while True:
        number = signal.sigwait({*passed_on, signal.SIGCHLD})
        if number != signal.SIGCHLD:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, number)
        elif (code := _take_ends(child)) is not None:
            os._exit(code)


def _take_ends(child: int) -> int | None:
    """Ask how each process that has ended did; return the exit code if one was the child."""
    code = None
    with contextlib.suppress(ChildProcessError):
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            if ended[0] == child:
                code = os.waitstatus_to_exitcode(ended[1])
    return code if code is None or code >= 0 else 128 - code
