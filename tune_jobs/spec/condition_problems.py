"""Find what is wrong with the conditions of a search space: names, values, loops, and what can never hold."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from analysis.records import TRAINING_LENGTH
from policies.errors import shortened
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm
from policies.suggestions import did_you_mean
from tune_jobs.spec.conditions import in_order, key_of, listed_text, named_values
from tune_jobs.spec.domains import Domain, Grid, Layers, Listed, Range
from tune_jobs.spec.plain_data import yaml_text
from tune_jobs.spec.problems import Problem

_MOST_SHOWN = 8


def condition_problems(
    algorithm: Algorithm,
    fixed: Mapping[str, Any],
    space: Mapping[str, Domain],
    *,
    are_grids_tried: bool,
    unread: Collection[str] = (),
) -> list[Problem]:
    """Return what is wrong with the conditions of a space.

    Args:
        algorithm: The algorithm that has the hyperparameters.
        fixed: Fixed values by name.
        space: Domains by name.
        are_grids_tried: Whether each combination of the grids is tried, not drawn.
        unread: Names of the space whose domains are wrong, so that nothing can be said of conditions on them; nor can
            it of those on names that the algorithm does not have.
    """
    given = _Given(algorithm, fixed, space, are_grids_tried=are_grids_tried)
    known = {*HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields, TRAINING_LENGTH}
    unread = {*unread, *(name for name in space if name not in known)}
    problems: list[Problem] = []
    readable: dict[str, Domain] = {}
    for name, domain in space.items():
        found = [
            Problem(f"space.{name}.when.{other}{place}", text)
            for other, values in (domain.when or {}).items()
            if other not in unread
            for place, text in _problems_of(given, name, other, values)
        ]
        problems += found
        is_known = not found and name not in unread and not any(other in unread for other in domain.when or {})
        readable[name] = domain if is_known else domain.model_copy(update={"when": None})
    loops = list(_loops(readable))
    return problems + loops if loops else problems + list(_contradictions(readable))


@dataclass(frozen=True)
class _Given:
    """What conditions are checked against."""

    algorithm: Algorithm
    fixed: Mapping[str, Any]
    space: Mapping[str, Domain]
    are_grids_tried: bool


def _problems_of(given: _Given, name: str, other: str, wanted: Any) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with one condition: what is added to its path, and the problem."""
    if other == name:
        yield "", f"is a condition of {name} on itself: name another searched hyperparameter"
        return
    if other not in given.space:
        yield "", _not_searched(given, name, other)
        return
    domain = given.space[other]
    if isinstance(domain, Layers) or (isinstance(domain, Range) and not domain.is_stepped):
        exactly = f"hardly ever draws exactly {yaml_text(wanted)}"
        why = "draws each layer's size" if isinstance(domain, Layers) else exactly
        yield "", f"can't be a condition: {other} ({domain.kind}) {why}. Name one with listed values or whole numbers"
        return
    if given.are_grids_tried and isinstance(given.space[name], Grid) and not isinstance(domain, Grid):
        text = (
            f"is drawn ({domain.kind}), but {name} is a grid, tried in every combination in which it acts, and these "
            f"would depend on chance: make {other} a grid too, or {name} a choice"
        )
        yield "", text
    values = named_values(domain, wanted)
    if not values:
        yield "", f"lists no value of {other}: list at least one, or take the condition out"
    for index, value in enumerate(values):
        if not (domain.lists(value) if isinstance(domain, Listed) else domain.gives(value)):
            place = f"[{index}]" if isinstance(wanted, list | tuple) else ""
            yield place, f"{yaml_text(value)} is no value that {other} can have: {_domain_text(domain, value)}"


def _not_searched(given: _Given, name: str, other: str) -> str:
    fields = HYPERPARAMS_BY_ALGORITHM[given.algorithm].model_fields
    if other == TRAINING_LENGTH:
        return (
            f"is not searched, and the same for all trials: search {other} too, or take the condition out. {name} "
            "would act always or never"
        )
    if other in given.fixed:
        told = f"is fixed at {yaml_text(given.fixed[other])} under hyperparams, not searched"
        return f"{told}, so that {name} acts always or never: search {other} too, or take the condition out"
    if other in fields:
        default = yaml_text(fields[other].get_default(call_default_factory=True))
        return (
            f"is not searched, and always {default}, its default: search {other} too, or take the condition out. "
            f"{name} would act always or never"
        )
    known = [searched for searched in given.space if searched != name]
    return f"{given.algorithm} has no hyperparameter {other!r}.{did_you_mean(other, known)}"


def _loops(space: Mapping[str, Domain]) -> Iterator[Problem]:
    """Yield one problem for each loop."""
    done: set[str] = set()

    def follow(name: str, path: list[str]) -> Iterator[Problem]:
        if name in path:
            loop = [*path[path.index(name) :], name]
            yield Problem(
                f"space.{name}.when", f"is a loop: {' needs '.join(loop)}, so that none of them could ever act"
            )
        elif name not in done:
            for other in space[name].when or {}:
                yield from follow(other, [*path, name])
            done.add(name)

    for name in space:
        yield from follow(name, [])


def _contradictions(space: Mapping[str, Domain]) -> Iterator[Problem]:
    """Yield the hyperparameters that can never act, as what they need excludes itself.

    Whatever a hyperparameter depends on must act too, so that all their conditions hold together.
    """
    needs: dict[str, dict[str, tuple[list[Any], str]]] = {}
    for name in in_order(space):
        needs[name] = {}
        for other, given in (space[name].when or {}).items():
            own = {other: (list(named_values(space[other], given)), name)}
            for searched, (values, source) in [*needs[other].items(), *own.items()]:
                known, before = needs[name].get(searched, (values, source))
                keys = {key_of(space[searched], one) for one in known}
                both = [value for value in values if key_of(space[searched], value) in keys]
                if not both:
                    yield Problem(
                        f"space.{name}.when",
                        f"can never hold: {source} acts only with {searched} {listed_text(values)}, and {before} only "
                        f"with {searched} {listed_text(known)}",
                    )
                    # What depends on it is not told too.
                    needs[name] = {}
                    break
                needs[name][searched] = (both, source)
            else:
                continue
            break


def _domain_text(domain: Domain, value: Any) -> str:
    if isinstance(domain, Listed):
        listed = ", ".join(map(yaml_text, domain.values[:_MOST_SHOWN]))
        more = ", ..." if len(domain.values) > _MOST_SHOWN else ""
        texts = [item for item in domain.values if isinstance(item, str)]
        hint = did_you_mean(value, texts) if isinstance(value, str) else ""
        return f"it is one of {listed}{more}.{hint}"
    told = f"its domain is {domain.kind} {shortened(domain.model_dump(mode='json')[domain.kind])}"
    is_end = isinstance(domain, Range) and domain.is_whole and (domain.q or 1) == 1 and value == domain.high
    return f"{told}, whose upper end is left out" if is_end else told
