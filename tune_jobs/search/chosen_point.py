"""A point that a person chooses: checked, and written as the points are that the search gives."""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from analysis.records import ChosenPointRecord, TrialRecord
from analysis.wording import is_number, short_text
from policies.errors import SpecError, shortened
from policies.hyperparams import as_sizes
from policies.suggestions import did_you_mean
from tune_jobs.spec.conditions import Conditions, needed_text
from tune_jobs.spec.domains import Domain, Layers, Listed, Range
from tune_jobs.spec.hyperparam_problems import in_one_form, value_problems
from tune_jobs.spec.plain_data import to_plain, yaml_text
from tune_jobs.spec.rules import check_takes_points
from tune_jobs.spec.sweep_spec import SweepSpec


def checked_point(spec: SweepSpec, given: Mapping[str, Any], *, place: str = "point") -> dict[str, Any]:
    """Return a point that a person gave, in the order of the space, with values written as the space has them.

    A value may lie outside of its domain, if the algorithm takes it.

    Args:
        spec: The sweep.
        given: Values by the names of searched hyperparameters.
        place: What messages call it.

    Raises:
        SpecError: The sweep takes no points, a name is not searched or is missing, or a value is not allowed; the
            message lists every problem.
    """
    check_takes_points(spec)
    values: dict[str, Any] = to_plain(given, place)
    problems = [_unknown(spec, name) for name in values if name not in spec.space]
    point, wrong = {}, []
    for name, domain in spec.space.items():
        if name in values:
            if found := _problems(spec, name, domain, values[name]):
                wrong += found
            else:
                point[name] = as_written(spec, name, domain, values[name])
    problems += [*_missing(spec.space, values | point), *wrong]
    if not problems:
        problems = _idle(spec.space, point)
    if problems:
        told = problems[0] if len(problems) == 1 else "\n  ".join([f"{len(problems)} problems:", *problems])
        raise SpecError(f"{place}: {told}", f"The sweep searches {domains_text(spec.space)}.")
    return point


def _missing(space: Mapping[str, Domain], values: Mapping[str, Any]) -> list[str]:
    # Where a value is missing that others depend on, it is not known whether those are missing too.
    acting = Conditions(space).acting(values)
    names = [name for name in space if name in acting and name not in values]
    that_acts = " that acts" if any(domain.when for domain in space.values()) else ""
    told = f"it has no {' and no '.join(names)}: give a value for each searched hyperparameter{that_acts}"
    return [told] if names else []


def _idle(space: Mapping[str, Domain], point: Mapping[str, Any]) -> list[str]:
    acting = Conditions(space).acting(point)
    return [
        f"{name} doesn't act in this point, as it needs {needed_text(space, name)}: leave it out"
        for name in point
        if name not in acting
    ]


def _unknown(spec: SweepSpec, name: str) -> str:
    if name in spec.hyperparams:
        return f"{name} is fixed at {shortened(spec.hyperparams[name])} in this sweep, and not searched: leave it out"
    return f"{shortened(name)} is not searched in this sweep: leave it out.{did_you_mean(name, spec.space)}"


def _problems(spec: SweepSpec, name: str, domain: Domain, value: Any) -> list[str]:
    # Elsewhere values of a range are numbers: on axes, in models of what mattered.
    if isinstance(domain, Range) and not (is_number(value) and (not domain.is_whole or float(value).is_integer())):
        kind = "whole number" if domain.is_whole else "number"
        return [f"{name}: {yaml_text(value)} is not a {kind}, and its domain is {domain_text(domain)}"]
    path = f"point.{name}"
    found = value_problems(spec.algorithm, name, value, path=path)
    return [f"{problem.path.removeprefix('point.')}: {problem.text}" for problem in found]


def as_written(spec: SweepSpec, name: str, domain: Domain, value: Any) -> Any:
    """Return a value of a hyperparameter in the form in which its domain gives it; it may lie outside of the domain.

    Args:
        spec: The sweep.
        name: The hyperparameter's name.
        domain: Its domain.
        value: A value that the hyperparameter takes; of a range, a number.

    Raises:
        pydantic.ValidationError: The hyperparameter does not take the value.
    """
    if isinstance(domain, Range):
        return int(value) if domain.is_whole and float(value).is_integer() else float(value)
    if isinstance(domain, Layers):
        return [int(size) for size in as_sizes(value)]
    assert isinstance(domain, Listed)
    meant = in_one_form(spec.algorithm, name, value)
    same = (listed for listed in domain.values if in_one_form(spec.algorithm, name, listed) == meant)
    return next(same, value)


def trial_of_point(spec: SweepSpec, point: Mapping[str, Any], trials: Sequence[TrialRecord]) -> TrialRecord | None:
    """Return the first trial that has the values of a point, in whatever form; None: none has."""
    meant = _meaning(spec, point)
    known = (trial for trial in trials if trial.has_point and trial.point.keys() == point.keys())
    return next((trial for trial in known if trial.point == point or _meaning(spec, trial.point) == meant), None)


def keys_of(spec: SweepSpec, point: Mapping[str, Any]) -> list[Hashable]:
    """Return keys of a point; points that have the same values, in whatever form, have one of them in common."""
    meant = _meaning(spec, point)
    return [_hashable(point), *([] if meant is None else [meant])]


def _hashable(value: Any) -> Hashable:
    """Return what is equal for equal values, and can be a key."""
    if isinstance(value, Mapping):
        return frozenset((name, _hashable(item)) for name, item in value.items())
    if isinstance(value, list | tuple):
        return tuple(map(_hashable, value))
    key: Hashable = value
    return key


def _meaning(spec: SweepSpec, point: Mapping[str, Any]) -> str | None:
    try:
        return json.dumps({name: in_one_form(spec.algorithm, name, value) for name, value in point.items()})
    except (KeyError, ValidationError):
        return None  # of a version that took other values


def outside(space: Mapping[str, Domain], point: Mapping[str, Any]) -> list[str]:
    """Return the names of those values of a point that its domains can't give."""
    return [name for name, domain in space.items() if name in point and not domain.gives(point[name])]


def outside_notes(spec: SweepSpec, chosen_points: Sequence[ChosenPointRecord]) -> tuple[str, ...]:
    """Return the plan's notes on chosen points that the search could not have given."""
    notes = []
    for item in chosen_points:
        if names := outside(spec.space, item.point):
            told = ", ".join(f"{name} {short_text(item.point[name])}" for name in names)
            model = f", but {spec.search.type}'s model can't learn from it" if spec.search.has_model else ""
            domains = domains_text({name: spec.space[name] for name in names})
            notes.append(
                f"Point {item.num_points} was chosen with {told}, outside of space ({domains}): it is trained{model}."
            )
    return tuple(notes)


def domains_text(space: Mapping[str, Domain]) -> str:
    """Return domains as a sentence has them."""
    return ", ".join(f"{name} ({domain_text(domain)})" for name, domain in space.items())


def domain_text(domain: Domain) -> str:
    """Return a domain as a sweep file has it, without brackets."""
    text = f"{domain.kind} {shortened(domain.model_dump(mode='json')[domain.kind])}"
    return f"{text} when {shortened(domain.when)}" if domain.when else text
