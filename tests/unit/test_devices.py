"""Where trials compute, and what PyTorch was built for; no GPU is needed."""

import sys
import types
from pathlib import Path

import pytest

from policies.errors import CannotRunError
from tune_jobs.process import torch_build
from tune_jobs.training import devices


@pytest.mark.parametrize(("num_gpus", "sees", "device"), [(0, True, "cpu"), (0, False, "cpu"), (0.25, True, "cuda")])
def test_a_trial_computes_where_it_was_told(
    monkeypatch: pytest.MonkeyPatch, num_gpus: float, sees: bool, device: str
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: sees)
    assert devices.device_for(num_gpus) == device


def test_a_trial_that_was_given_a_gpu_never_trains_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(CannotRunError, match=r"num_gpus is 0\.5, and PyTorch .* sees no GPU on"):
        devices.device_for(0.5)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("__version__ = '2'\ncuda: str | None = '13.0'\nhip: str | None = None\n", True),
        ("__version__ = '2'\ncuda: str | None = None\nhip: str | None = '6.4'\n", True),
        ("__version__ = '2'\ncuda: str | None = None\nhip: str | None = None\n", False),
    ],
)
def test_what_pytorch_was_built_for_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, expected: bool
) -> None:
    (tmp_path / "version.py").write_text(f"from __future__ import annotations\n{text}")
    spec = types.SimpleNamespace(origin=str(tmp_path / "__init__.py"))
    monkeypatch.setattr("importlib.util.find_spec", lambda _: spec)
    assert torch_build.uses_gpus() is expected


def test_of_the_pytorch_that_is_here_it_says_what_that_says(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    assert torch_build.uses_gpus() is (torch.version.cuda is not None or torch.version.hip is not None)
    monkeypatch.setitem(sys.modules, "torch", None)
    assert not torch_build.uses_gpus()
