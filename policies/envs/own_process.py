"""Run an environment in a process of its own, which is asked through a pipe.

It is for environments of which a process can hold one only, as of emulators, and for those that share something with
others in their process. An error that the environment raises there is raised here; if its process ends, that is an
error, too.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import weakref
from functools import partial
from inspect import Parameter, Signature
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from policies.answers import wait_for_answer
from policies.child_processes import BEGINNING, how_it_ended
from policies.envs.faults import Frame, note_signals, place_in_env, set_place
from policies.envs.modules import allow_modules, allowed_modules
from policies.envs.rendering import choose_before_import, draw_without_display
from policies.envs.signatures import needs_nothing
from policies.errors import said_by
from policies.parents import end_with_parent
from policies.standard_streams import for_child

OWN_PROCESS = "own_process"
"""The reserved key among an environment's arguments that asks for it."""
_PATIENCE_S = 5.0
"""How long the process may take to close its environment."""
_THREADS = "OMP_NUM_THREADS"
_BOOTSTRAP = f"""{BEGINNING}\
from policies.envs.own_process import serve
serve({{parent}}, {{connection}}, by_kernel={{by_kernel}})
"""


class _Raised(NamedTuple):
    """What an environment has raised."""

    kind: str
    said: str
    error: bytes | None
    """Itself; None: it can't be pickled."""
    place: Frame | None


class _About(NamedTuple):
    """What is known of an environment without asking for it each time."""

    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    metadata: dict[str, Any]


class _Method(NamedTuple):
    """An attribute that can be called."""

    needs_nothing: bool
    """Whether it needs no arguments."""


_NEEDS_SOMETHING = Signature([Parameter("argument", Parameter.POSITIONAL_ONLY)])
"""What methods of the environment that need arguments look like from here; the others take anything."""


class InOwnProcess(gym.Env[Any, Any]):
    """An environment in a process of its own; its public methods and attributes are those of the environment there.

    Args:
        env_id: Gymnasium id, or `module:Name`; what the registry's entry says of wrappers and limits is left to whoever
            makes this.
        env_args: The arguments of its constructor, those of the registry's entry included.

    Raises:
        BaseException: What the import of its module or its constructor raised there.
        RuntimeError: Its process has ended, or what it raised can't be sent.
    """

    def __init__(self, env_id: str, /, **env_args: Any) -> None:  # an env may have an argument env_id
        self._connection, theirs = Pipe()
        code = _BOOTSTRAP.format(
            root=str(Path(__file__).parents[2]),
            parent=os.getpid(),
            connection=theirs.fileno(),
            by_kernel=threading.current_thread() is threading.main_thread(),
        )
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 (this very Python)
                [sys.executable, "-P", "-c", code],
                env={_THREADS: "1", **os.environ},
                stdin=subprocess.DEVNULL,
                stdout=for_child("stdout"),
                stderr=for_child("stderr"),
                pass_fds=[theirs.fileno()],
            )
        self._end = weakref.finalize(self, _end, self._connection, self._process)
        try:
            about = self._ask(sys.path, allowed_modules(), env_id, env_args)
        except BaseException:
            self._end()
            raise
        self.observation_space, self.action_space = about.observation_space, about.action_space
        self.metadata, self.render_mode = about.metadata, env_args.get("render_mode")
        self._methods: dict[str, _Method] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset the environment."""
        return self._ask("reset", (), {"seed": seed, "options": options})

    def step(self, action: Any) -> Any:
        """Step the environment."""
        return self._ask("step", (action,), {})

    def render(self) -> Any:
        """Draw the environment."""
        return self._ask("render", (), {})

    def close(self) -> None:
        """Close the environment and end its process; one that does not end is killed."""
        self._end()

    def __getattr__(self, name: str) -> Any:
        """Return a public method or attribute of the environment that Gymnasium's class has not."""
        if name.startswith("_") or "_methods" not in self.__dict__:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        if name not in self._methods:
            found = self._ask(name, None, None)
            if not isinstance(found, _Method):
                return found
            self._methods[name] = found
        method: Any = partial(self._call, name)
        if not self._methods[name].needs_nothing:
            method.__signature__ = _NEEDS_SOMETHING
        return method

    def _call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        return self._ask(method, args, kwargs)

    def _ask(self, *asked: Any) -> Any:
        data = pickle.dumps(asked)
        try:
            self._connection.send_bytes(data)
            wait_for_answer(self._connection, lambda: self._process.poll() is not None)
            data = self._connection.recv_bytes()
        except (EOFError, OSError) as error:
            raise RuntimeError(f"its own process {self._how_it_ended()}") from error
        except BaseException:
            # The answer that was not waited for would be taken for that of the next question.
            self._end()
            raise
        answer = pickle.loads(data)  # noqa: S301 (of our own process)
        if isinstance(answer, _Raised):
            _raise(answer)
        return answer

    def _how_it_ended(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            return how_it_ended(self._process.wait(_PATIENCE_S))
        return "does not answer any more"


def _end(connection: Connection, process: subprocess.Popen[bytes]) -> None:
    connection.close()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_PATIENCE_S)
    process.kill()
    process.wait()


def _raise(raised: _Raised) -> NoReturn:
    error: BaseException = RuntimeError(f"{raised.kind}: {raised.said}")
    if raised.error is not None:
        with contextlib.suppress(Exception):  # a class of a module that is not found here, say
            error = pickle.loads(raised.error)  # noqa: S301 (of our own process)
    set_place(error, raised.place)
    raise error


# -- the process


def serve(parent: int, connection: int, *, by_kernel: bool) -> None:
    """Make an environment and answer for it until the other end is closed.

    Args:
        parent: The parent's process id.
        connection: Descriptor of this end of the pipe to the parent.
        by_kernel: Whether the parent's thread lives as long as the parent.
    """
    end_with_parent(parent=parent, by_kernel=by_kernel)
    # Ctrl-C in a terminal reaches this process too, but the parent decides when it ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    note_signals()
    with Connection(connection) as pipe, contextlib.suppress(EOFError, OSError):
        path, modules, env_id, env_args = pipe.recv()
        sys.path[:] = path
        allow_modules(modules)
        env: Any = None
        answer: Any
        try:
            env = _made(env_id, env_args)
            answer = _about(env)
        except BaseException as error:  # noqa: BLE001 (an env may raise anything)
            answer = _as_raised(error)
        try:
            while True:
                _send(pipe, answer)
                asked = pipe.recv()
                try:
                    answer = _answer(env, *asked)
                except BaseException as error:  # noqa: BLE001
                    answer = _as_raised(error)
        finally:
            with contextlib.suppress(Exception):
                env.close()


def _made(env_id: str, env_args: dict[str, Any]) -> Any:
    from policies.envs.ids import find_env
    from policies.envs.mujoco_warnings import say_each_once

    if env_args.get("render_mode") is not None:
        choose_before_import()
    entry = find_env(env_id)[1].entry_point
    creator = load_env_creator(entry) if isinstance(entry, str) else entry
    if creator is None:
        raise RuntimeError(f"{env_id} is registered without an entry point")
    say_each_once()
    if env_args.get("render_mode") is not None:
        draw_without_display()
    return creator(**env_args)


def _about(env: Any) -> _About:
    metadata = {name: value for name, value in env.metadata.items() if _is_sent(value)}
    return _About(env.observation_space, env.action_space, metadata)


def _answer(env: Any, name: str, args: tuple[Any, ...] | None, kwargs: dict[str, Any] | None) -> Any:
    found = env.get_wrapper_attr(name) if isinstance(env, gym.Wrapper) else getattr(env, name)
    if args is None:
        return _Method(needs_nothing(found)) if callable(found) else found
    return found(*args, **(kwargs or {}))


def _as_raised(error: BaseException) -> _Raised:
    place = place_in_env(error)
    try:
        pickled = pickle.dumps(error)
        pickle.loads(pickled)  # noqa: S301 (what was just written)
    except Exception:  # noqa: BLE001 (an error of an env's own class may raise anything there)
        pickled = None
    return _Raised(type(error).__name__, said_by(error), pickled, place)


def _is_sent(value: Any) -> bool:
    try:
        pickle.dumps(value)
    except Exception:  # noqa: BLE001
        return False
    return True


def _send(pipe: Connection, answer: Any) -> None:
    try:
        data = pickle.dumps(answer)
    except Exception as error:  # noqa: BLE001 (what an env returns may raise anything there)
        data = pickle.dumps(
            _as_raised(TypeError(f"what it returns can't be sent to another process: {said_by(error)}"))
        )
    pipe.send_bytes(data)
