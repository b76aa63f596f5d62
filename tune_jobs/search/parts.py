"""What models see of a search space: one plain value of each name in every point, whatever acts in it.

Models compute with a fixed list of numbers. So a name that does not act in a point is filled in, always by the same
value, the middle of its domain, which tells them nothing; and what they propose is stripped of what does not act.
Layers are seen as their number and as the size of each; the sizes of layers that a network lacks do not act.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tune_jobs.spec.conditions import Conditions
from tune_jobs.spec.domains import Domain, Layers, Listed, Range
from tune_jobs.spec.ranges import RandInt


class Parts:
    """A search space as models see it.

    Args:
        space: Domains by name.
    """

    def __init__(self, space: Mapping[str, Domain]) -> None:
        self._given = space
        self._conditions = Conditions(space)
        self._layers = {name: domain for name, domain in space.items() if isinstance(domain, Layers)}
        self.space: Mapping[str, Domain] = {
            part: plain for name, domain in space.items() for part, plain in _parts(name, domain).items()
        }
        """A list or a range by each name."""
        self._middles = {name: _middle(domain) for name, domain in self.space.items()}

    @property
    def are_the_same(self) -> bool:
        """Whether models see just the values of the points."""
        return not self._conditions and not self._layers

    def values_of(self, point: Mapping[str, Any]) -> dict[str, Any]:
        """Return the value of each name in a point; what does not act is filled in."""
        return self._middles | self.known_values_of(point)

    def known_values_of(self, point: Mapping[str, Any]) -> dict[str, Any]:
        """Return the value of each name that acts in a point."""
        values = dict(point)
        for name in self._layers.keys() & point.keys():
            sizes = values.pop(name)
            values |= {number_of(name): len(sizes)} | {size_of(name, index): size for index, size in enumerate(sizes)}
        return {name: values[name] for name in self.space if name in values}

    @property
    def deciding(self) -> tuple[str, ...]:
        """The names on whose values it depends which names act."""
        needed = {name for domain in self._given.values() for name in domain.when or ()}
        return tuple(name for name in self.space if name in needed or name in map(number_of, self._layers))

    def acting(self, values: Mapping[str, Any]) -> set[str]:
        """Return the names that act where each name has a value."""
        return set(self.known_values_of(self.point_of(values)))

    def point_of(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the point with a value of each name; what does not act is left out."""
        known = {
            name: [values[size_of(name, index)] for index in range(values[number_of(name)])]
            if name in self._layers
            else values[name]
            for name in self._given
        }
        return self._conditions.stripped(known)


def number_of(name: str) -> str:
    """Return what the number of layers is called."""
    return f"{name}.number"


def size_of(name: str, index: int) -> str:
    """Return what the size of a layer is called; the first has the index 0, and the name 1."""
    return f"{name}.{index + 1}"


def _parts(name: str, domain: Domain) -> dict[str, Any]:
    if not isinstance(domain, Layers):
        # A random point of a model's has a value of each name, too.
        return {name: domain.model_copy(update={"when": None})}
    fewest, most = domain.layers.number
    number = RandInt(randint=(fewest, most + 1))
    return {number_of(name): number} | {size_of(name, index): domain.sizes for index in range(most)}


def _middle(domain: Domain) -> Any:
    if isinstance(domain, Listed):
        return domain.values[0]
    assert isinstance(domain, Range)
    low, high = domain.codes
    middle = (low * high) ** 0.5 if domain.has_log_codes else (low + high) / 2
    return domain.of_code(min(max(middle, low), high))
