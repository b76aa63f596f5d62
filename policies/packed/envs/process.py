"""Step sub-environments in a process of their own, which is asked through a pipe."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from policies.answers import wait_for_answer
from policies.child_processes import entry, how_it_ended
from policies.envs.faults import note_signals
from policies.envs.modules import allow_modules, allowed_modules
from policies.errors import EnvError
from policies.packed.envs.sub_envs import HostDiedError, SubEnvs
from policies.packed.envs.together_sub_envs import make_sub_envs
from policies.parents import end_with_parent

_PATIENCE_S = 5.0
"""How long a process may take to close its environments."""


class ProcessHost:
    """A daemon process with the sub-environments that `make_sub_envs` returns; see `Host`.

    It is spawned, not forked: the pack's process has threads, and with them locks that a fork would leave locked.
    """

    def __init__(self, env_id: str, env_args: Mapping[str, Any] | None, *, with_lives: bool = False) -> None:
        context = multiprocessing.get_context("spawn")
        self._env_id = env_id
        self._connection, theirs = context.Pipe()
        make = partial(make_sub_envs, env_id, dict(env_args or {}), with_lives=with_lives)
        self._process = context.Process(
            target=entry(serve), args=(theirs, make, allowed_modules(), _parent()), daemon=True
        )
        self._process.start()
        # Otherwise the pipe would stay open here after the process has ended.
        theirs.close()

    @property
    def pid(self) -> int | None:
        """The id of the process."""
        return self._process.pid

    def send(self, method: str, *args: Any) -> None:
        """Ask the process to call a method of `SubEnvs`."""
        try:
            self._connection.send((method, args))
        except OSError as error:
            raise self._died() from error

    def receive(self) -> Any:
        """Wait for the result of the last call and return it, or raise its error."""
        try:
            wait_for_answer(self._connection, lambda: not self._process.is_alive())
            answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise self._died() from error
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None:
        """Close all sub-environments and end the process; one that does not end is killed."""
        with contextlib.suppress(OSError):
            self._connection.send(None)
        self._process.join(_PATIENCE_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._connection.close()

    def _died(self) -> HostDiedError:
        self._process.join(_PATIENCE_S)
        code = self._process.exitcode
        how = "ended" if code is None else how_it_ended(code)
        return HostDiedError(
            f"A process that stepped environments of {self._env_id} {how}.",
            "Look for errors of the env in the trial's log, and check this machine's free memory.",
        )


def _parent() -> tuple[int, bool]:
    """Return this process's id, and whether this thread is the main one, which lives as long as the process."""
    return os.getpid(), threading.current_thread() is threading.main_thread()


def serve(
    connection: Connection, make: Callable[[], SubEnvs], modules: tuple[str, ...], parent: tuple[int, bool]
) -> None:
    """Answer a `ProcessHost` until it closes; if its process ends, this one ends too, even inside a step."""
    pid, by_kernel = parent
    end_with_parent(parent=pid, by_kernel=by_kernel)
    # Daemons may have no processes, and an environment may. The parent, which holds this one for one, ends it as such.
    multiprocessing.current_process().daemon = False
    # Ctrl-C in a terminal reaches this process too, but the parent decides when it ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    note_signals()
    allow_modules(modules)
    sub_envs = make()
    while True:
        try:
            asked = connection.recv()
        except (EOFError, OSError):
            asked = None
        if asked is None:
            break
        method, args = asked
        try:
            answer = getattr(sub_envs, method)(*args)
        except EnvError as error:
            answer = error
        _note_causes(answer)
        connection.send(answer)
    sub_envs.close()


def _note_causes(answer: Any) -> None:
    """Add the causes of the errors in an answer as notes, because pickling an exception loses its causes."""
    errors = [answer] if isinstance(answer, EnvError) else getattr(answer, "errors", {}).values()
    for error in errors:
        if error.__cause__ is not None:
            error.add_note("".join(traceback.format_exception(error.__cause__)).rstrip())
