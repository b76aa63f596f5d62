"""Start Ray on this machine for a sweep, at 127.0.0.1 alone and without what a sweep has no use for.

Nothing public of Ray 2.60 does most of this. Each place where Ray itself is changed says what it costs otherwise; where
a later Ray has no such place any more, it starts as it would by itself, or a test of this module says so.
"""

from __future__ import annotations

import contextlib
import os
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
from tune_jobs.ray_tune.environment import provide_token
from tune_jobs.ray_tune.forking import forked_workers
from tune_jobs.ray_tune.forks import ForkServer
from tune_jobs.ray_tune.replaced import replaced

# Weights travel inside checkpoints and results are small: RLlib needs little of Ray's object store.
_OBJECT_STORE_BYTES = 256 * 1024**2
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
    # A local sweep sends nothing anywhere; users who want Ray's usage statistics can set the variable.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    provide_token()
    resources: dict[str, Any] = {}
    if machine is not None:
        resources = {"num_cpus": int(machine.num_cpus), "num_gpus": int(machine.num_gpus)}
    try:
        with (
            _finding_own_modules(),
            _without_unused_processes(),
            without_dashboards_agent(),
            forked_workers(forks),
            _noticing_its_node(meanwhile),
            at_loopback(),
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
        raise CannotRunError(
            f"Ray cannot be started on this machine: {first_line(error)}",
            "Look for the cause in Ray's logs in /tmp/ray/session_latest/logs.",
        ) from error


@contextlib.contextmanager
def at_loopback() -> Iterator[None]:
    """Let a Ray that is started in the block listen at 127.0.0.1 alone, where no other machine reaches it.

    Ray 2.60 puts this machine's own address in the place of 127.0.0.1, also where it was given, and then listens at
    all addresses; but not on macOS and Windows, nor where this says that it is on one of them. A process that joins
    such a Ray has to do so too.
    """
    with replaced(ray._private.ray_constants, "ENABLE_RAY_CLUSTER", value=False):  # noqa: SLF001
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


@contextlib.contextmanager
def without_dashboards_agent() -> Iterator[None]:
    """Let `idle_agent` take the place of the dashboard's agent in a Ray that is started in the block.

    Ray loads what the agent needs to see whether it is there, which takes a third of a second, and the raylet waits for
    it before it starts the first process, for most of a second of CPU time. Nothing public of Ray 2.60 leaves it out.
    """
    services: Any = ray._private.services  # noqa: SLF001
    original = services.start_ray_process

    def start(command: list[str], *args: Any, **kwargs: Any) -> Any:
        return original([_of_an_idle_agent(part) for part in command], *args, **kwargs)

    def no_error() -> None:
        return None

    with (
        replaced(services, "start_ray_process", start),
        replaced(ray._private.utils, "get_dashboard_dependency_error", no_error),  # noqa: SLF001
    ):
        yield


def _of_an_idle_agent(part: str) -> str:
    """A part of a raylet's command; the command of the dashboard's agent, in one part, with another program."""
    if not part.startswith(_AGENT):
        return part
    _, found, options = part.partition(f"{os.sep}agent.py ")
    if not found or sys.platform == "win32":
        return part
    program = [sys.executable, "-I", "-S", str(Path(__file__).with_name("idle_agent.py"))]
    return f"{_AGENT}{subprocess.list2cmdline(program)} {options}"


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
