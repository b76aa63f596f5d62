"""Find the CPUs, GPUs and memory of this machine or of a cluster, and how many processes fit on it at once."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from tune_jobs.process.torch_build import uses_gpus

_CGROUPS = Path("/sys/fs/cgroup")
_MEMORY_INFO = Path("/proc/meminfo")


@dataclass(frozen=True)
class Machine:
    """The CPUs, GPUs and memory that a sweep can use."""

    num_cpus: float
    num_gpus: float = 0.0
    source: str = "this machine"
    nodes: tuple[tuple[float, float], ...] = ()
    """The CPUs and the GPUs of each node of a cluster; empty: one node has everything."""
    memory_bytes: float | None = None
    """Available memory, in bytes; None: not known. On a cluster, every CPU counts with the memory per CPU of the node
    that has the least."""
    unusable_gpus: float = 0.0
    """GPUs that are there, and not counted: PyTorch is a build for CPUs alone."""
    more: str = "launch on a larger cluster with --address"
    """How to get more resources, for hints."""

    def fitting(self, cpus: float, gpus: float) -> float:
        """Return how many processes with these CPUs and GPUs fit at once, each on one node; infinite if both are 0."""
        nodes = self.nodes or ((self.num_cpus, self.num_gpus),)
        return sum(
            min(node_cpus // cpus if cpus else math.inf, _times(node_gpus, gpus) if gpus else math.inf)
            for node_cpus, node_gpus in nodes
        )

    def memory_per_process(self, num_processes: int, cpus: float) -> float | None:
        """Return the bytes that each process may use on the node where they get the least; None: not known.

        Args:
            num_processes: The number of processes; all of them may run on one node if it has the CPUs.
            cpus: CPUs of each process.
        """
        if self.memory_bytes is None or not self.num_cpus:
            return None
        shares = [
            self.memory_bytes * node_cpus / self.num_cpus / max(1, min(num_processes, node_cpus // cpus))
            for node_cpus, _ in self.nodes or ((self.num_cpus, self.num_gpus),)
            if node_cpus >= cpus
        ]
        return min(shares, default=self.memory_bytes)


def local_machine() -> Machine:
    """Return what this process may use: CPUs and memory within affinity and container limits, and visible GPUs.

    GPUs count if PyTorch can use them.
    """
    gpus = _visible_gpus()
    unusable = gpus if gpus and not uses_gpus() else 0.0
    return Machine(usable_cpus(), gpus - unusable, unusable_gpus=unusable, memory_bytes=_usable_memory())


def _times(available: float, wanted: float) -> int:
    """Return how often `wanted` GPUs fit; a share of a GPU is never split over two; 3 x 1/3 fit despite rounding."""
    return int(available) * math.floor(1 / wanted + 1e-9)


def usable_cpus() -> float:
    """Return how many CPUs of this machine this process may use; a whole number, as Ray counts them."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    quota = _cgroup_quota(_CGROUPS)
    # Ray counts whole CPUs; half a CPU still runs one process.
    return float(affinity if quota is None else max(1, min(affinity, math.ceil(quota))))


def _cgroup_quota(root: Path) -> float | None:
    """Return the CPUs that a container may use by its cgroup (v2, then v1), or None if it isn't limited."""
    try:
        quota, period = (root / "cpu.max").read_text(encoding="ascii").split()
        return None if quota == "max" else int(quota) / int(period)
    except (OSError, ValueError):
        pass
    try:
        micros = int((root / "cpu/cpu.cfs_quota_us").read_text(encoding="ascii"))
        return None if micros < 0 else micros / int((root / "cpu/cpu.cfs_period_us").read_text(encoding="ascii"))
    except (OSError, ValueError, ZeroDivisionError):
        return None


def _visible_gpus() -> float:
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return float(len([name for name in visible.split(",") if name.strip() not in ("", "-1")]))
    return float(len(list(Path("/proc/driver/nvidia/gpus").glob("*"))))


def _usable_memory() -> float | None:
    """Return the bytes that are available here, or None if the system does not say."""
    known = [bytes_ for bytes_ in (_available_memory(_MEMORY_INFO), _cgroup_memory(_CGROUPS)) if bytes_ is not None]
    return min(known, default=None)


def _available_memory(path: Path) -> float | None:
    """Return Linux's estimate of the memory that can be used without swapping."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, IndexError, StopIteration):
        return None


def _cgroup_memory(root: Path) -> float | None:
    """Return what a container's memory limit (cgroup v2, then v1) leaves, or None without one; file caches are free."""
    for limit, usage, files in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
    ):
        try:
            most = float(int((root / limit).read_text(encoding="ascii")))
            used = int((root / usage).read_text(encoding="ascii"))
            counts = (root / usage).with_name("memory.stat").read_text(encoding="ascii").split()
            return max(0.0, most - used + int(counts[counts.index(files) + 1]))
        except (OSError, ValueError):
            continue
    return None
