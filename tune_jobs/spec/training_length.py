"""The length of training as a searched value, `stop.num_env_steps` in the space (decision 44).

It is no hyperparameter: no algorithm sees it. It is in a point under `TRAINING_LENGTH`, beside the hyperparameters, and
becomes the trial's own `stop.num_env_steps`. The sweep's `stop.num_env_steps` is the longest that the domain gives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from analysis.records import TRAINING_LENGTH, length_of
from tune_jobs.spec.domains import Domain, Listed, Range
from tune_jobs.spec.fields import PositiveWhole

if TYPE_CHECKING:
    from tune_jobs.spec.sections import SweepFields

_Spec = TypeVar("_Spec", bound="SweepFields")


def hyperparams_in(point: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a point that are hyperparameters."""
    return {name: value for name, value in point.items() if name != TRAINING_LENGTH}


def as_trained(spec: _Spec, point: Mapping[str, Any]) -> _Spec:
    """Return a sweep as it is for the trials of a point: with the length that the point gives, if it gives one."""
    length = length_of(point, spec.stop.num_env_steps)
    if length == spec.stop.num_env_steps:
        return spec
    return spec.model_copy(update={"stop": spec.stop.model_copy(update={"num_env_steps": length})})


def ends_of(domain: Domain) -> tuple[int, int] | None:
    """Return the shortest and the longest training that a domain gives; None: it gives something else too."""
    try:
        lengths = [TypeAdapter(PositiveWhole).validate_python(value) for _, value in domain.probes()]
    except ValidationError:
        return None
    if isinstance(domain, Range):
        low, high = domain.bounds
        return int(low), int(high)
    assert isinstance(domain, Listed)
    return min(lengths), max(lengths)


def with_longest(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a sweep's fields with the longest of the searched lengths as its `stop.num_env_steps`, if it has none.

    Listed lengths that are whole become ints, so that 2e4 is 20000 wherever it is shown.
    """
    space, stop = data.get("space"), data.get("stop")
    if not isinstance(space, Mapping) or TRAINING_LENGTH not in space:
        return dict(data)
    domain = space[TRAINING_LENGTH]
    if isinstance(domain, Mapping):
        written = {kind: _whole(values) if kind in ("grid", "choice") else values for kind, values in domain.items()}
        space = {**space, TRAINING_LENGTH: written}
        data = {**data, "space": space}
    if stop is not None and (not isinstance(stop, Mapping) or "num_env_steps" in stop):
        return dict(data)
    try:
        ends = ends_of(TypeAdapter(Domain).validate_python(space[TRAINING_LENGTH]))
    except ValidationError:
        return dict(data)  # told with all other problems
    return {**data, "stop": {**(stop or {}), "num_env_steps": ends[1]}} if ends is not None else dict(data)


def _whole(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return list(map(_whole, value))
    return int(value) if isinstance(value, float) and value.is_integer() else value


def length_problems(spec: SweepFields) -> list[tuple[str, str]]:
    """Return what is wrong with the searched length of training, each with its place, beside its values themselves."""
    domain = spec.space.get(TRAINING_LENGTH)
    ends = None if domain is None else ends_of(domain)
    if ends is None:
        return []
    place, (shortest, longest) = f"space.{TRAINING_LENGTH}", ends
    if spec.scheduler.waits_for_others:
        why = "which compares trials that have come equally far: use asha"
        if spec.scheduler.is_population:
            why = "whose trials go on from copies of others, so that none has a length of its own"
        return [(place, f"cannot be used with scheduler.type {spec.scheduler.type}, {why}")]
    found = []
    cap, grace = spec.stop.num_env_steps, spec.scheduler.grace_env_steps
    if cap != longest:
        text = (
            f"is {cap:,}, but the length of training is searched in {place}, and {longest:,} is the longest there: "
            "leave it out here, or there"
        )
        found.append((TRAINING_LENGTH, text))
    if spec.scheduler.type != "none" and grace is not None and shortest <= grace < longest:
        text = (
            f"{grace:,} is not less than {shortest:,}, the shortest training of {place}, which would never be ended "
            "early: lower it, or leave shorter ones out"
        )
        found.append(("scheduler.grace_env_steps", text))
    return found
