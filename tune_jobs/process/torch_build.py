"""Tell what this installation of PyTorch was built for, without importing it, which takes seconds."""

from __future__ import annotations

import importlib.util
import runpy
from pathlib import Path


def uses_gpus() -> bool:
    """Whether PyTorch's build has CUDA, or ROCm in its place; False too where there is no PyTorch."""
    found = importlib.util.find_spec("torch")
    if found is None or found.origin is None:
        return False
    # A few assignments, which the package itself imports.
    built = runpy.run_path(str(Path(found.origin).with_name("version.py")))
    return any(built.get(name) is not None for name in ("cuda", "hip"))
