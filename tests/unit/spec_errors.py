"""A smallest sweep, and what is said of a wrong one."""

import pytest

from policies.errors import SpecError
from tune_jobs.spec.file import load_spec

MINIMAL = {"env": "CartPole-v1", "algorithm": "ppo"}


def errors(*, base=MINIMAL, overrides=(), **fields):
    with pytest.raises(SpecError) as caught:
        load_spec({**base, **fields}, overrides)
    assert caught.value.exit_code == 2
    assert caught.value.hint
    return caught.value.message


def write(tmp_path, text):
    path = tmp_path / "sweep.yaml"
    path.write_text(text, encoding="utf-8")
    return path
