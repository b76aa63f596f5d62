"""A cluster whose nodes are processes of this machine, and a sweep driven on it."""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
import urllib.request
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from tests.benchmarks.cluster.measured import Driven
from tests.benchmarks.distant_store import REQUESTS
from tests.benchmarks.objects import distant_store
from tests.benchmarks.ppo import ROOT
from tests.cluster.ray_nodes import Cluster, kill_group

_LIMIT_S = 7_200.0
_TICKS_PER_S = 100.0


@contextlib.contextmanager
def cluster(num_nodes: int, cpus_a_node: int, cores: Sequence[int] = ()) -> Iterator[Cluster]:
    """Start a head, which runs no trial, and nodes, which do.

    Args:
        num_nodes: Nodes beside the head.
        cpus_a_node: CPUs that each says it has; trials that only wait need not have them.
        cores: The core on which each node is held; empty: all may use all.
    """
    with tempfile.TemporaryDirectory(prefix="tune-jobs-bench-") as folder:
        found = Cluster(Path(folder))
        found.environment |= {"PYTHONPATH": str(ROOT), "AWS_ACCESS_KEY_ID": "bench", "AWS_SECRET_ACCESS_KEY": "bench"}
        try:
            found.start_head(num_cpus=0)
            for number in range(num_nodes):
                pinned = ("taskset", "--cpu-list", str(cores[number])) if cores else ()
                found.start_worker(f"node{number}", num_cpus=cpus_a_node, prefix=pinned)
            yield found
        finally:
            found.stop()


def drive(nodes: Cluster, settings: Mapping[str, Any], *, objects: bool = False, **environment: str) -> Driven:
    """Launch a sweep on a cluster from a process of its own, and return what that took.

    Args:
        nodes: The cluster.
        settings: The sweep file's.
        objects: Keep the sweep in an object store that answers at once, in the place of a folder.
        environment: Further variables for the driver.

    Raises:
        RuntimeError: The driver failed, or trials did.
    """
    with tempfile.TemporaryDirectory(prefix="tune-jobs-bench-") as folder, contextlib.ExitStack() as stack:
        file = Path(folder) / "bench.yaml"
        file.write_text(yaml.safe_dump(dict(settings)), encoding="utf-8")
        storage, endpoint = f"{folder}/sweeps", ""
        if objects:
            endpoint = stack.enter_context(distant_store(0))
            storage = f"s3://bench/sweeps?endpoint={endpoint}"
        command = [sys.executable, "-m", "tests.benchmarks.cluster.driver", str(file), storage, nodes.address]
        before = _cpu_by_kind(nodes)
        process = nodes.begin(command, **environment)
        try:
            out, err = process.communicate(timeout=_LIMIT_S)
        finally:
            kill_group(process)
        if process.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}:\n{err[-3000:]}")
        after = _cpu_by_kind(nodes)
        found = Driven(**json.loads(out.splitlines()[-1]))
        if set(found.statuses) != {"completed"}:
            raise RuntimeError(f"Not all trials were completed: {found.statuses}.")
        requests = json.loads(urllib.request.urlopen(endpoint + REQUESTS).read()) if objects else {}
    return replace(found, daemons_cpu_s={kind: after[kind] - before[kind] for kind in after}, num_requests=requests)


def _cpu_by_kind(nodes: Cluster) -> defaultdict[str, float]:
    """CPU seconds of the daemons that Ray started for a cluster; those of its trials are not among them."""
    found: defaultdict[str, float] = defaultdict(float)
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if not folder.name.isdigit():
                continue
            command = (folder / "cmdline").read_text(errors="replace")
            if str(nodes.temporary) not in command and nodes.address not in command:
                continue
            kind = next((kind for kind in ("gcs_server", "raylet") if f"/{kind}\0" in command), "")
            if kind:
                fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
                found[kind] += (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
    return found
