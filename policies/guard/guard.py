"""The guard: a child process in which environments run outside of trials.

An environment is a user's code: it may hang, and it may end its process. In a trial, that is a failure of the trial. In
the plan, the confirmation and the videos, it would end the process that drives the sweep. So these run in a child
process, which is waited for as long as its calls (see `calls`) make progress. The child has the same import path as the
processes of trials: the working directory and the main script's folder, which Ray gives those, and PYTHONPATH.

One child does the work of one call of the Python API or one command, from the plan to the videos, but for the episodes
of slow environments, which several play (see `spread`). It starts in less than half a second, while its parent does
other work.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from multiprocessing.connection import Pipe
from pathlib import Path
from typing import Any, Self

from policies.child_processes import BEGINNING
from policies.envs.calls import Call, Page
from policies.envs.modules import ENVIRONMENT_VARIABLE, allowed_modules, module_folders
from policies.errors import CannotRunError, EnvFailedError, TuneJobsError
from policies.files import absolute
from policies.guard.failures import died, frames_in, hung, place_of
from policies.guard.shared_files import shared_files
from policies.standard_streams import for_child, standard_streams

CALL_TIMEOUT_S = 600.0
"""How long one call may take, unless a sweep sets it."""
_OWN_TIMEOUT_S = 600.0
"""The least time limit outside of a user's code, such as for an encoder that hangs."""
_LOOK_S = 0.5
"""The time between two looks at the page while no answer comes."""
_PATIENCE_S = 5.0
"""How long the child may take to end by itself before it is killed."""
_TRACEBACK_S = 1.0
_PACKAGE = Path(__file__).parents[1]
_BOOTSTRAP = f"""{BEGINNING}\
from policies.guard.child import main
main({{parent}}, {{connection}}, {{page}}, {{dump}})
"""


_THREADS = "OMP_NUM_THREADS"
_VARIABLES = ("PYTHONPATH", ENVIRONMENT_VARIABLE, _THREADS)
"""What a child reads of the environment as it begins."""


@dataclass(frozen=True)
class _Surroundings:
    """The surroundings that a child was started with; where they change, a new child is started."""

    folders: tuple[str, ...]
    """The folders at the front of the import path: the working directory and the main script's folder."""
    environment: tuple[str | None, ...]

    @classmethod
    def now(cls) -> _Surroundings:
        folders = [str(absolute(Path()))]
        # An embedded Python has no arguments.
        name = sys.argv[0] if sys.argv else ""
        script = os.path.dirname(os.path.realpath(name))  # noqa: PTH120 (the same way as Ray)
        if hasattr(sys.modules.get("__main__"), "__file__") and script in sys.path:
            folders.append(script)
        return cls(tuple(folders), tuple(map(os.environ.get, _VARIABLES)))


class _Child:
    """A running child, and the pipe and files that it shares with this process."""

    def __init__(self, surroundings: _Surroundings) -> None:
        self.surroundings = surroundings
        self.modules: set[str] = set()
        self.has_worked = False
        self.is_busy = False
        """Whether it has a job whose answer was not read."""
        self._starter = threading.current_thread()
        with standard_streams():
            self._begin()

    def _begin(self) -> None:
        self._page_file, self._dump = shared_files()
        self.connection, theirs = Pipe()
        self.page = Page(self._page_file.fileno())
        numbers = (theirs.fileno(), self._page_file.fileno(), self._dump.fileno())
        code = _BOOTSTRAP.format(
            root=str(_PACKAGE.parent), parent=os.getpid(), connection=numbers[0], page=numbers[1], dump=numbers[2]
        )
        try:
            self.process = subprocess.Popen(  # noqa: S603 (this very Python)
                [sys.executable, "-P", "-c", code],
                # As in processes of trials. Threads of a product of matrices spin while they wait for each other: where
                # the cores have other work, a policy took 60 times as long for an image of Atari's.
                env={_THREADS: "1", **os.environ},
                stdin=subprocess.DEVNULL,
                stdout=for_child("stdout"),
                stderr=for_child("stderr"),
                pass_fds=numbers,
                # Ctrl-C in a terminal reaches only the parent, which then ends the child.
                start_new_session=True,
            )
        except OSError as error:
            raise CannotRunError(
                f"No process can be started to run environments in ({sys.executable}): {error}.",
                "See what limits the processes of this user, with `ulimit -u`.",
            ) from error
        finally:
            theirs.close()

    @property
    def was_lost(self) -> bool:
        """Whether it ended between two jobs, for example because the system killed it when memory was scarce.

        It may never have begun: a signal can end it while Python starts, with any exit code. If no child can begin, the
        error of the next one is reported.
        """
        return self.process.poll() is not None

    @property
    def may_be_lost(self) -> bool:
        """Whether it was started by another thread, which may end: Linux ends it with that one."""
        return self._starter not in (threading.current_thread(), threading.main_thread())

    def frames(self) -> list[str]:
        """Return the frames of the user's code, innermost first, as Python's fault handler wrote them."""
        self._dump.seek(0)
        return frames_in(self._dump.read().decode("utf-8", errors="replace"))

    def dump_frames(self) -> None:
        """Let the fault handler write the child's frames, which works while its Python code hangs."""
        with contextlib.suppress(OSError):
            self.process.send_signal(signal.SIGUSR1)
        end = time.monotonic() + _TRACEBACK_S
        size = -1
        while time.monotonic() < end and (size <= 0 or os.fstat(self._dump.fileno()).st_size > size):
            size = os.fstat(self._dump.fileno()).st_size
            time.sleep(0.05)

    def close(self, *, patience_s: float) -> None:
        self.connection.close()
        try:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(patience_s)
        finally:
            # Also where this process is interrupted while it waits. The group includes what the env started.
            with contextlib.suppress(OSError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self._page_file.close()
            self._dump.close()


class EnvGuard:
    """Runs jobs in a child, one after another; a context manager.

    The child is started by `start` or by the first job, and again after a job that hung or ended it.
    """

    def __init__(self) -> None:
        self._child: _Child | None = None
        self._others: list[EnvGuard] = []
        self.episode_s: dict[str, list[float]] = {}
        """How long an episode took in a child, in seconds, by what tells environments apart; see `spread`."""
        self.look: Callable[[], None] = lambda: None
        """Called from time to time while a job is waited for."""
        self.log: Path | None = None
        """What environments print to; None: standard error."""

    def others(self, num: int) -> list[EnvGuard]:
        """Return further guards, for jobs at the same time, whose children begin; they end with this one."""
        self._others += [EnvGuard() for _ in range(num - len(self._others))]
        for other in self._others[:num]:
            other.log = self.log
            other.start()
        return self._others[:num]

    def start(self) -> None:
        """Start the child, if there is none, without waiting for it."""
        if self._child is None:
            self._child = _Child(_Surroundings.now())

    def close(self) -> None:
        """End the child, and those of further guards."""
        for other in self._others:
            other.close()
        if self._child is not None:
            child, self._child = self._child, None
            # Before its first job the child has nothing to clean up; what nobody waits for need not come to its end.
            child.close(patience_s=_PATIENCE_S if child.has_worked and not child.is_busy else 0.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, job: str, env_id: str, *, timeout_s: float = CALL_TIMEOUT_S, **arguments: Any) -> Any:
        """Do a job in the child, and wait for it.

        Args:
            job: A function of `policies.guard.child`.
            env_id: The environment that the job is about.
            timeout_s: How long one call of the user's code may take; the job may take longer.
            arguments: The function's other arguments, as JSON.

        Returns:
            The function's result, as JSON.

        Raises:
            EnvFailedError: The environment hung, or ended the process.
            TuneJobsError: The function raised it.
        """
        return self.begin(job, env_id, timeout_s=timeout_s, **arguments)()

    @property
    def num_resets(self) -> int:
        """How often the child has reset environments so far."""
        return 0 if self._child is None else self._child.page.resets

    @property
    def num_renders(self) -> int:
        """How many pictures environments have drawn in the child so far."""
        return 0 if self._child is None else self._child.page.renders

    def begin(
        self, job: str, env_id: str, *, timeout_s: float = CALL_TIMEOUT_S, look: Callable[[], None] = lambda: None,
        **arguments: Any,
    ) -> Callable[[], Any]:  # fmt: skip
        """Begin a job in the child, whose result is waited for later.

        Args:
            job: As for `run`.
            env_id: As for `run`.
            timeout_s: As for `run`.
            look: Called from time to time while the result is waited for.
            arguments: As for `run`.

        Returns:
            What waits for the result, to be called before the next job begins. Until then nobody notices that the
            environment hangs. It returns and raises what `run` does.
        """
        child = self._ready_child()
        asked = {
            "job": job,
            "log": None if self.log is None else str(absolute(self.log)),
            "folders": child.surroundings.folders,
            "modules": sorted(child.modules),
            "module_folders": module_folders(),
            "arguments": {"env_id": env_id, **arguments},
        }
        child.is_busy = True
        # That the child has ended is noticed when its answer is read.
        with self._lost_if_it_fails(child), contextlib.suppress(OSError):
            child.connection.send_bytes(json.dumps(asked).encode())

        def result() -> Any:
            with self._lost_if_it_fails(child):
                answer = self._wait(child, env_id, timeout_s, look)
            child.has_worked, child.is_busy = True, False
            if "error" in answer:
                raise _error(answer["error"])
            return answer["result"]

        return result

    def give_up(self) -> None:
        """End the child whatever it does; the next job gets a new one."""
        if self._child is not None:
            child, self._child = self._child, None
            child.close(patience_s=0.0)

    @contextlib.contextmanager
    def _lost_if_it_fails(self, child: _Child) -> Iterator[None]:
        try:
            yield
        except BaseException:
            # Also where this process is interrupted: nothing waits for the child any more then.
            self._child = None
            child.close(patience_s=0.0)
            raise

    def _ready_child(self) -> _Child:
        """Return a child with this process's present surroundings; a new one is started if they have changed."""
        modules = set(allowed_modules())
        if self._child is not None and self._child.is_busy:
            # Whoever asked was interrupted before he waited: what it says next is no answer to this job.
            self.give_up()
        child = self._child
        if child is not None and (
            child.was_lost
            or child.may_be_lost
            or child.surroundings != _Surroundings.now()
            or not child.modules <= modules
        ):
            self.close()
        self.start()
        assert self._child is not None
        self._child.modules = modules
        return self._child

    def _wait(self, child: _Child, env_id: str, timeout_s: float, look: Callable[[], None]) -> Any:
        """Wait for the child's answer; the time limit begins anew with each sign of progress."""
        count, waited, before = child.page.count, 0.0, time.monotonic()
        while True:
            call = child.page.call
            limit = timeout_s if call is not Call.NONE else max(timeout_s, _OWN_TIMEOUT_S)
            try:
                if child.connection.poll(max(0.01, min(_LOOK_S, limit - waited))):
                    return json.loads(child.connection.recv_bytes())
            except (EOFError, OSError):
                raise _died(child, env_id) from None
            look()
            self.look()
            # Processes that the env has started may hold the pipe open after the child's end.
            if child.process.poll() is not None and not child.connection.poll():
                raise _died(child, env_id)
            now = time.monotonic()
            # Time in which this process itself was stopped, or did not get to run, does not count.
            waited, before = waited + min(now - before, 2 * _LOOK_S), now
            if child.page.count != count or child.page.call != call:
                count, waited = child.page.count, 0.0
            elif waited >= limit:
                raise _hung(child, env_id, limit)


def _hung(child: _Child, env_id: str, limit: float) -> EnvFailedError:
    # Read before the fault handler is asked, because its signal may wake a call that waits.
    where = place_of(child.page)
    child.dump_frames()
    return hung(env_id, where, limit, child.frames())


def _died(child: _Child, env_id: str) -> EnvFailedError:
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.process.wait(_PATIENCE_S)
    return died(env_id, child.page, child.process.returncode, child.frames())


def _error(told: dict[str, str]) -> Exception:
    """Return the error that the child raised."""
    # This module defines an error class of its own, which has to be known here.
    import policies.acting.policy  # noqa: F401

    kinds = {kind.__name__: kind for kind in _kinds(TuneJobsError)}
    error: Exception
    if told["kind"] in kinds:
        error = kinds[told["kind"]](told["message"], told["hint"])
    else:
        error = RuntimeError(f"{told['kind']}: {told['message']}")
    error.add_note(told["traceback"])
    return error


def _kinds(kind: type[TuneJobsError]) -> Iterator[type[TuneJobsError]]:
    yield kind
    for further in kind.__subclasses__():
        yield from _kinds(further)


_current: ContextVar[EnvGuard | None] = ContextVar("guard", default=None)


@contextlib.contextmanager
def guarding(*, start: bool = False) -> Iterator[EnvGuard]:
    """Yield a guard for the block: the one that is open around it, else a new one.

    Args:
        start: Start its child at once, because it will be needed.
    """
    known = _current.get()
    with contextlib.ExitStack() as stack:
        guard = known
        if guard is None:
            guard = stack.enter_context(EnvGuard())
            stack.callback(_current.reset, _current.set(guard))
        if start:
            guard.start()
        yield guard
