"""Start Ray on this machine for a sweep, at 127.0.0.1 alone and without what a sweep has no use for.

Nothing public of Ray 2.60 does most of this. Each place where Ray itself is changed says what it costs otherwise; where
a later Ray has no such place any more, it starts as it would by itself, or a test of this module says so.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import ray

from policies.envs.modules import module_folders
from policies.errors import CannotRunError
from tune_jobs.plan.machine import Machine
from tune_jobs.ray_tune.address import rays_folder
from tune_jobs.ray_tune.environment import provide_token
from tune_jobs.ray_tune.forking import forked_workers
from tune_jobs.ray_tune.forks import ForkServer
from tune_jobs.ray_tune.replaced import replaced

# Weights travel inside checkpoints and results are small: RLlib needs little of Ray's object store.
_OBJECT_STORE_BYTES = 256 * 1024**2
# Ray refuses to start with less; where no more is left, it measures by itself.
_LEAST_BYTES = 100e6
_PATH_TOO_LONG = "AF_UNIX path length"
# Ray 2.60's processes ask a second later where a socket is not there yet, which the raylet's own may not be.
_SYSTEM = {"raylet_client_connect_timeout_milliseconds": 20, "raylet_client_num_connect_attempts": 500}
QUIET: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
"""What `ray.init` is told, so that it prints nothing."""


def start(
    machine: Machine | None, forks: ForkServer | None = None, meanwhile: Callable[[], object] | None = None
) -> None:
    """Start a Ray of this machine and join it.

    Args:
        machine: The CPUs and GPUs to start it with; None: all that Ray finds.
        forks: From which its processes are forked (see `forking`); None: it starts them itself.
        meanwhile: What to do while its processes start, in this thread: two that import parts of Ray at once may see
            modules half done.

    Raises:
        CannotRunError: Ray does not start.
    """
    _check_paths()
    # A local sweep sends nothing anywhere; users who want Ray's usage statistics can set the variable.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    provide_token()
    resources: dict[str, Any] = {}
    if machine is not None:
        resources = {"num_cpus": int(machine.num_cpus), "num_gpus": int(machine.num_gpus)}
        left = (machine.memory_bytes or 0.0) - _OBJECT_STORE_BYTES
        if left >= _LEAST_BYTES:
            # Plans for this Ray read it there again, and Ray 2.60 sees no cgroup's limit but the root's.
            resources["_memory"] = int(left)
    try:
        with (
            _finding_own_modules(),
            _without_unused_processes(),
            without_dashboards_agent(),
            with_python_quoted(),
            forked_workers(forks),
            _noticing_its_node(meanwhile),
            at_loopback(),
            outside_of_uv(),
        ):
            # "local": a cluster of this sweep's own, even if another one runs already.
            ray.init(
                address="local",
                include_dashboard=False,
                object_store_memory=_OBJECT_STORE_BYTES,
                _system_config=_SYSTEM,
                **resources,
                **QUIET,
            )
    except Exception as error:
        folder = rays_folder()
        if _PATH_TOO_LONG in str(error):
            hint = f"{folder} is too long a path for Ray's sockets: set RAY_TMPDIR to a short folder, such as /tmp."
        else:
            hint = f"Look for the cause in Ray's logs in {folder / 'session_latest' / 'logs'}."
        raise CannotRunError(f"Ray cannot be started on this machine: {first_line(error)}", hint) from error


def _check_paths() -> None:
    """Refuse an installation whose path a raylet (Ray 2.60) reads as another one; it would wait for nothing, and end.

    Raises:
        CannotRunError: It is one.
    """
    for path in (sys.executable, __file__, ray.__file__):
        try:
            is_read = shlex.split(subprocess.list2cmdline([path])) == [path]
        except ValueError:  # a quote that nothing ends
            is_read = False
        if not is_read:
            raise CannotRunError(
                f"Ray cannot be started from {path}: it finds no file whose path has a quote or a backslash.",
                "Install tune-jobs in a folder without them, as in a new virtual environment there.",
            )


@contextlib.contextmanager
def at_loopback() -> Iterator[None]:
    """Let a Ray that is started in the block listen at 127.0.0.1 alone, where no other machine reaches it.

    Ray 2.60 puts this machine's own address in the place of 127.0.0.1, also where it was given, and then listens at
    all addresses; but not on macOS and Windows, nor where this says that it is on one of them. A process that joins
    such a Ray has to do so too.
    """
    with replaced(ray._private.ray_constants, "ENABLE_RAY_CLUSTER", value=False):  # noqa: SLF001
        yield


_UV = "RAY_ENABLE_UV_RUN_RUNTIME_ENV"


@contextlib.contextmanager
def outside_of_uv() -> Iterator[None]:
    """Let the processes of a Ray that is joined in the block run in the Python of their machine, under `uv run` too.

    Where `uv run` is above this process, Ray 2.60 starts each of them by `uv run`, in a copy of the working directory,
    sweeps and all: uv makes an environment anew there, and nothing is forked. In a subfolder of a project Ray does not
    start. Users who want that can set the variable.
    """
    if _UV in os.environ:
        yield
        return
    with replaced(ray._private.ray_constants, _UV, value=False):  # noqa: SLF001
        yield


_NODES_PATIENCE_S = 10.0
_POLL_S = 0.02


@contextlib.contextmanager
def _noticing_its_node(meanwhile: Callable[[], object] | None) -> Iterator[None]:
    """Let a Ray that is started in the block notice at once that its node is there.

    Ray 2.60's native code looks once a second, and a node is there after less.
    """
    services: Any = ray._private.services  # noqa: SLF001
    original = services.get_node

    def get_node(gcs_address: str, node_id: str) -> Any:
        if meanwhile is not None:
            meanwhile()
        # Where it can't be asked so, Ray's own way says why.
        with contextlib.suppress(Exception):
            state: Any = ray._private.state.GlobalState()  # noqa: SLF001
            state._initialize_global_state(services._get_gcs_client_options(gcs_address))  # noqa: SLF001
            until = time.monotonic() + _NODES_PATIENCE_S
            while time.monotonic() < until and all(node["NodeID"] != node_id for node in state.node_table()):
                time.sleep(_POLL_S)
        return original(gcs_address, node_id)

    with replaced(services, "get_node", get_node):
        yield


_UNUSED = ("start_monitor", "start_log_monitor", "start_api_server")


@contextlib.contextmanager
def _without_unused_processes() -> Iterator[None]:
    """Start Ray in the block without three processes that nobody asks here: autoscaler, log monitor and dashboard.

    `include_dashboard=False` starts the last one all the same. Together they take 1.5 s of CPU time before the first
    trial, 200 MB of memory, and a second at the end. Nothing public of Ray 2.60 leaves them out.
    """
    node: Any = ray._private.node.Node  # noqa: SLF001
    with contextlib.ExitStack() as stack:
        for name in _UNUSED:
            if hasattr(node, name):
                stack.enter_context(replaced(node, name, lambda *_, **__: None))
        yield


_AGENT = "--dashboard_agent_command="
# The quote is there where the path has a space.
_AGENTS_PROGRAM = re.compile(r'/agent\.py"? ')


@contextlib.contextmanager
def without_dashboards_agent() -> Iterator[None]:
    """Let `idle_agent` take the place of the dashboard's agent in a Ray that is started in the block.

    Ray loads what the agent needs to see whether it is there, which takes a third of a second, and the raylet waits for
    it before it starts the first process, for most of a second of CPU time. Nothing public of Ray 2.60 leaves it out.
    """
    services: Any = ray._private.services  # noqa: SLF001
    original = services.start_ray_process
    error_of_agent = ray._private.utils.get_dashboard_dependency_error  # noqa: SLF001

    def replacing(part: str) -> str:
        if not part.startswith(_AGENT):
            return part
        replaced_by = _of_an_idle_agent(part)
        if replaced_by is None:
            # Ray's own agent ends without it, where what it needs is missing, and the raylet with it.
            return part if error_of_agent() is None else f"{part} --minimal"
        return replaced_by

    def start(command: list[str], *args: Any, **kwargs: Any) -> Any:
        return original([replacing(part) for part in command], *args, **kwargs)

    def no_error() -> None:
        return None

    with (
        replaced(services, "start_ray_process", start),
        replaced(ray._private.utils, "get_dashboard_dependency_error", no_error),  # noqa: SLF001
    ):
        yield


def _of_an_idle_agent(part: str) -> str | None:
    """The command of the dashboard's agent, a part of a raylet's command, with another program; None: it is another."""
    found = _AGENTS_PROGRAM.search(part)
    if found is None:
        return None
    program = [sys.executable, "-I", "-S", str(Path(__file__).with_name("idle_agent.py"))]
    return f"{_AGENT}{subprocess.list2cmdline(program)} {part[found.end() :]}"


@contextlib.contextmanager
def with_python_quoted() -> Iterator[None]:
    """Let a Ray that is started in the block start its processes also where Python's path has a space, say.

    Ray 2.60 gives it to a shell as it is; see `setup_worker`.
    """
    if shlex.quote(sys.executable) == sys.executable:
        yield
        return
    # Ray takes it for a file in a folder of its own: a whole path leads out of there.
    program = str(Path(__file__).with_name("setup_worker.py"))
    with replaced(ray._private.ray_constants, "SETUP_WORKER_FILENAME", program):  # noqa: SLF001
        yield


@contextlib.contextmanager
def _finding_own_modules() -> Iterator[None]:
    """Let the processes that Ray starts find the user's own modules where this process found them.

    Ray itself passes on this process's working directory and the main script's folder, but not the rest of its path.
    """
    before = os.environ.get("PYTHONPATH")
    folders = [*module_folders(), *([before] if before else [])]
    if folders:
        os.environ["PYTHONPATH"] = os.pathsep.join(folders)
    try:
        yield
    finally:
        if before is not None:
            os.environ["PYTHONPATH"] = before
        else:
            os.environ.pop("PYTHONPATH", None)


@contextlib.contextmanager
def without_environments() -> Iterator[None]:
    """Let Tune's actors of the block have the environment of a Ray that was started here.

    Ray 2.60's Tune gives each actor a runtime environment, for one variable of PyTorch Lightning and what it passes on
    to other machines; so Ray starts new processes, and those that it has started for each CPU, or that wait with
    everything imported (`warm`), are of no use.
    """
    from ray.tune.execution import class_cache

    def get(self: Any, trainable: type[Any]) -> Any:
        known = self._cache
        if trainable not in known:
            known[trainable] = ray.remote(trainable)
        return known[trainable]

    with replaced(class_cache._ActorClassCache, "get", get):  # noqa: SLF001
        yield


def first_line(error: Exception) -> str:
    """What an error of Ray's says first; its name if it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
