"""Find the CPUs, GPUs and memory of this machine or of a cluster, and how many processes fit on it at once."""

from __future__ import annotations

import functools
import math
import os
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from tune_jobs.process.torch_build import uses_gpus

_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")
_MEMORY_INFO = Path("/proc/meminfo")
_GPUS = Path("/proc/driver/nvidia/gpus")
# A driver that is about to hang must not keep a plan waiting.
_GPUS_TOLD_WITHIN_S = 5.0


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
    in_cgroup: bool = False
    """Whether the memory is what the limit of a cgroup leaves: that of a batch job, of a service or of a container."""
    unusable_gpus: float = 0.0
    """GPUs that are there, and not counted: PyTorch is a build for CPUs alone."""
    more: str = "launch on a larger cluster with --address"
    """How to get more resources, for hints."""

    @property
    def has_available(self) -> str:
        """Whose memory it is, for notes: that it "has available"."""
        return f"{self.source} has available" + " within its cgroup's memory limit" * self.in_cgroup

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
    """Return what this process may use: CPUs and memory within affinity and its cgroup's limits, and visible GPUs.

    GPUs count if PyTorch can use them.
    """
    gpus = _visible_gpus()
    unusable = gpus if gpus and not uses_gpus() else 0.0
    available, left = _available_memory(_MEMORY_INFO), _cgroup_memory(_CGROUPS)
    in_cgroup = left is not None and (available is None or left < available)
    return Machine(
        usable_cpus(),
        gpus - unusable,
        unusable_gpus=unusable,
        memory_bytes=left if in_cgroup else available,
        in_cgroup=in_cgroup,
    )


def _times(available: float, wanted: float) -> int:
    """Return how often `wanted` GPUs fit; a share of a GPU is never split over two; 3 x 1/3 fit despite rounding."""
    return int(available) * math.floor(1 / wanted + 1e-9)


def usable_cpus() -> float:
    """Return how many CPUs of this machine this process may use; a whole number, as Ray counts them."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    quota = _cgroup_quota(_CGROUPS)
    # Ray counts whole CPUs; half a CPU still runs one process.
    return float(affinity if quota is None else max(1, min(affinity, math.ceil(quota))))


def _cgroups(root: Path, controller: str, own: Path) -> Iterator[Path]:
    """Yield the folders of the cgroups that a controller may limit this process by: its own, and all above it.

    A batch system and systemd set limits to a cgroup of their own, far below the root. Where a container sees only its
    part of the tree, its path is not there, and the root is its cgroup: not every folder exists.

    Args:
        root: Where cgroups are mounted: those of v2, or a folder for each controller of v1.
        controller: Its name.
        own: The file with the paths of this process.
    """
    paths = {root: "/", root / controller: "/"}
    try:
        lines = own.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        lines = []
    for line in lines:
        _, _, names_and_path = line.partition(":")
        names, _, path = names_and_path.partition(":")
        # One above the root of its namespace has a path with "..", which leads out of the tree.
        if ".." not in path.split("/"):
            if not names:
                paths[root] = path
            elif controller in names.split(","):
                paths[root / controller] = path
    for mount, path in paths.items():
        inner = PurePosixPath(path.lstrip("/"))
        yield from (mount / each for each in (inner, *inner.parents))


def _cgroup_quota(root: Path, own: Path = _OWN_CGROUPS) -> float | None:
    """Return the CPUs that this process may use by its cgroups (v2 and v1), or None if they aren't limited."""
    found = [_quota_of(folder) for folder in _cgroups(root, "cpu", own)]
    return min((quota for quota in found if quota is not None), default=None)


def _quota_of(folder: Path) -> float | None:
    try:
        quota, period = (folder / "cpu.max").read_text(encoding="ascii").split()
        return None if quota == "max" else int(quota) / int(period)
    except (OSError, ValueError, ZeroDivisionError):
        pass
    try:
        micros = int((folder / "cpu.cfs_quota_us").read_text(encoding="ascii"))
        return None if micros < 0 else micros / int((folder / "cpu.cfs_period_us").read_text(encoding="ascii"))
    except (OSError, ValueError, ZeroDivisionError):
        return None


def _visible_gpus() -> float:
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        # "NoDevFiles" is what Slurm gives to a job that has no GPU.
        return float(len([name for name in visible.split(",") if name.strip() not in ("", "-1", "NoDevFiles")]))
    if _GPUS.is_dir():
        return float(len(list(_GPUS.glob("*"))))
    return _listed_gpus()


@functools.cache
def _listed_gpus() -> float:
    """Return the GPUs that NVIDIA's tool lists: within WSL2 the driver is that of Windows, and not in /proc."""
    try:
        told = subprocess.run(
            ["nvidia-smi", "-L"],  # noqa: S607 (where it is depends on the system)
            capture_output=True,
            timeout=_GPUS_TOLD_WITHIN_S,
            check=False,
        )
    except (OSError, subprocess.SubprocessError):
        return 0.0
    # Parts of a GPU (MIG) have lines of their own, which are indented.
    return float(sum(line.startswith(b"GPU ") for line in told.stdout.splitlines()))


def _available_memory(path: Path) -> float | None:
    """Return Linux's estimate of the memory that can be used without swapping."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, IndexError, StopIteration):
        return None


def _cgroup_memory(root: Path, own: Path = _OWN_CGROUPS) -> float | None:
    """Return what the memory limits of this process's cgroups (v2 and v1) leave, or None without one."""
    found = [_memory_left_of(folder) for folder in _cgroups(root, "memory", own)]
    return min((left for left in found if left is not None), default=None)


def _memory_left_of(folder: Path) -> float | None:
    """Return what a cgroup's limit leaves; file caches are free."""
    for limit, usage, files in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        try:
            most = float(int((folder / limit).read_text(encoding="ascii")))
            used = int((folder / usage).read_text(encoding="ascii"))
            counts = (folder / "memory.stat").read_text(encoding="ascii").split()
            return max(0.0, most - used + int(counts[counts.index(files) + 1]))
        except (OSError, ValueError):
            continue
    return None
