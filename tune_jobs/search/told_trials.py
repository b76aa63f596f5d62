"""Points as Optuna's trials.

A study copies each trial that it is given, as deep as it goes, and a model is built anew for each point: with a
thousand known points the copies took most of the time. Nothing ever changes the trials that are made here, so that
copies of them may share what they consist of.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from optuna.distributions import BaseDistribution
from optuna.trial import FrozenTrial, TrialState

from tune_jobs.search.coordinates import to_optuna
from tune_jobs.search.history import KnownPoint
from tune_jobs.spec.domains import Domain

_NEVER = datetime.fromtimestamp(0, UTC)
"""When trials began and ended, which no model asks."""


class _Told(FrozenTrial):
    """A trial of which a study's copy is a number of its own, and otherwise the same."""

    def __deepcopy__(self, memo: dict[int, Any]) -> _Told:
        return copy.copy(self)


def told(space: Mapping[str, Domain], distributions: dict[str, BaseDistribution], known: KnownPoint) -> FrozenTrial:
    """Return a point as a trial, as `tune_jobs.search.tpe` says what Optuna is told of it.

    Args:
        space: The search space.
        distributions: Each domain in Optuna's form.
        known: The point, and what is known of it.
    """
    state, value, intermediate = TrialState.PRUNED, None, dict[int, float]()
    if known.is_running:
        state = TrialState.RUNNING
    elif known.score is not None and known.level is None:
        state, value = TrialState.COMPLETE, known.score
    elif known.score is not None and known.level is not None:
        intermediate = {known.level: known.score}
    return _Told(
        # A study gives it its own number and id.
        number=-1, trial_id=-1, state=state, value=value, intermediate_values=intermediate,
        params={name: to_optuna(domain, known.point[name]) for name, domain in space.items()},
        distributions=distributions, user_attrs={}, system_attrs={},
        datetime_start=_NEVER, datetime_complete=_NEVER if state.is_finished() else None,
    )  # fmt: skip
