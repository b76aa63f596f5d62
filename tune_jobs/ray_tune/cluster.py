"""Connect to where a sweep runs: this machine, a Ray cluster that it is part of, or one reached as a Ray client.

The same sweep runs on all of them; only joining Ray, and checking the nodes (`node_checks`), differs.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import ray
from ray.exceptions import AuthenticationError

from policies.errors import CannotRunError
from tune_jobs.plan.machine import Machine
from tune_jobs.process.interruption import current
from tune_jobs.process.state import randomness_given_back
from tune_jobs.process.streams import quiet
from tune_jobs.ray_tune.address import named_cluster, recorded_cluster
from tune_jobs.ray_tune.answering import check_is_ray, wrong_token
from tune_jobs.ray_tune.connected_ray import (
    check_connected_to,
    cluster_machine,
    connected_machine,
    is_client,
    of_a_sweep,
)
from tune_jobs.ray_tune.environment import prepare_environment, variables_for_start
from tune_jobs.ray_tune.forks import Forked, ForkServer, fork_server
from tune_jobs.ray_tune.local_ray import QUIET, at_loopback, first_line, outside_of_uv, start, without_environments
from tune_jobs.ray_tune.processes import ending_if_it_fails
from tune_jobs.ray_tune.reaper import reaping

_MAX_JOIN_ATTEMPTS = 4


@dataclass(frozen=True)
class Connection:
    """A joined cluster."""

    address: str | None
    is_client: bool
    """Whether it was joined by `ray://`: then the trials' driver has to run on the cluster."""
    machine: Machine


@contextlib.contextmanager
def connect(
    address: str | None,
    machine: Machine | None = None,
    *,
    is_users: bool = False,
    forked: Forked | None = "packs",
    meanwhile: Callable[[], object] | None = None,
) -> Iterator[Connection]:
    """Join a cluster, or start Ray on this machine, for the duration of the block.

    A connection that the caller already has is used and kept if it is to the wanted address, or if none is given.

    Args:
        address: None: this machine; `auto`, `host:port` or `ray://host:port`.
        machine: The CPUs and GPUs to start Ray with on this machine.
        is_users: Whether the connection stands for one that the caller has in another process.
        forked: What a Ray of this machine forks (see `forking`); None: its processes import for themselves.
        meanwhile: What to do while a Ray of this machine starts, for which there is nothing to do but wait.

    Raises:
        CannotRunError: Nothing answers at the address, its Ray differs, Ray does not start, or the caller is connected
            to another one.
    """
    prepare_environment()
    if ray.is_initialized():
        check_connected_to(address)
        yield Connection(address, is_client(), connected_machine())
        return
    forks: ForkServer | None = None
    logger = logging.getLogger("ray")
    level = logger.level
    with contextlib.ExitStack() as stack:
        if not is_users:
            stack.enter_context(of_a_sweep())
        if address is None:
            stack.enter_context(reaping())
            if forked is not None and machine is not None and not machine.num_gpus:
                # A driver of a GPU does not survive a fork, and need not be asked whether something has loaded it.
                forks = stack.enter_context(fork_server(forked))
        try:
            with ending_if_it_fails(), _keeping_sigterm(), _deaf_to_hangups():
                if address is None:
                    start(machine, forks, meanwhile)
                    stack.enter_context(without_environments())
                else:
                    # One that a sweep's process started here for its others: a cluster's nodes are elsewhere.
                    is_ours = is_users and address.startswith("127.0.0.1:")
                    with at_loopback() if is_ours else contextlib.nullcontext():
                        _join(address)
            source = "this machine" if address is None else f"the cluster at {address}"
            yield Connection(address, is_client(), cluster_machine(source))
        finally:
            # A Ray that is shut down only in part would block the next one, and its processes would live on.
            with current().shielded(), _not_collecting():
                ray.shutdown()
                logger.setLevel(level)


@contextlib.contextmanager
def left_running(machine: Machine) -> Iterator[None]:
    """Start a Ray of this machine, unless one is joined, which runs on after the block if that does not fail.

    Args:
        machine: The CPUs and GPUs to start it with.

    Raises:
        CannotRunError: It does not start.
    """
    if ray.is_initialized():
        yield
        return
    logger = logging.getLogger("ray")
    level = logger.level
    with ending_if_it_fails():
        try:
            # Ray draws numbers, too.
            with _keeping_sigterm(), randomness_given_back(), variables_for_start():
                start(machine)
        finally:
            logger.setLevel(level)
        yield


@contextlib.contextmanager
def _not_collecting() -> Iterator[None]:
    """Let no thread collect garbage in the block.

    While Ray 2.60 shuts down, its native code ends the process at once, without a word, if an object reference is freed
    after its worker is gone and before Python has forgotten it. Ray Tune leaves such references in cycles, and another
    thread, such as one that imports modules, may be in that gap when a collection is due.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextlib.contextmanager
def _keeping_sigterm() -> Iterator[None]:
    """Keep the present handler of SIGTERM, in the block and after it.

    Ray 2.60's `init` sets a handler that ends the process at once. Its native code puts another one before Python's
    (Abseil's, for failures), which calls Python's handler and aborts the process 3 s later, even if that still saves.
    """
    utils = ray._private.utils  # noqa: SLF001 (nothing public keeps it from that)
    original = utils.set_sigterm_handler
    utils.set_sigterm_handler = lambda _: None
    try:
        yield
    finally:
        utils.set_sigterm_handler = original
        handler = signal.getsignal(signal.SIGTERM)
        if threading.current_thread() is threading.main_thread() and handler is not None:
            # Python's handler is the same as before; this still restores the one that the system calls.
            signal.signal(signal.SIGTERM, handler)
            if current().came:
                # A signal may have come while Ray's handler was set.
                signal.alarm(0)


@contextlib.contextmanager
def _deaf_to_hangups() -> Iterator[None]:
    """Let processes that are started in the block ignore SIGHUP, which a closed terminal sends to all its processes.

    Ray 2.60 does the same with SIGINT. Otherwise Ray would end before the trials have saved. In this process the signal
    is handled at the end of the block.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _join(address: str) -> None:
    check_is_ray(address)
    # Ray's native code prints a warning for each of its attempts.
    with tempfile.NamedTemporaryFile(prefix="tune-jobs-join-") as file:
        try:
            with quiet(Path(file.name)), outside_of_uv():
                _init_patiently(address)
        except Exception as error:
            said = Path(file.name).read_text(encoding="utf-8", errors="replace")
            if "InvalidAuthToken" in said or isinstance(error, AuthenticationError):
                raise wrong_token(address) from error
            raise CannotRunError(
                f"The Ray cluster at {address} cannot be joined: {first_line(error)}",
                "Its Ray and Python must be of this machine's versions, and its token (RAY_AUTH_TOKEN) the same. "
                "host:port is for machines that are nodes of the cluster; others join by ray://HOST:10001.",
            ) from error
    joined = ray.get_runtime_context().gcs_address if address == "auto" else None
    if joined is not None and named_cluster() is None and joined != recorded_cluster():
        # Ray 2.60 prefers a single cluster among this machine's processes, such as another sweep's, which ends with it.
        ray.shutdown()
        raise CannotRunError(
            f"`auto` found the Ray at {joined}, but `ray start` last joined {recorded_cluster()}.",
            f"Choose one with --address, for example --address {recorded_cluster()}.",
        )


def _init_patiently(address: str) -> None:
    for attempt in range(1, _MAX_JOIN_ATTEMPTS + 1):
        try:
            ray.init(address=address, **QUIET)
            return
        except ConnectionError as error:
            # Ray 2.60's client proxy forks a server for each client, and one in twenty dies at once in gRPC's fork
            # handlers (ray issue 63202), unless the head was started with GRPC_ENABLE_FORK_SUPPORT=0.
            if "Starting Ray client server failed" not in str(error) or attempt == _MAX_JOIN_ATTEMPTS:
                raise
