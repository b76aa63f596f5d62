"""Find a sweep's points that are known before it starts, and the largest trials that unknown points may have."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

from analysis.numbering import with_chosen
from analysis.records import ChosenPointRecord
from policies.errors import SpecError
from policies.hyperparams import Hyperparams
from tune_jobs.spec.domains import Domain, Layers, Listed, Range
from tune_jobs.spec.draws import draw_first_points, draw_points
from tune_jobs.spec.hyperparam_problems import as_taken
from tune_jobs.spec.sweep_spec import SweepSpec

_MAX_COMBINATIONS = 10_000
_DECIDE_SIZE = (
    "num_envs", "train_batch_size", "env_steps_per_iteration", "hidden_sizes", "conv_filters", "vf_share_layers",
    "replay_capacity", "minibatch_size", "train_freq", "replay",
)  # fmt: skip
"""The hyperparameters that a trial's env steps, disk space and memory depend on."""
_GREATEST_IS_LARGEST = ("minibatch_size", "train_freq")
"""Those of which the greatest value alone is needed, as estimates only grow with it."""
_REPLAYS = ("none", "uniform", "prioritized")
"""Kinds of replay memory, the smallest first."""


def planned_points(spec: SweepSpec, chosen_points: Sequence[ChosenPointRecord] = ()) -> list[dict[str, Any] | None]:
    """Return the point of each index; None: the search method chooses it when its trial starts.

    Args:
        spec: The sweep.
        chosen_points: Points that somebody chose, oldest first.

    Raises:
        ValueError: As for `with_chosen`.
    """
    return with_chosen(_drawn_points(spec), chosen_points)


def _drawn_points(spec: SweepSpec) -> list[dict[str, Any] | None]:
    if not spec.search.has_model:
        return list(draw_points(spec.space, spec.num_samples, spec.seed))
    # With a prior the model may propose from the first on; one point is known, from which sizes are estimated.
    num_random = min(1 if spec.prior else spec.search.num_startup_trials, spec.num_samples)
    return [*draw_first_points(spec.space, num_random, spec.seed), *[None] * (spec.num_samples - num_random)]


def largest_hyperparams(spec: SweepSpec, known: Sequence[Hyperparams]) -> list[Hyperparams]:
    """Return hyperparameters whose trials are at least as large as any point's; they need not be valid together.

    Args:
        spec: The sweep.
        known: The hyperparameters of the points that are known; at least one.

    Raises:
        SpecError: There are too many combinations to check.
    """
    ends = {name: _ends(spec, name) for name in spec.space if name in _DECIDE_SIZE}
    combinations = math.prod(map(len, ends.values()))
    if combinations > _MAX_COMBINATIONS:
        raise SpecError(
            f"The listed values of {', '.join(ends)} have {combinations:,} combinations; at most {_MAX_COMBINATIONS:,} "
            "can be checked to find the largest trial.",
            "List fewer values, or give ranges.",
        )
    return [
        known[0].model_copy(update=dict(zip(ends, values, strict=True))) for values in itertools.product(*ends.values())
    ]


def _ends(spec: SweepSpec, name: str) -> list[Any]:
    """Return values of a hyperparameter of which one makes the largest trial; also the one where it does not act."""
    domain = spec.space[name]
    found = _ends_of(domain) + ([spec.value_without(name)] if domain.when else [])
    # The ends of a range are floats, and so may be what a file lists; a trial has them as its algorithm takes them.
    ends = [as_taken(spec.algorithm, name, value) for value in found]
    if name == "replay":
        return [max(ends, key=_REPLAYS.index)]
    return [max(ends)] if name in _GREATEST_IS_LARGEST else ends


def _ends_of(domain: Domain) -> list[Any]:
    if isinstance(domain, Layers):
        # The most layers of the largest size; a small network never takes more.
        return [max(domain.probes(), key=lambda probe: math.prod(probe[1]))[1]]
    if isinstance(domain, Range):
        return list(domain.bounds)
    assert isinstance(domain, Listed)
    if all(isinstance(value, int | float) for value in domain.values):
        return [min(domain.values), max(domain.values)]
    return list(domain.values)
