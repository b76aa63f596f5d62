"""Spare Ray Tune (2.60) work for every trial and report whose outcome nobody reads."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from ray.tune.execution.tune_controller import TuneController

_Report = TypeVar("_Report")


@dataclass(frozen=True, repr=False)
class Sealed(Generic[_Report]):
    """A report on its way through Tune.

    Tune takes dicts apart and keeps statistics of every number in them; and it writes each result as a text, twice, for
    messages that nobody sees, which for pydantic's models takes longer than all that is done with a report.
    """

    report: _Report


@contextlib.contextmanager
def without_state_of_trials() -> Iterator[None]:
    """For the block, let Tune leave the trials out of the state that it saves.

    A run never goes on from that, but from the sweep's records. How often it is saved while trials run can be set; at
    the end it is saved in any case, and Tune looks whether its file is there.
    """
    original = TuneController._get_trial_checkpoints  # noqa: SLF001 (nothing public leaves them out)

    def none(_: Any) -> dict[str, str]:
        return {}

    TuneController._get_trial_checkpoints = none  # noqa: SLF001
    try:
        yield
    finally:
        TuneController._get_trial_checkpoints = original  # noqa: SLF001
