"""What this machine has for a sweep: limits of the cgroups that this process is in, and GPUs."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from policies.errors import CannotRunError
from tune_jobs.plan import machine as machine_module
from tune_jobs.plan.machine import Machine, local_machine
from tune_jobs.plan.memory import lowered_by_memory
from tune_jobs.ray_tune import local_ray

TASK = "/system.slice/slurmstepd.scope/job_7/step_0/user/task_0"
JOB = TASK.removesuffix("/step_0/user/task_0")
V2 = f"0::{TASK}\n"
V1 = f"12:pids:/\n5:memory:{TASK}\n4:cpu,cpuacct:{TASK}\n1:name=systemd:{TASK}\n0::/\n"


def made(folder: Path, own: str, files: dict[str, str]) -> tuple[Path, Path]:
    """Write files of cgroups, and a process's list of them."""
    for name, text in files.items():
        path = folder / "cgroup" / name.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (folder / "own").write_text(own)
    return folder / "cgroup", folder / "own"


def v2_memory(cgroup: str, most: str, used: int, files: int = 0) -> dict[str, str]:
    names = ("memory.max", "memory.current", "memory.stat")
    texts = (f"{most}\n", f"{used}\n", f"anon 1\ninactive_file {files}\n")
    return dict(zip((f"{cgroup}/{name}" for name in names), texts, strict=True))


def v1_memory(cgroup: str, most: int, used: int) -> dict[str, str]:
    names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "memory.stat")
    texts = (f"{most}\n", f"{used}\n", "total_inactive_file 0\n")
    return dict(zip((f"memory{cgroup}/{name}" for name in names), texts, strict=True))


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        # A batch system's limit is that of the job, above the process's own cgroup.
        (V2, v2_memory(JOB, "5000", 3000, 200) | v2_memory(TASK, "max", 3000), 2200),
        # systemd's is that of the unit; the root of v2 has no such file.
        ("0::/system.slice/tune-jobs.service\n", v2_memory("/system.slice/tune-jobs.service", "5000", 1000), 4000),
        # What is left least counts: a slice that others use, too.
        (V2, v2_memory(JOB, "5000", 3000) | v2_memory("/system.slice", "9000", 8500), 500),
        (V1, v1_memory(JOB, 5000, 4000) | v1_memory("", 2**63 - 4096, 9000), 1000),
        # A container whose mount begins at its own cgroup, and a path that leads out of its namespace.
        (V1, v1_memory("", 5000, 4000), 1000),
        ("0::/../job\n", v2_memory("", "5000", 4000) | v2_memory("../job", "5000", 4999), 1000),
        # Others' limits are not this process's.
        (V2, v2_memory("/system.slice/slurmstepd.scope/job_8", "5000", 4000), None),
        ("odd\n", v2_memory("", "5000", 4000), 1000),
    ],
)
def test_the_memory_limit_of_a_cgroup_below_the_root_counts(
    tmp_path: Path, own: str, files: dict[str, str], expected: float | None
) -> None:
    assert machine_module._cgroup_memory(*made(tmp_path, own, files)) == expected


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        (V2, {f"{JOB}/cpu.max": "150000 100000\n", f"{TASK}/cpu.max": "max 100000\n"}, 1.5),
        (V2, {f"{JOB}/cpu.max": "400000 100000\n", f"{TASK}/cpu.max": "200000 100000\n"}, 2),
        (V1, {f"cpu{JOB}/cpu.cfs_quota_us": "300000\n", f"cpu{JOB}/cpu.cfs_period_us": "100000\n"}, 3),
        (V1, {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None),
    ],
)
def test_the_cpu_quota_of_a_cgroup_below_the_root_counts(
    tmp_path: Path, own: str, files: dict[str, str], expected: float | None
) -> None:
    assert machine_module._cgroup_quota(*made(tmp_path, own, files)) == expected


def test_notes_say_that_memory_is_limited_by_a_cgroup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, _ = made(tmp_path, "", v2_memory("", "1000000", 0))
    monkeypatch.setattr(machine_module, "_CGROUPS", root)
    machine = local_machine()
    assert (machine.memory_bytes, machine.in_cgroup) == (1e6, True)
    _, (note,) = lowered_by_memory(machine, 9e5, 1, cpus=1, algorithm="ppo")
    assert "more than half of what this machine has available within its cgroup's memory limit, 500.0 kB" in note
    monkeypatch.setattr(machine_module, "_CGROUPS", tmp_path)
    assert (local_machine().in_cgroup, local_machine().has_available) == (False, "this machine has available")


@pytest.mark.parametrize(("memory_bytes", "expected"), [(3e9, 3e9 - 256 * 1024**2), (3e8, None), (None, None)])
def test_a_ray_that_is_started_here_is_told_the_memory_that_is_planned_with(
    monkeypatch: pytest.MonkeyPatch, memory_bytes: float | None, expected: float | None
) -> None:
    told: list[dict[str, Any]] = []

    def init(**how: Any) -> None:
        told.append(how)
        raise RuntimeError("far enough")

    monkeypatch.setattr("ray.init", init)
    with pytest.raises(CannotRunError, match="far enough"):
        local_ray.start(Machine(2, memory_bytes=memory_bytes))
    assert told[0].get("_memory") == expected


# -- GPUs


def test_a_job_that_a_batch_system_gives_no_gpu_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "NoDevFiles")
    monkeypatch.setattr(machine_module, "uses_gpus", lambda: True)
    assert (local_machine().num_gpus, local_machine().unusable_gpus) == (0, 0)


@pytest.fixture
def tool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The path of NVIDIA's tool, which is not there, on a system whose /proc tells of no GPU."""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(machine_module, "_GPUS", tmp_path / "none")
    monkeypatch.setattr(machine_module, "uses_gpus", lambda: True)
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin") + os.pathsep + os.environ["PATH"])
    machine_module._listed_gpus.cache_clear()
    yield tmp_path / "bin" / "nvidia-smi"
    machine_module._listed_gpus.cache_clear()


@pytest.mark.parametrize(
    ("does", "expected"),
    [
        ("printf 'GPU 0: NVIDIA A (UUID: a)\\n  MIG 1g.10gb Device 0: (UUID: b)\\nGPU 1: NVIDIA A (UUID: c)\\n'", 2),
        ("echo NVIDIA-SMI has failed; exit 9", 0),
        ("exec sleep 60", 0),
    ],
)
def test_where_proc_tells_of_no_gpus_those_count_that_nvidias_tool_lists(
    tool: Path, monkeypatch: pytest.MonkeyPatch, does: str, expected: int
) -> None:
    if "sleep" in does:
        monkeypatch.setattr(machine_module, "_GPUS_TOLD_WITHIN_S", 0.2)
    tool.write_text(f"#!/bin/sh\n{does}\n")
    tool.chmod(0o755)
    assert local_machine().num_gpus == expected


def test_without_nvidias_tool_there_is_no_gpu(tool: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tool.parent))
    assert local_machine().num_gpus == 0


def test_what_proc_tells_of_gpus_is_not_asked_again(
    tool: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gpus" / "0000:01:00.0").mkdir(parents=True)
    monkeypatch.setattr(machine_module, "_GPUS", tmp_path / "gpus")
    tool.write_text("#!/bin/sh\necho GPU 0; echo GPU 1\n")
    tool.chmod(0o755)
    assert local_machine().num_gpus == 1
