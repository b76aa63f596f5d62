"""Conditions in a search space: which of the searched hyperparameters act in a point.

A domain with `when` acts only in points in which each hyperparameter that it names *acts*, and has one of the values
that it lists. So conditions may chain: what depends on something that does not act does not act either. A point has no
value for what does not act in it; the trial then takes the value under `hyperparams`, or the default.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any

from analysis.wording import is_number, short_text
from tune_jobs.spec.domain_kinds import text_of
from tune_jobs.spec.domains import Domain, Listed, Range
from tune_jobs.spec.plain_data import yaml_text


class Conditions:
    """The conditions of a search space.

    Args:
        space: Domains by hyperparameter, without loops.
    """

    def __init__(self, space: Mapping[str, Domain]) -> None:
        self._space = space

    @cached_property
    def _needed(self) -> dict[str, dict[str, frozenset[str]]]:
        """What each hyperparameter with a condition needs, those that others depend on first."""
        return {
            name: {
                other: frozenset(key_of(self._space[other], value) for value in named_values(self._space[other], given))
                for other, given in (self._space[name].when or {}).items()
            }
            for name in in_order(self._space)
            if self._space[name].when
        }

    def __bool__(self) -> bool:
        """Whether there are any."""
        return any(domain.when for domain in self._space.values())

    def acting(self, values: Mapping[str, Any]) -> set[str]:
        """Return the searched hyperparameters that act.

        Args:
            values: A value of each, or of each that acts; of what lacks one, nothing is known, so that nothing acts
                that depends on it.
        """
        idle: set[str] = set()
        for name, needs in self._needed.items():
            for other, keys in needs.items():
                if other in idle or other not in values or key_of(self._space[other], values[other]) not in keys:
                    idle.add(name)
                    break
        return {name for name in self._space if name not in idle}

    def stripped(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of those that act, in the order of the space."""
        if not self:
            return {name: values[name] for name in self._space}
        acting = self.acting(values)
        return {name: values[name] for name in self._space if name in acting}


def named_values(domain: Domain, given: Any) -> tuple[Any, ...]:
    """Return the values that a condition names: a list is several, unless the domain lists it as one value."""
    if isinstance(given, list | tuple) and not (isinstance(domain, Listed) and domain.lists(given)):
        return tuple(given)
    return (given,)


def in_order(space: Mapping[str, Domain]) -> list[str]:
    """Return the names of a space without loops so that each comes after those that it depends on."""
    found: dict[str, None] = {}
    # Without recursion, as a file may chain more names than Python nests calls.
    waiting = list(space)[::-1]
    while waiting:
        name = waiting[-1]
        ahead = [other for other in space[name].when or {} if other not in found]
        if ahead:
            waiting += ahead
        else:
            found[waiting.pop()] = None
    return list(found)


def needed_text(space: Mapping[str, Domain], name: str) -> str:
    """Return what a hyperparameter needs to act, such as "replay prioritized and n_step 2 or 3"."""
    return " and ".join(
        f"{other} {listed_text(named_values(space[other], given))}" for other, given in (space[name].when or {}).items()
    )


def listed_text(values: Iterable[Any]) -> str:
    """Return values as a sentence has them."""
    return " or ".join(
        yaml_text(value) if value is None or isinstance(value, bool) else short_text(value) for value in values
    )


def key_of(domain: Domain, value: Any) -> str:
    """Return a text that is equal for values of a domain that mean the same, in whatever form; true is not 1."""
    if not (isinstance(domain, Range) and is_number(value)):
        return text_of(value)
    # Of steps, such as those of 0.1, a value counts that is one but for rounding.
    is_step = domain.is_stepped and domain.gives(value)
    return repr(float(domain.of_code(domain.code_of(value)) if is_step else value))
