"""Find what is wrong with fixed and searched hyperparameters, each checked by itself."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from typing import Any

from pydantic import (
    BaseModel,
    ValidationError,
    create_model,
)

from analysis.records import TRAINING_LENGTH
from policies.errors import SpecError, shortened
from policies.foreign_names import answer_for_others, answer_to
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm
from policies.suggestions import did_you_mean
from policies.wrong_values import details_of, dotted, explain
from tune_jobs.spec.domains import Domain, Layers, Listed, Range
from tune_jobs.spec.list_forms import list_to_write, text_of_several
from tune_jobs.spec.other_names import section_of
from tune_jobs.spec.plain_data import yaml_text
from tune_jobs.spec.problems import SPEC_HINT, Problem
from tune_jobs.spec.sections import StopSpec
from tune_jobs.spec.slips import text_of_no_space

_LENGTHS = dict.fromkeys(
    ("num_env_steps", "stop", TRAINING_LENGTH),
    f"To search how long a training is, write space: {{{TRAINING_LENGTH}: ...}}; to fix it, stop.num_env_steps.",
)
"""What to write for names by which the length of training may be called."""
_CONDITION = (
    "`when` belongs inside the braces of the hyperparameter that it is about, as in "
    "lr: {loguniform: [1e-4, 1e-2], when: {activation: relu}}."
)
_OF_WHOLE_NUMBERS = {
    "uniform": "randint",
    "loguniform": "lograndint, qlograndint or power_of_two",
    "quniform": "qrandint",
    "qloguniform": "qlograndint",
}
"""The counterparts of domains that give fractions."""


def hyperparam_problems(
    algorithm: Algorithm, hyperparams: Mapping[str, Any], space: Mapping[str, Domain]
) -> list[Problem]:
    """Return what is wrong with fixed and searched hyperparameters, each checked by itself.

    Args:
        algorithm: The algorithm that has the hyperparameters.
        hyperparams: Fixed values by name.
        space: Domains by name.

    Returns:
        Unknown names, values that are refused, and names that are both fixed and searched.
    """
    fields = HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields
    problems = []
    for section, names in (("hyperparams", hyperparams), ("space", space)):
        problems += [
            Problem(f"{section}.{name}", _unknown_hyperparam(algorithm, name))
            for name in names
            if name not in fields and not (section == "space" and name == TRAINING_LENGTH)
        ]
    for name, value in hyperparams.items():
        if name in fields:
            problems += value_problems(algorithm, name, value, path=f"hyperparams.{name}")
        if name in space and not space[name].when:  # with a condition, it is the value where that does not hold
            text = f"is fixed at {yaml_text(value)} but also searched in space.{name}: take it out of one of them"
            problems.append(Problem(f"hyperparams.{name}", text))
    for name, domain in space.items():
        if name in fields or name == TRAINING_LENGTH:
            problems += _domain_problems(algorithm, name, domain)
    return problems


def check_distinct(algorithm: Algorithm, space: Mapping[str, Domain]) -> None:
    """Check that no listed value means the same as another one, as 64 and [64] do; a new sweep's space alone needs it.

    Raises:
        SpecError: A value is listed twice in two forms.
    """
    for name, domain in space.items():
        if not isinstance(domain, Listed):
            continue
        seen: dict[str, int] = {}
        for index, value in enumerate(domain.values):
            first = seen.setdefault(in_one_form(algorithm, name, value), index)
            if first != index:
                raise SpecError(
                    f"space.{name}.{domain.kind}[{index}]: {yaml_text(value)} is the same as "
                    f"{yaml_text(domain.values[first])}, in "
                    f"{domain.kind}[{first}]: list it once (seeds_per_point repeats points with other seeds)",
                    SPEC_HINT,
                )


def in_one_form(algorithm: Algorithm, name: str, value: Any) -> str:
    """Return a text that is equal for values of a hyperparameter that mean the same, as 64 and [64] do.

    Raises:
        pydantic.ValidationError: The hyperparameter does not take the value.
    """
    return json.dumps(_alone(algorithm, name).model_validate({name: value}).model_dump(mode="json"))


def as_taken(algorithm: Algorithm, name: str, value: Any) -> Any:
    """Return a value of a hyperparameter as trials have it: 1000 for 1000.0, and (64,) for 64.

    Raises:
        pydantic.ValidationError: The hyperparameter does not take the value.
    """
    return getattr(_alone(algorithm, name).model_validate({name: value}), name)


def _unknown_hyperparam(algorithm: Algorithm, name: str) -> str:
    if name in _LENGTHS:
        return f"{algorithm} has no hyperparameter {name!r}. {_LENGTHS[name]}"
    if (spaced := text_of_no_space(name)) is not None:
        return f"{algorithm} has no hyperparameter {name!r}: {spaced}"
    if did_you_mean(name, ["when"], cutoff=0.75):
        return f"{algorithm} has no hyperparameter {name!r}. {_CONDITION}"
    if name.startswith("stop."):
        is_field = name.removeprefix("stop.") in StopSpec.model_fields
        # Nearer than is asked for elsewhere, as all that begins with `stop.` looks alike.
        suggestion = "" if is_field else did_you_mean(name, [TRAINING_LENGTH], cutoff=0.75)
        only = (
            f"Of stop, only {TRAINING_LENGTH} can be searched, under space; all else is fixed under stop.{suggestion}"
        )
        return f"{algorithm} has no hyperparameter {name!r}. {only}"
    known = HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields
    others = [other for other, model in HYPERPARAMS_BY_ALGORITHM.items() if name in model.model_fields]
    have = "have" if len(others) > 1 else "has"
    of_others = f" ({' and '.join(others)} {have} it.)" if others else ""
    # By its letters, DQN's learning_starts would be nearer to learning_rate than lr is.
    suggestion = answer_to(algorithm, name) or of_others or answer_for_others(algorithm, name) or section_of(name)
    for part in name.split(".")[::-1]:  # as a whole, `lr.loguniform` is near to nothing, or to something else
        suggestion = suggestion or did_you_mean(part, known)
    listed = "" if suggestion else f" It has {', '.join(sorted(known))}."
    return f"{algorithm} has no hyperparameter {name!r}.{suggestion}{listed}"


def _domain_problems(algorithm: Algorithm, name: str, domain: Domain) -> list[Problem]:
    problems = []
    for index, value in domain.probes():
        path = f"space.{name}.{domain.kind}"
        found = value_problems(algorithm, name, value, path=path if index is None else f"{path}[{index}]")
        if found and index is None and isinstance(domain, Range):
            wanted = f"use {_OF_WHOLE_NUMBERS.get(domain.kind, 'randint')} in place of {domain.kind}"
            found = [Problem(path, f"can give {value!r}, but {name} must be a whole number: {wanted}")]
        if found and isinstance(domain, Layers) and all(problem.path.startswith(f"{path}[") for problem in found):
            # Of each layer the same is told, and a file has no list of them.
            found = [Problem(f"{path}.sizes", found[0].text)]
        problems += found
        if found and domain.kind not in ("grid", "choice"):
            break  # both ends of a range are usually wrong for the same reason
    return problems


def value_problems(algorithm: Algorithm, name: str, value: Any, *, path: str) -> list[Problem]:
    """Return what is wrong with one value of a hyperparameter.

    Args:
        algorithm: The algorithm that has the hyperparameter.
        name: Its name.
        value: The value.
        path: What messages call its place.
    """
    try:
        checked = as_taken(algorithm, name, value)
    except ValidationError as error:
        if (told := _told(algorithm, name, value, path=path)) is not None:
            return [Problem(path, told)]
        return [Problem(path + dotted(detail["loc"][1:], root=False), explain(detail)) for detail in details_of(error)]
    if not _same_kind(value, checked):
        return [Problem(path, f"{yaml_text(value)} is of the wrong type: write {yaml_text(checked)} if that is meant")]
    return []


def _told(algorithm: Algorithm, name: str, value: Any, *, path: str) -> str | None:
    """Return what to write in place of a value that is refused; None: that is not known."""
    if path == f"hyperparams.{name}":
        several = text_of_several(name, value, lambda one: _is_allowed(algorithm, name, one))
        if several is not None:
            return several
    meant = list_to_write(value, lambda form: _is_allowed(algorithm, name, form))
    if meant is None:
        return None
    wanted = "" if isinstance(value, list | tuple) else "it should be a list: "
    return f"{shortened(value)} is not allowed: {wanted}write {meant!r}"


def _is_allowed(algorithm: Algorithm, name: str, value: Any) -> bool:
    try:
        checked = as_taken(algorithm, name, value)
    except ValidationError:
        return False
    return _same_kind(value, checked)


def _same_kind(raw: Any, checked: Any) -> bool:
    """Whether pydantic kept the type of a value, as it would read true as 1, 1 as true and "5" as 5."""
    if isinstance(checked, tuple):
        # A single number may stand for a list of one.
        return all(map(_same_kind, raw if isinstance(raw, list | tuple) else [raw], checked))
    return isinstance(raw, str) == isinstance(checked, str) and isinstance(raw, bool) == isinstance(checked, bool)


@functools.cache
def _alone(algorithm: Algorithm, name: str) -> type[BaseModel]:
    """Return a model of one hyperparameter; the plan makes the checks across several of them, for each point."""
    fields = HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields
    field = StopSpec.model_fields["num_env_steps"] if name == TRAINING_LENGTH else fields[name]
    model: type[BaseModel] = create_model("Alone", **{name: (field.annotation, field)})  # type: ignore[call-overload]
    return model
