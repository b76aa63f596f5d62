"""Faults of the nodes of a cluster, each a Ray node on this machine; a sweep in packs joins the cluster."""

from __future__ import annotations

import contextlib
import random
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.cluster.ray_nodes import Cluster, Node
from tests.faults.forked import Process
from tests.faults.namespaces import network
from tests.faults.outcomes import Outcome
from tests.faults.single import during
from tests.faults.sweeps import ROOT, Disturbed, Sweep, spec

_CUT_S, _LEAVES_S, _CLOCK_OFF_S = 60.0, 90.0, 3600
_KILL_PROBABILITY, _KILL_INTERVAL_S, _NUM_WORKERS = 0.03, 10.0, 3
_LOST = Disturbed("packed", notes="was lost")


def all_of(undisturbed: Callable[[], Sweep], seed: int) -> dict[str, Callable[[Path], Outcome]]:
    """Each of these faults by its name, as a function of an empty folder.

    Args:
        undisturbed: Makes the undisturbed sweep in packs.
        seed: Of the moments.
    """
    found: dict[str, Callable[[Path], Outcome]] = {
        "head killed and back": lambda folder: head_killed(folder, undisturbed()),
        "network of a node cut for a minute": lambda folder: network_cut(folder, undisturbed()),
        "nodes killed at random": lambda folder: nodes_killed(folder, undisturbed(), random.Random(seed)),
    }
    if shutil.which("faketime"):
        found["clock of a node an hour off"] = lambda folder: clock_off(folder, undisturbed())
    else:
        print("clock of a node an hour off: not run, as there is no faketime")
    return found


@contextlib.contextmanager
def _cluster(folder: Path, host: str = "127.0.0.1") -> Iterator[Cluster]:
    cluster = Cluster(folder, host)
    cluster.environment["PYTHONPATH"] = str(ROOT)
    try:
        cluster.start_head()
        yield cluster
    finally:
        cluster.stop()


def _sweep(folder: Path, cluster: Cluster, **changes: object) -> Sweep:
    # No failure is forgiven: the loss of a node is none.
    settings = spec("packed", folder, max_retries=0, **changes)
    return Sweep(folder, settings, cluster.environment, "--address", cluster.address)


def head_killed(folder: Path, undisturbed: Sweep) -> Outcome:
    """The head is gone and comes back with nothing; the sweep ends, says so, and is resumed there."""
    with _cluster(folder) as cluster:
        worker = cluster.start_worker("worker")

        def act(process: Process) -> list[str]:
            cluster.nodes["head"].crash()
            with contextlib.suppress(Exception):
                process.wait(_LEAVES_S)
            found = [] if process.poll() == 5 else [f"exit code {process.poll()} after the head was killed"]
            worker.crash()
            cluster.start_head()
            cluster.start_worker("worker")
            return found

        return during(_sweep(folder, cluster), "head killed and back", act, _LOST, undisturbed)


def network_cut(folder: Path, undisturbed: Sweep) -> Outcome:
    """A node that nobody reaches for a minute: its trials go on elsewhere, and what comes back is not written."""
    with network() as net, _cluster(folder, net.host) as cluster:
        number = net.add()
        cluster.start_worker("worker", prefix=net.prefix(number), host=net.host_of(number))
        sweep = _sweep(folder, cluster)

        def act(_: Process) -> list[str]:
            nodes = {record["node"].partition("/")[0] for record in sweep.records() if record["node"]}
            with net.cut(number):
                time.sleep(_CUT_S)
            return [] if net.host_of(number) in nodes else [f"nothing trained on the node that was cut: {nodes}"]

        outcome = during(sweep, "network of a node cut for a minute", act, _LOST, undisturbed)
        if not any("was lost" in note for record in sweep.records() for note in record["notes"]):
            outcome.problems.append("no trial noted that its node was lost")
        return outcome


def clock_off(folder: Path, undisturbed: Sweep) -> Outcome:
    """A node whose clock is an hour ahead trains as the others."""
    with _cluster(folder) as cluster:
        prefix = (str(shutil.which("faketime")), "-f", f"+{_CLOCK_OFF_S}s")
        off = cluster.start_worker("worker", prefix=prefix)
        sweep = _sweep(folder, cluster)

        def act(_: Process) -> list[str]:
            nodes = {record["node"].partition("/")[2] for record in sweep.records() if record["node"]}
            return [] if off.node_id[:8] in nodes else [f"nothing trained on the node {off.node_id[:8]}: {nodes}"]

        return during(sweep, "clock of a node an hour off", act, Disturbed("packed"), undisturbed)


def nodes_killed(folder: Path, undisturbed: Sweep, rng: random.Random) -> Outcome:
    """Each node but the head is killed with p = .03 every 10 s, and another one joins; the sweep runs to its end."""
    with _cluster(folder) as cluster:
        workers: dict[str, Node] = {}
        numbers = iter(range(1000))

        def join() -> None:
            name = f"worker{next(numbers)}"
            workers[name] = cluster.start_worker(name)

        for _ in range(_NUM_WORKERS):
            join()
        sweep = _sweep(folder, cluster)
        killed = 0

        def act(process: Process) -> list[str]:
            nonlocal killed
            while process.poll() is None:
                time.sleep(_KILL_INTERVAL_S)
                for name in [name for name in workers if rng.random() < _KILL_PROBABILITY]:
                    workers.pop(name).crash()
                    cluster.nodes.pop(name)
                    killed += 1
                    join()
            return []

        outcome = during(sweep, "nodes killed at random", act, _LOST, undisturbed)
        outcome.moment += f", {killed} nodes killed"
        return outcome
