"""Faults of the nodes of a cluster, each a Ray node on this machine; a sweep joins the cluster."""

from __future__ import annotations

import contextlib
import functools
import random
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.cluster.ray_nodes import Cluster, Node
from tests.faults import kills
from tests.faults.forked import Process
from tests.faults.namespaces import network
from tests.faults.outcomes import Outcome
from tests.faults.single import during
from tests.faults.sweeps import ROOT, Before, Disturbed, Sweep, spec, wait_for

_CUT_S, _LEAVES_S, _CLOCK_OFF_S = 60.0, 90.0, 3600
_KILL_PROBABILITY, _KILL_INTERVAL_S, _NUM_WORKERS = 0.03, 10.0, 3
# So that a sweep takes ten minutes, in which nodes are lost several times; RLlib's episodes are evaluated longer.
_KILL_PACE_S = {"packed": 0.1, "rllib": 0.06}
_KILL_TRIALS: dict[str, Any] = {"num_samples": 4, "resources": {"max_concurrent": 4}}
_LOST = "was lost"
_CLOCKS = {"ahead": _CLOCK_OFF_S, "behind": -_CLOCK_OFF_S}


def all_of(folder: Path, kind: str, seed: int) -> dict[str, Callable[[Path], Outcome]]:
    """Each of these faults by its name, as a function of an empty folder.

    Args:
        folder: For the undisturbed sweeps.
        kind: Of sweep, `packed` or `rllib`.
        seed: Of the moments.
    """
    found: dict[str, Callable[[Path], Outcome]] = {}
    for name, act in (("head killed and back", head_killed), ("network of a node cut for a minute", network_cut)):
        found[f"{name}, {kind}"] = functools.partial(_beside, folder, kind, act)
    found[f"nodes killed at random, {kind}"] = lambda place: nodes_killed(
        place, kind, kills.reference(folder, kind, "-many", **_KILL_TRIALS), random.Random(f"{seed} {kind}")
    )
    for which, seconds in _CLOCKS.items():
        if shutil.which("faketime"):
            act = functools.partial(clock_off, which=which, seconds=seconds)
            found[f"clock of a node an hour {which}, {kind}"] = functools.partial(_beside, folder, kind, act)
        else:
            print(f"clock of a node an hour {which}, {kind}: not run, as there is no faketime")
    return found


def _beside(folder: Path, kind: str, act: Callable[[Path, str, Sweep], Outcome], place: Path) -> Outcome:
    return act(place, kind, kills.reference(folder, kind))


@contextlib.contextmanager
def _cluster(folder: Path, host: str = "127.0.0.1") -> Iterator[Cluster]:
    cluster = Cluster(folder, host)
    cluster.environment["PYTHONPATH"] = str(ROOT)
    try:
        cluster.start_head()
        yield cluster
    finally:
        cluster.stop()


def _sweep(folder: Path, kind: str, cluster: Cluster, **changes: Any) -> Sweep:
    # No failure is forgiven: the loss of a node is none.
    settings = spec(kind, folder, **{"max_retries": 0, **changes})
    return Sweep(folder, settings, cluster.environment, "--address", cluster.address)


def _training_on(node: Node, sweep: Sweep) -> list[int]:
    """The processes on a node that train trials with a checkpoint."""
    there = [record for record in sweep.records() if str(record["node"]).endswith(f"/{node.node_id[:8]}")]
    return [int(record["pid"]) for record in there if record["pid"] and sweep.newest(record["trial_id"])]


def head_killed(folder: Path, kind: str, undisturbed: Sweep) -> Outcome:
    """The head is gone and comes back with nothing; the sweep ends, says so, and is resumed there."""
    with _cluster(folder) as cluster:
        worker = cluster.start_worker("worker")

        def act(process: Process) -> list[str]:
            cluster.nodes["head"].crash()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_LEAVES_S)
            found = [] if process.poll() == 5 else [f"exit code {process.poll()} after the head was killed"]
            worker.crash()
            cluster.start_head()
            cluster.start_worker("worker")
            return found

        may = Disturbed(kind, notes=_LOST)
        return during(_sweep(folder, kind, cluster), f"head killed and back, {kind}", act, may, undisturbed)


def network_cut(folder: Path, kind: str, undisturbed: Sweep) -> Outcome:
    """A node that nobody reaches for a minute: its trials go on elsewhere, and what comes back is not written."""
    with network() as net, _cluster(folder, net.host) as cluster:
        number = net.add()
        worker = cluster.start_worker("worker", prefix=net.prefix(number), host=net.host_of(number))
        sweep = _sweep(folder, kind, cluster)

        def act(process: Process) -> list[str]:
            if not wait_for(lambda: bool(_training_on(worker, sweep)), process):
                return ["nothing trained on the node that was to be cut"]
            with net.cut(number):
                time.sleep(_CUT_S)
            return []

        may = Disturbed(kind, notes=_LOST)
        outcome = during(sweep, f"network of a node cut for a minute, {kind}", act, may, undisturbed)
        if not any(_LOST in note for record in sweep.records() for note in record["notes"]):
            outcome.problems.append("no trial noted that its node was lost")
        return outcome


def clock_off(folder: Path, kind: str, undisturbed: Sweep, *, which: str, seconds: int) -> Outcome:
    """A node whose clock is an hour ahead or behind trains as the others."""
    with _cluster(folder) as cluster:
        off = cluster.start_worker("worker", environment=_clock(seconds))
        sweep = _sweep(folder, kind, cluster)

        def act(process: Process) -> list[str]:
            if not wait_for(lambda: bool(_training_on(off, sweep)), process):
                return [f"nothing trained on the node {off.node_id[:8]}"]
            maps = [Path(f"/proc/{pid}/maps").read_text(encoding="utf-8") for pid in _training_on(off, sweep)]
            return [] if all("libfaketime" in text for text in maps) else ["a process there had the right time"]

        name = f"clock of a node an hour {which}, {kind}"
        return during(sweep, name, act, Disturbed(kind), undisturbed)


def _clock(seconds: int) -> dict[str, str]:
    """The variables of a program whose clock is so many seconds ahead; `faketime` itself would be its parent."""
    printed = subprocess.run(
        ["faketime", "-f", f"{seconds:+d}s", "env"], check=True, capture_output=True, text=True
    ).stdout.splitlines()
    return {name: value for name, _, value in (line.partition("=") for line in printed) if name in _OF_FAKETIME}


# Not FAKETIME_SHARED: that is gone with the program that is its parent.
_OF_FAKETIME = ("LD_PRELOAD", "FAKETIME")


def nodes_killed(folder: Path, kind: str, undisturbed: Sweep, rng: random.Random) -> Outcome:
    """Each node but the head is killed with p = .03 every 10 s, and another one joins; the sweep runs to its end.

    Args:
        folder: An empty folder.
        kind: Of sweep.
        undisturbed: Of as many trials.
        rng: For the moments and nodes.
    """
    with _cluster(folder) as cluster:
        workers: dict[str, Node] = {}
        numbers = iter(range(1000))

        def join() -> None:
            name = f"worker{next(numbers)}"
            workers[name] = cluster.start_worker(name)

        for _ in range(_NUM_WORKERS):
            join()
        sweep = _sweep(folder, kind, cluster, pace_s=_KILL_PACE_S[kind], **_KILL_TRIALS)
        met: list[Before] = []

        def act(process: Process) -> list[str]:
            due = time.monotonic()
            while process.poll() is None:
                # Also of those intervals that passed while a node joined.
                due += _KILL_INTERVAL_S
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(max(due - time.monotonic(), 0.0))
                for name in [name for name in workers if rng.random() < _KILL_PROBABILITY]:
                    workers.pop(name).crash()
                    cluster.nodes.pop(name)
                    met.append(Before(sweep))
                    join()
            return []

        outcome = during(sweep, f"nodes killed at random, {kind}", act, Disturbed(kind, notes=_LOST), undisturbed)
        lost = sum(_LOST in note for record in sweep.records() for note in record["notes"])
        outcome.moment += f", {len(met)} nodes killed, {lost} trials moved"
        outcome.recomputed = max((before.recomputed for before in met), default=None)
        outcome.problems += [problem for before in met for problem in before.problems()]
        if not lost:
            outcome.problems.append("no trial noted that its node was lost")
        return outcome
