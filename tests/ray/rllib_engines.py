"""A fixture with an engine of RLlib's that is closed after the test; modules of tests import it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tune_jobs.training.rllib import RLlibEngine


@pytest.fixture
def engine() -> Iterator[RLlibEngine]:
    from tune_jobs.training.rllib import RLlibEngine

    engine = RLlibEngine()
    yield engine
    engine.close()
