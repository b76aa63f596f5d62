"""What the guard's child is started with."""

import sys
from pathlib import Path

import pytest

from policies.guard.guard import _Surroundings


def test_a_python_without_arguments_has_the_working_directory_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one that is embedded in another program."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [])
    assert _Surroundings.now().folders == (str(tmp_path),)
