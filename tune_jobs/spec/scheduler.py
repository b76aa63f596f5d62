"""The section `scheduler` of a sweep file: whether trials are ended early, or go on from copies of others."""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, SerializerFunctionWrapHandler, model_serializer

from policies.errors import shortened
from tune_jobs.spec.domain_kinds import Number
from tune_jobs.spec.fields import PositiveWhole, Section

SchedulerType = Literal["none", "asha", "hyperband", "median", "pbt", "pb2"]
SMALLEST_SUBPOPULATION = 3
"""One is copied, one is replaced by the copy, and one goes on from a trial of another sub-population."""


def _rising(given: tuple[int, ...]) -> tuple[int, ...]:
    """Return the frequencies of sub-populations if they begin with 1 and rise.

    Raises:
        ValueError: They don't.
    """
    if given[:1] != (1,) or any(later <= earlier for earlier, later in itertools.pairwise(given)):
        raise ValueError(
            f"{shortened(list(given))} should begin with 1 and rise, such as [1, 5]: the first sub-population is "
            "compared every perturb_every_env_steps, each other one after so many times that"
        )
    return given


class SchedulerSpec(Section):
    """Whether trials that do worse than others after the same env steps are ended early, or continue from copies."""

    type: SchedulerType = Field(
        "none",
        description="none, asha (successive halving), hyperband, median (worse than the median), pbt (population "
        "based training: the worst continue from copies of the best, with mutated hyperparameters) or pb2 (the same, "
        "with values within ranges chosen by a model of what intervals gained).",
    )
    grace_env_steps: PositiveWhole | None = Field(
        None, description="No trial is ended before this many env steps; null: 1/20 of stop.num_env_steps."
    )
    reduction_factor: Annotated[Number, Field(gt=1)] = Field(
        3.0, description="asha, hyperband: one trial in this many continues at each rung."
    )
    perturb_every_env_steps: PositiveWhole | None = Field(
        None, description="pbt, pb2: env steps between two comparisons of a trial; null: 1/10 of stop.num_env_steps."
    )
    quantile_fraction: Annotated[Number, Field(gt=0, le=0.5)] = Field(
        0.25, description="pbt, pb2: the worst share of the trials, which copies the best share."
    )
    resample_probability: Annotated[Number, Field(ge=0, le=1)] = Field(
        0.25,
        description="pbt, and lists with pb2: share of mutations that draw a new value; the others move to a "
        "neighbouring one.",
    )
    frequencies: Annotated[tuple[PositiveWhole, ...], AfterValidator(_rising)] = Field(
        (1,),
        description="pbt: one for each sub-population, whose trials are compared with each other alone: after how many "
        "times perturb_every_env_steps, as in [1, 5]. [1]: all trials are one population.",
    )

    @property
    def waits_for_others(self) -> bool:
        """Whether trials wait at numbers of env steps until others have come as far."""
        return self.type == "hyperband" or self.is_population

    @property
    def is_population(self) -> bool:
        """Whether trials go on from copies of others, with other values."""
        return self.type in ("pbt", "pb2")

    @model_serializer(mode="wrap")
    def _only_if_set(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Versions that don't know the field read sweeps that don't use it.
        content: dict[str, Any] = handler(self)
        if self.frequencies == (1,):
            content.pop("frequencies", None)
        return content


def num_worst(num_trials: int, fraction: float) -> int:
    """Return how many trials are the worst, and how many are the best: at least one, unless there is one alone."""
    # 0.28 of 25 are 7, though their product is a little more in floats.
    return min(max(1, math.ceil(num_trials * fraction - 1e-9)), num_trials // 2)
