"""How often the members of packs have failed, or were in a pack that died, and which of them go on alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

_DEATHS_IN_COMPANY = 2
"""How many times a member may be in a pack that dies before it continues alone."""


class PackFailures:
    """The failures of a run.

    Args:
        max_retries: How often a member that fails is retried.
    """

    def __init__(self, max_retries: int) -> None:
        self._max_retries = max_retries
        self._num_failures: Counter[str] = Counter()
        self._num_deaths: Counter[str] = Counter()

    def failed(self, trial_id: str) -> None:
        """Count the failure of a single member."""
        self._num_failures[trial_id] += 1

    def died(self, trial_id: str, *, in_company: bool) -> bool:
        """Count the death of a member's pack; return whether the member is not retried, as it alone was the cause."""
        if in_company:
            self._num_deaths[trial_id] += 1
        else:
            self._num_failures[trial_id] += 1
        return self._num_failures[trial_id] > self._max_retries

    def is_alone(self, trial_id: str) -> bool:
        """Whether a trial has no company in its pack, as it may be what ended others."""
        return self._num_deaths[trial_id] >= _DEATHS_IN_COMPANY

    def of(self, trial_ids: Iterable[str]) -> dict[str, int]:
        """Return how often each has failed; those that have not are left out."""
        return {name: self._num_failures[name] for name in trial_ids if self._num_failures[name]}
