"""A store that somebody has started takes part in the tests of what all stores promise, or this says that none does."""

import os
from pathlib import Path

import pytest
from stores import HARNESSES, STORAGE_VARIABLE


@pytest.mark.skipif(
    STORAGE_VARIABLE not in os.environ,
    reason=f"{STORAGE_VARIABLE} is not set: what all stores promise is not tried on a store that runs",
)
def test_a_store_that_runs_is_one_of_those_that_are_tried(tmp_path: Path) -> None:
    place = os.environ[STORAGE_VARIABLE].partition("?")[0]
    assert HARNESSES["running"](tmp_path).storage().place.startswith(place)
