"""Fixtures of the tests of the command line, of stores, and of those that compute."""

from collections.abc import Iterator

import pytest
from alembic.config import Config
from alembic.script import ScriptDirectory
from fake_sweeps import run, sweeps
from s3_faults import faults, opened, url
from store_parts import another, harness, sweep, trial
from sweep_folders import sweep_template

__all__ = [
    "another", "faults", "harness", "in_double", "opened", "run", "sweep", "sweep_template", "sweeps", "trial", "url",
]  # fmt: skip


@pytest.fixture
def in_double() -> Iterator[None]:
    """New tensors are of float64: formulas can be compared without their rounding."""
    import torch

    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture(scope="session", autouse=True)
def _migrations_are_read_once() -> Iterator[None]:
    """Each database that is opened reads and runs the files of all migrations twice, most of what its opening takes."""
    found: dict[str | None, ScriptDirectory] = {}
    from_config = ScriptDirectory.from_config

    def read_once(config: Config) -> ScriptDirectory:
        place = config.get_main_option("script_location")
        if place not in found:
            found[place] = from_config(config)
        return found[place]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ScriptDirectory, "from_config", read_once)
        yield
