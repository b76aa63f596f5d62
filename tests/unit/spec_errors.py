"""A smallest sweep, and what is said of a wrong one."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from policies.errors import SpecError
from tune_jobs.spec.file import load_spec

MINIMAL: dict[str, Any] = {"env": "CartPole-v1", "algorithm": "ppo"}


def errors(*, base: Mapping[str, Any] = MINIMAL, overrides: Sequence[str] = (), **fields: Any) -> str:
    with pytest.raises(SpecError) as caught:
        load_spec({**base, **fields}, overrides)
    assert caught.value.exit_code == 2
    assert caught.value.hint
    return caught.value.message


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "sweep.yaml"
    path.write_text(text, encoding="utf-8")
    return path
