"""Explain what pydantic finds wrong with a sweep, in terms of the sweep file's fields."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from types import NoneType
from typing import Any, get_args, get_origin

from pydantic import BaseModel, TypeAdapter, ValidationError

from analysis.records import TRAINING_LENGTH
from analysis.wording import is_number
from policies.errors import shortened
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM
from policies.suggestions import did_you_mean
from policies.wrong_values import Detail, details_of, dotted, explain
from tune_jobs.spec.condition_problems import condition_problems
from tune_jobs.spec.domains import DOMAIN_KINDS, Domain
from tune_jobs.spec.hyperparam_problems import hyperparam_problems
from tune_jobs.spec.layers import LayersFields
from tune_jobs.spec.list_forms import text_of_no_domain, text_of_no_list
from tune_jobs.spec.other_names import meant_by, place_of
from tune_jobs.spec.problems import Problem
from tune_jobs.spec.sections import NAME_RULE, SweepFields
from tune_jobs.spec.slips import text_of_no_space


def problems_of(error: ValidationError, data: Any) -> list[Problem]:
    """Return what is wrong with a sweep, from pydantic's error and the data that it was made from."""
    # After a wrong field, pydantic skips the checks of the whole sweep, so the correct fields are checked here.
    others = _hyperparam_problems(data) if isinstance(data, Mapping) else []
    told = {problem.path for problem in others}
    return [_from_detail(detail) for detail in details_of(error) if not _is_told(detail, told)] + others


def _is_told(detail: Detail, told: Collection[str]) -> bool:
    """Whether a detail says that what stands under a name of the space is no domain, which is told of the name.

    Args:
        detail: What pydantic found.
        told: The paths of other problems; that of a name in the space is there if there is no such hyperparameter.
    """
    location, found = detail["loc"], detail["input"]
    if len(location) != 2 or dotted(location) not in told or not isinstance(found, Mapping):
        return False
    return location[0] == "space" and not any(did_you_mean(key, DOMAIN_KINDS) for key in found)


def _hyperparam_problems(data: Mapping[str, Any]) -> list[Problem]:
    algorithm, fixed, space = data.get("algorithm"), data.get("hyperparams"), data.get("space")
    if algorithm not in list(HYPERPARAMS_BY_ALGORITHM):  # a list, as what stands there may be unhashable
        return []
    adapter: TypeAdapter[Any] = TypeAdapter(Domain)
    domains = {}
    for name, value in space.items() if isinstance(space, Mapping) else ():
        try:
            domains[name] = adapter.validate_python(value)
        except ValidationError:
            continue  # it is among the problems already; only its name is left to check
    known = {*HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields, TRAINING_LENGTH}
    unknown = {name: None for name in space if name not in known} if isinstance(space, Mapping) else {}
    given = fixed if isinstance(fixed, Mapping) else {}
    problems = hyperparam_problems(algorithm, given, domains)
    wrong = [name for name in space if name not in domains] if isinstance(space, Mapping) else []
    problems += condition_problems(algorithm, given, domains, are_grids_tried=False, unread=wrong)
    unseen = hyperparam_problems(algorithm, {name: None for name in unknown if name not in domains}, {})
    return problems + [Problem(path.replace("hyperparams.", "space.", 1), text) for path, text in unseen]


_FORMS = {
    "name": f"use {NAME_RULE}",
    "rl_module": "write module:Class",
    "env": "give a Gymnasium id such as CartPole-v1, or a mapping of id and args",
    "env.atari": "give true, or a mapping of its fields (frame_skip, noop_max, screen_size, terminal_on_life_loss, "
    "clip_rewards)",
    "about": "give a text, or a mapping of its fields (title, source, shows, expected, env_steps, time, description)",
    "search": "give random, auto, gp, forest or tpe, or a mapping of its fields",
    "points": "give a list of points, each a mapping of the searched hyperparameters to values",
    "prior": "give the name or the place of a sweep, or a list of them",
    "confirm": "give none, true, or a mapping of its fields (top, seeds, max_share)",
    "objective": "give final, area, best or steps_to_threshold, a list of one of them and env_steps, or a mapping of "
    "its fields (type, threshold, cost)",
    "scheduler": "give none, asha, hyperband, median, pbt or pb2, or a mapping of its fields",
}
"""How to write fields that have several forms, or a form that no type describes."""


def _from_detail(detail: Detail) -> Problem:
    location = _without_tags(detail["loc"])
    path = dotted(location)
    if detail["type"] == "extra_forbidden":
        return Problem(path, _unknown_key(location))
    if detail["type"] == "missing":
        env_id = "a Gymnasium id such as CartPole-v1"
        options = {"algorithm": "ppo or dqn", "env": env_id, "env.id": env_id}.get(path, "")
        return Problem(path, f"is missing{f': give {options}' if options else ''}")
    if (written := _in_space(location, detail) or _of_one_word(detail) or _of_a_number(location, detail)) is not None:
        return Problem(path, written)
    if path in _FORMS and detail["type"] != "value_error":
        return Problem(path, f"{shortened(detail['input'])} is not allowed: {_FORMS[path]}")
    if detail["type"] == "model_type":
        fields = ", ".join(_section(location).model_fields)
        return Problem(path, f"{shortened(detail['input'])} is not allowed: give a mapping of its fields ({fields})")
    return Problem(path, explain(detail))


def _in_space(location: Sequence[int | str], detail: Detail) -> str | None:
    """Return what to write where a domain, or the list of one, was left out; None: this is not the mistake."""
    if not location or location[0] != "space":
        return None
    if len(location) == 2 and detail["type"] == "value_error":
        return text_of_no_domain(str(location[1]), detail["input"])
    if len(location) == 3 and detail["type"] == "tuple_type" and location[2] in ("grid", "choice"):
        return text_of_no_list(str(location[1]), detail["input"])
    return None


def _of_one_word(detail: Detail) -> str | None:
    """Return what to write where a mapping has become one word for want of a space; None: this is not the mistake."""
    spaced = text_of_no_space(detail["input"]) if detail["type"] in ("dict_type", "model_type") else None
    return None if spaced is None else f"{shortened(detail['input'])} is one word: {spaced}"


def _of_a_number(location: Sequence[int | str], detail: Detail) -> str | None:
    """Return what to write where the name of a sweep is read as a number; None: this is not the mistake."""
    number = detail["input"]
    if location[:1] not in (["name"], ["prior"]) or not is_number(number) or number < 0:
        return None
    # How it was written is lost, and 1.10, 2024_01 and 1e5 name other sweeps than the numbers' own texts.
    quoted = "put the name in quotes as you wrote it, '...', and on a command line in two pairs, \"'...'\""
    return f"is read as the number {number}: {quoted}"


def _without_tags(location: Iterable[int | str]) -> list[int | str]:
    """Drop pydantic's names for the members of unions: of a domain's kind, and of the domain of layers' sizes."""
    parts = list(location)
    if parts[:1] == ["space"] and len(parts) > 3:
        del parts[2]
        if parts[2:4] == ["layers", "sizes"] and len(parts) > 5:
            del parts[4]
    return parts


def _unknown_key(location: Sequence[int | str]) -> str:
    name, model = str(location[-1]), _section(location[:-1])
    if (spaced := text_of_no_space(name)) is not None:
        return f"there is no field {name!r} here: {spaced}"
    if "." in name:
        return f"there is no field {name!r} here{_of_a_path(name, model)}"
    # A field of exactly this name in another section is more likely meant than a similar one here.
    suggestion = meant_by(location[:-1], name) or did_you_mean(name, model.model_fields)
    listed = "" if suggestion else f" Known here: {', '.join(model.model_fields)}."
    arguments = " Arguments of the environment go under env.args." if list(location[:-1]) == ["env"] else ""
    return f"there is no field {name!r} here.{suggestion}{listed}{arguments}"


def _section(location: Sequence[int | str]) -> type[BaseModel]:
    if location[:1] == ["space"]:
        return LayersFields  # the only domain with fields
    model: Any = SweepFields
    for part in location:
        model = _type_of(model, str(part))
    found: type[BaseModel] = model
    return found


def _type_of(model: type[BaseModel], name: str) -> Any:
    """Return the type of a section's field; one that may be null is a union with None."""
    annotation = model.model_fields[name].annotation
    if get_origin(annotation) is dict:
        return dict
    return next((one for one in get_args(annotation) if one is not NoneType), annotation)


def _of_a_path(name: str, model: type[BaseModel]) -> str:
    """Return what to write for a dotted name, which goes on after `there is no such field here`."""
    if (written := _in_braces(name, model)) is not None:
        return f": write {written}"
    head, _, rest = name.partition(".")
    inner = _type_of(model, head) if head in model.model_fields else None
    if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
        return f".{did_you_mean(head, model.model_fields)}"
    return f", nor {rest!r} in {head}.{place_of(rest) or did_you_mean(rest, inner.model_fields)}"


def _in_braces(name: str, model: type[BaseModel]) -> str | None:
    """Return a dotted name as a mapping in a section, `stop: {time_s: ...}`; None: there is no such field."""
    head, dot, rest = name.partition(".")
    if head not in model.model_fields:
        return None
    inner = _type_of(model, head)
    if not dot:
        return f"{head}: ..."
    if inner is dict:  # of names that are a user's own, or may have a dot, such as stop.num_env_steps in the space
        return f"{head}: {{{_in_domain(rest) if head == 'space' else f'{rest}: ...'}}}"
    written = _in_braces(rest, inner) if isinstance(inner, type) and issubclass(inner, BaseModel) else None
    return None if written is None else f"{head}: {{{written}}}"


def _in_domain(name: str) -> str:
    """Return a dotted name below the space as a mapping: `lr: {loguniform: ...}`."""
    searched, _, inner = name.rpartition(".")
    return f"{searched}: {{{inner}: ...}}" if searched and inner in (*DOMAIN_KINDS, "when") else f"{name}: ..."
