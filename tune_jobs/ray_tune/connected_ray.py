"""Tell whose the Ray is that this process is connected to, and which resources it has."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import ray
from ray.util.placement_group import placement_group, remove_placement_group

from policies.errors import CannotRunError
from tune_jobs.plan.machine import Machine

# Ray reports freed resources a little later.
_FREED_WITHIN_S = 5.0
_POLL_INTERVAL_S = 0.1
_DEFAULT_CLIENT_PORT = "10001"


_num_of_sweeps = 0


@contextlib.contextmanager
def of_a_sweep() -> Iterator[None]:
    """Mark the connection to Ray in the block as made by a sweep for itself, and not by the caller."""
    global _num_of_sweeps  # noqa: PLW0603 (a process has one connection)
    _num_of_sweeps += 1
    try:
        yield
    finally:
        _num_of_sweeps -= 1


def is_of_a_sweep() -> bool:
    """Whether a sweep has made the connection, or is about to."""
    return _num_of_sweeps > 0


def address_for_others() -> str:
    """Return the address by which another process of this machine joins the same Ray."""
    return f"ray://{_client_address()}" if is_client() else str(ray.get_runtime_context().gcs_address)


def is_client() -> bool:
    """Whether this process joined Ray by `ray://`."""
    return bool(ray.util.client.ray.is_connected())


def alive_nodes() -> list[dict[str, Any]]:
    """Return the nodes that are alive, as Ray describes them."""
    return [node for node in ray.nodes() if node["Alive"]]


def cluster_machine(source: str) -> Machine:
    """Return the CPUs, GPUs and memory of the joined cluster's nodes."""
    resources = [node["Resources"] for node in alive_nodes()]
    nodes = tuple((float(node.get("CPU", 0)), float(node.get("GPU", 0))) for node in resources)
    num_cpus = sum(cpus for cpus, _ in nodes)
    # "memory" is what a node had free when its Ray started, minus the object store.
    shares = [node.get("memory", 0.0) / node["CPU"] for node in resources if node.get("CPU")]
    return Machine(
        num_cpus=num_cpus,
        num_gpus=sum(gpus for _, gpus in nodes),
        source=source,
        nodes=nodes,
        more="launch on a larger cluster, or let it wait for nodes with --wait-for-nodes SECONDS",
        memory_bytes=min(shares) * num_cpus if shares and min(shares) > 0 else None,
    )


def present_machine(source: str) -> Machine:
    """Return what the joined cluster has by now: all of it, or what is free if the caller joined it."""
    return cluster_machine(source) if is_of_a_sweep() else replace(connected_machine(), source=source)


class Asked:
    """Resources that the cluster was asked for.

    Args:
        bundles: Resources that have to be on one node each, by Ray's names.
    """

    def __init__(self, bundles: list[dict[str, float]]) -> None:
        self._group: Any = placement_group(bundles, strategy="PACK")
        self._is_there = self._group.ready()

    def let_go(self) -> None:
        """Give the resources back if they are there by now: the trials ask for them themselves."""
        if self._group is not None and ray.wait([self._is_there], timeout=0)[0]:
            self.withdraw()

    def withdraw(self) -> None:
        """Ask no more."""
        group, self._group = self._group, None
        if group is not None:
            remove_placement_group(group)


@contextlib.contextmanager
def asking_for(bundles: list[dict[str, float]]) -> Iterator[Asked]:
    """Ask the cluster's autoscaler, if it has one, for nodes that can hold these resources while the block runs.

    It is asked by a placement group that waits, as by Tune for the trials: several sweeps that wait are added up, and
    Ray itself takes it back when this process ends, however it ends. What the autoscaler's own interface
    takes is one request of the whole cluster, which each caller replaces, and which outlives them (ray issues 13534
    and 19785).

    Args:
        bundles: Resources that have to be on one node each, by Ray's names.
    """
    asked = Asked(bundles)
    try:
        yield asked
    finally:
        # Without the cluster there is no request either.
        with contextlib.suppress(Exception):
            asked.withdraw()


def connected_machine() -> Machine:
    """Return what is free in a Ray that the caller joined or started; the caller's actors may keep the rest forever."""
    machine = cluster_machine("the Ray that this process is connected to")
    machine = replace(machine, more="connect to one that has more, or free what is in use")
    if is_client():
        # Ray's client cannot ask what each node has left.
        return machine
    deadline = time.monotonic() + _FREED_WITHIN_S
    while (free := _free()) != machine.nodes and time.monotonic() < deadline:
        time.sleep(_POLL_INTERVAL_S)
    if free == machine.nodes:
        return machine
    num_cpus, num_gpus = sum(cpus for cpus, _ in free), sum(gpus for _, gpus in free)
    source = f"{machine.source} (of its {machine.num_cpus:g} CPUs and {machine.num_gpus:g} GPUs, the rest is in use)"
    share = num_cpus / machine.num_cpus if machine.num_cpus else 0.0
    memory = None if machine.memory_bytes is None else machine.memory_bytes * share
    return replace(machine, num_cpus=num_cpus, num_gpus=num_gpus, nodes=free, source=source, memory_bytes=memory)


def _free() -> tuple[tuple[float, float], ...]:
    """Return the free CPUs and GPUs, node by node."""
    known = ray._private.state.available_resources_per_node()  # noqa: SLF001 (what is public adds all nodes up)
    left = [known.get(node["NodeID"], {}) for node in alive_nodes()]
    return tuple((float(node.get("CPU", 0)), float(node.get("GPU", 0))) for node in left)


def check_connected_to(address: str | None) -> None:
    """Check that the Ray which this process is connected to is the wanted one.

    Args:
        address: The same as for `cluster.connect`; None and `auto` accept any.

    Raises:
        CannotRunError: The process is connected to another Ray.
    """
    if address is None or address == "auto":
        return
    here = _client_address() if is_client() else ray.get_runtime_context().gcs_address
    scheme, _, rest = address.rpartition("://")
    wanted = f"{rest}:{_DEFAULT_CLIENT_PORT}" if scheme and ":" not in rest else rest
    if bool(scheme) != is_client() or not _is_same(wanted, here):
        raise CannotRunError(
            f"This process is connected to the Ray at {'ray://' if is_client() else ''}{here}, not to {address}.",
            "Leave the address out to run there, or call ray.shutdown() first.",
        )


def _client_address() -> str:
    return str(ray.util.client.ray.get_context().client_worker._conn_str)  # noqa: SLF001 (told nowhere else)


def _is_same(wanted: str, connected: str) -> bool:
    """Whether two `host:port` are the same, even if the host is called by different names."""
    (host, _, port), (other_host, _, other_port) = wanted.rpartition(":"), connected.rpartition(":")
    if port != other_port:
        return False
    ours, theirs = _numbers_of(host), _numbers_of(other_host)
    return host == other_host or bool(ours & theirs) or (_are_here(ours) and _are_here(theirs))


def _numbers_of(host: str) -> set[str]:
    with contextlib.suppress(OSError):
        return {str(found[4][0]) for found in socket.getaddrinfo(host.strip("[]"), None)}
    return set()


def _are_here(numbers: set[str]) -> bool:
    """Whether one of these addresses is this machine's, as only those can be bound."""
    for number in numbers:
        family = socket.AF_INET6 if ":" in number else socket.AF_INET
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((number, 0))
            return True
    return False
