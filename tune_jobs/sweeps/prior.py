"""Read the earlier sweeps that the search of a new one begins with."""

from __future__ import annotations

import re
from pathlib import Path

from analysis.records import PriorRecord
from policies.errors import NotFoundError, SpecError, shortened
from tune_jobs.search.prior import prior_record
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.sections import NAME_PATTERN
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.sources import find_sweep


def read_priors(spec: SweepSpec, storage: str | Path | None, *, by_name: bool = False) -> tuple[PriorRecord, ...]:
    """Return what the model of a new sweep begins with.

    Args:
        spec: The new sweep.
        storage: The storage in which names are looked up.
        by_name: Whether only names are allowed, and no places.

    Raises:
        NotFoundError: There is no such sweep.
        SpecError: One is of another algorithm or space, or tells nothing, or is named by its place where that is not
            allowed.
    """
    found = []
    for sweep in spec.prior:
        if by_name and re.fullmatch(NAME_PATTERN, sweep) is None:
            raise SpecError(
                f"prior: {shortened(sweep)} is no name of a sweep, and places are not read here.",
                "Name a sweep of this service.",
            )
        try:
            store = find_sweep(sweep, storage)
        except NotFoundError as error:
            raise NotFoundError(f"prior: {error.message}", error.hint) from error
        found.append(prior_record(spec, store.name, stored_spec(store.read_record()), store.read_trials()))
    return tuple(found)
