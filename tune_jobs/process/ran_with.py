"""What the numbers of a training may depend on besides its seed: the CPU, versions, environment variables.

Libraries choose their kernels by the CPU's instructions, and kernels add in different orders: the same training rounds
differently on another CPU, and after some updates it is another training.
"""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("tune-jobs", "ray", "torch", "gymnasium", "numpy")
# Which kernels OpenBLAS, MKL, oneDNN, PyTorch, NumPy and cuBLAS take, and on how many threads.
_VARIABLES = (
    "OPENBLAS_CORETYPE", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "MKL_CBWR",
    "MKL_ENABLE_INSTRUCTIONS", "MKL_DEBUG_CPU_TYPE", "ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA", "ATEN_CPU_CAPABILITY",
    "NPY_DISABLE_CPU_FEATURES", "NPY_ENABLE_CPU_FEATURES", "CUBLAS_WORKSPACE_CONFIG", "NVIDIA_TF32_OVERRIDE",
)  # fmt: skip
# The widest that the CPU has; a virtual machine may hide some.
_INSTRUCTIONS = ("avx512f", "avx2", "avx", "sse4_2", "sve", "asimd")
_CPUINFO = Path("/proc/cpuinfo")


@functools.cache
def ran_with() -> dict[str, str]:
    """Return what this process trains with; it is read once, as libraries do that too."""
    return {**_processor(_CPUINFO), **_gpu(), **versions(), **variables()}


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that matter."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def variables() -> dict[str, str]:
    """Return the environment variables that are set and may change how numbers are rounded."""
    return {name: os.environ[name] for name in _VARIABLES if name in os.environ}


def _processor(path: Path) -> dict[str, str]:
    """Return the CPU's name, and the widest instructions that it has."""
    told: dict[str, str] = {}
    with contextlib.suppress(OSError):
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            told.setdefault(key.strip(), value.strip())
    name = told.get("model name") or platform.processor() or platform.machine()
    flags = (told.get("flags") or told.get("Features") or "").split()
    widest = next((one for one in _INSTRUCTIONS if one in flags), None)
    return {"cpu": name} if widest is None else {"cpu": name, "instructions": widest}


def _gpu() -> dict[str, str]:
    """Return the GPU's name, if this process uses one; torch is not loaded for it."""
    torch: Any = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_initialized():
        return {}
    return {"gpu": str(torch.cuda.get_device_name())}
