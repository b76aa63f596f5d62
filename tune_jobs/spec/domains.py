"""The search space: which values each searched hyperparameter may take, and the points drawn from it.

Words: a *domain* is the set of values of one hyperparameter; a *grid* domain is tried exhaustively, every
other domain is sampled; a *point* is one value of each. Domains mean what the functions of the same names in
`ray.tune` mean: `randint` leaves its upper end out, quantised domains (`q...`) give multiples of `q` between
the ends.

In a sweep file a domain is a mapping of one key, its kind: `lr: {loguniform: [1e-5, 1e-2]}`.
"""

from __future__ import annotations

import itertools
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from decimal import Decimal
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, model_validator
from typing_extensions import override

from policies import random_streams
from policies.suggestions import did_you_mean


def _refuse_coercion(value: Any) -> Any:
    # Pydantic would read true as 1 and "5" as 5, but a quoted or misspelt value is better refused than guessed.
    if isinstance(value, bool | str):
        raise ValueError(f"{value!r} is not a number")  # noqa: TRY004 - pydantic reports ValueErrors only
    return value


Number = Annotated[float, BeforeValidator(_refuse_coercion), Field(allow_inf_nan=False)]
"""A finite float; strings and true/false are refused."""

WholeNumber = Annotated[int, BeforeValidator(_refuse_coercion)]
"""An int, or a float without a fraction such as 1e5; strings and true/false are refused."""


class _Domain(BaseModel, ABC):
    """The values of one hyperparameter; the only field of a subclass has the name of its kind."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: ClassVar[str]
    is_random: ClassVar[bool] = True
    is_whole: ClassVar[bool] = False

    @abstractmethod
    def sample(self, rng: np.random.Generator) -> Any:
        """Draw one value, as a plain Python object."""

    @abstractmethod
    def probes(self) -> list[tuple[int | None, Any]]:
        """Return values to validate, each with its index in the sweep file (None: it is not listed there).

        If the hyperparameter accepts all of these, it accepts every value of the domain.
        """


class Listed(_Domain):
    """A domain that lists its values."""

    @property
    def values(self) -> tuple[Any, ...]:
        """The listed values, in the order of the file."""
        values: tuple[Any, ...] = getattr(self, self.kind)
        return values

    @model_validator(mode="after")
    def _has_distinct_values(self) -> Self:
        if not self.values:
            raise ValueError("is empty: list at least one value, or take it out of the space")
        seen: list[str] = []
        for value in self.values:
            # Values of different types differ, though 1 == True == 1.0 in Python; inner lists are compared as text.
            key = repr(value)
            if key in seen:
                raise ValueError(
                    f"lists {value!r} twice: list it once (seeds_per_point repeats points with other seeds)"
                )
            seen.append(key)
        return self

    def index_of(self, value: Any) -> int:
        """Return the index of a value in the list; types have to be equal, but a tuple equals a list.

        Raises:
            ValueError: The value isn't in the list.
        """
        return [json.dumps(known) for known in self.values].index(json.dumps(value))

    @override
    def probes(self) -> list[tuple[int | None, Any]]:
        return list(enumerate(self.values))


class Grid(Listed):
    """Every value is tried, in combination with every value of the other grids."""

    kind: ClassVar[str] = "grid"
    is_random: ClassVar[bool] = False
    grid: tuple[Any, ...] = Field(description="Values to try, each with every value of the other grids.")

    def sample(self, rng: np.random.Generator) -> Any:
        """Draw one value; only for callers that ignore that a grid is exhaustive."""
        return self.values[int(rng.integers(len(self.values)))]


class Choice(Listed):
    """One of the values, all equally likely."""

    kind: ClassVar[str] = "choice"
    choice: tuple[Any, ...] = Field(description="Values to draw from, each as likely as the others.")

    def sample(self, rng: np.random.Generator) -> Any:
        """Draw one value."""
        return self.values[int(rng.integers(len(self.values)))]


class Range(_Domain):
    """A domain between two ends, possibly on a log scale, possibly of multiples of a step q."""

    is_log: ClassVar[bool] = False

    @property
    def low(self) -> float:
        """The lower end, which is included."""
        return float(getattr(self, self.kind)[0])

    @property
    def high(self) -> float:
        """The upper end as in the sweep file."""
        return float(getattr(self, self.kind)[1])

    @property
    def q(self) -> float | None:
        """The step of a quantised domain, else None."""
        ends = getattr(self, self.kind)
        return float(ends[2]) if len(ends) == 3 else None

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the greatest value that can be drawn."""
        if self.q is not None:
            first, last = self.factors
            return _multiple(first, self.q), _multiple(last, self.q)
        return (self.low, self.high - 1) if self.is_whole else (self.low, self.high)

    @property
    def factors(self) -> tuple[int, int]:
        """The first and the last multiple of q that can be drawn, as factors of q (of 1 if there is no q)."""
        q = self.q or 1.0
        first, last = _index(self.low, q, up=True), _index(self.high, q, up=False)
        # As in ray.tune: upper ends of whole ranges are included, except that a step of 1 changes nothing.
        return first, last - 1 if self.is_whole and q == 1 else last

    @model_validator(mode="after")
    def _is_not_empty(self) -> Self:
        low, high = getattr(self, self.kind)[:2]
        if self.q is not None and self.q <= 0:
            raise ValueError(f"has the step {self.q:g}: the third number must be greater than 0")
        if low >= high:
            raise ValueError(f"goes from {low!r} to {high!r}: the first number must be less than the second")
        if self.is_log and low <= 0:
            raise ValueError(f"starts at {low!r}: a log scale needs a start greater than 0")
        # Beyond these limits, NumPy would draw wrong values or raise an error.
        if self.is_whole and max(-low, high) >= 2**63:
            raise ValueError(f"goes from {low!r} to {high!r}: whole numbers are drawn below 2**63")
        if not math.isfinite(high - low) or (self.q is not None and max(-low, high) > 2.0**53 * self.q):
            raise ValueError(f"goes from {low!r} to {high!r}: that is wider than floats can be told apart")
        if self.q is not None:
            first, last = self.factors
            if first > last:
                raise ValueError(f"has no multiple of {self.q:g} between {low!r} and {high!r}")
        return self

    @override
    def probes(self) -> list[tuple[int | None, Any]]:
        low, high = self.bounds
        if self.is_whole:
            return [(0, int(low)), (1, int(high))]
        # The ends alone don't show whether a hyperparameter that has to be a whole number could get a fraction.
        fraction = None if self.q is not None and self.q.is_integer() else low + (high - low) / math.pi
        inside = [] if fraction is None else [(None, fraction)]
        return [(0, low), (1, high), *inside]

    def at_factor(self, factor: int) -> Any:
        """Return `factor` times q: an int in a range of whole numbers, else a float."""
        return factor * int(self.q or 1) if self.is_whole else _multiple(factor, self.q or 1.0)

    def sample(self, rng: np.random.Generator) -> Any:
        """Draw one value: an int from a range of whole numbers, else a float."""
        if self.is_whole:
            first, last = self.factors
            return self.at_factor(_draw_whole(rng, first, last, log=self.is_log))
        if self.q is None:
            return _draw_real(rng, self.low, self.high, log=self.is_log)
        low, high = self.bounds
        # Drawn between the outermost multiples, so that rounding can't lead out of the range.
        return self.at_factor(round(_draw_real(rng, low, high, log=self.is_log) / self.q))


class Uniform(Range):
    """A float, uniform between the ends."""

    kind: ClassVar[str] = "uniform"
    uniform: tuple[Number, Number] = Field(description="[low, high], floats.")


class LogUniform(Range):
    """A float, uniform between the ends on a log scale."""

    kind: ClassVar[str] = "loguniform"
    is_log: ClassVar[bool] = True
    loguniform: tuple[Number, Number] = Field(description="[low, high], floats > 0, drawn on a log scale.")


class QUniform(Range):
    """A multiple of q, uniform between the ends."""

    kind: ClassVar[str] = "quniform"
    quniform: tuple[Number, Number, Number] = Field(description="[low, high, q]: multiples of q.")


class QLogUniform(Range):
    """A multiple of q, uniform between the ends on a log scale."""

    kind: ClassVar[str] = "qloguniform"
    is_log: ClassVar[bool] = True
    qloguniform: tuple[Number, Number, Number] = Field(description="[low, high, q]: multiples of q, log scale.")


class RandInt(Range):
    """A whole number from the lower end up to but without the upper end."""

    kind: ClassVar[str] = "randint"
    is_whole: ClassVar[bool] = True
    randint: tuple[WholeNumber, WholeNumber] = Field(description="[low, high): whole numbers, high left out.")


class LogRandInt(Range):
    """The same as randint, on a log scale."""

    kind: ClassVar[str] = "lograndint"
    is_whole: ClassVar[bool] = True
    is_log: ClassVar[bool] = True
    lograndint: tuple[WholeNumber, WholeNumber] = Field(description="[low, high): whole numbers, log scale.")


class QRandInt(Range):
    """A whole multiple of q between the ends, both included (with q = 1, the same as randint)."""

    kind: ClassVar[str] = "qrandint"
    is_whole: ClassVar[bool] = True
    qrandint: tuple[WholeNumber, WholeNumber, WholeNumber] = Field(
        description="[low, high, q]: multiples of q, ends included."
    )


class QLogRandInt(Range):
    """The same as qrandint, on a log scale."""

    kind: ClassVar[str] = "qlograndint"
    is_whole: ClassVar[bool] = True
    is_log: ClassVar[bool] = True
    qlograndint: tuple[WholeNumber, WholeNumber, WholeNumber] = Field(
        description="[low, high, q]: multiples of q, ends included, log scale."
    )


_KINDS: dict[str, type[_Domain]] = {
    domain.kind: domain
    for domain in (
        Grid, Choice, Uniform, LogUniform, QUniform, QLogUniform, RandInt, LogRandInt, QRandInt, QLogRandInt
    )
}  # fmt: skip
DOMAIN_KINDS: tuple[str, ...] = tuple(_KINDS)


def _kind_of(value: Any) -> str | None:
    if isinstance(value, _Domain):
        return value.kind
    return next(iter(value)) if isinstance(value, Mapping) and len(value) == 1 else None


def _check_shape(value: Any) -> Any:
    """Refuse a value that is not a domain, with a message that shows how to write one."""
    if isinstance(value, _Domain):
        return value
    if isinstance(value, list | tuple):
        raise ValueError(  # noqa: TRY004 - as above
            f"{value!r} is a bare list: write {{grid: {list(value)!r}}} to try each of its values"
        )
    if not isinstance(value, Mapping):
        raise ValueError(  # noqa: TRY004 - as above
            f"{value!r} is one value: fix it under hyperparams, or write a domain such as {{grid: [...]}}"
        )
    if len(value) != 1:
        kinds = ", ".join(DOMAIN_KINDS)
        raise ValueError(f"needs exactly one key, the kind of the domain ({kinds}), and has {len(value)}")
    kind = next(iter(value))
    if kind not in _KINDS:
        suggestion = did_you_mean(kind, DOMAIN_KINDS)
        raise ValueError(f"there is no domain {kind!r} (there are {', '.join(DOMAIN_KINDS)}).{suggestion}")
    return value


Domain = Annotated[
    Annotated[Grid, Tag("grid")]
    | Annotated[Choice, Tag("choice")]
    | Annotated[Uniform, Tag("uniform")]
    | Annotated[LogUniform, Tag("loguniform")]
    | Annotated[QUniform, Tag("quniform")]
    | Annotated[QLogUniform, Tag("qloguniform")]
    | Annotated[RandInt, Tag("randint")]
    | Annotated[LogRandInt, Tag("lograndint")]
    | Annotated[QRandInt, Tag("qrandint")]
    | Annotated[QLogRandInt, Tag("qlograndint")],
    Discriminator(_kind_of),
    BeforeValidator(_check_shape),
]
"""Any domain, for use as the type of a pydantic field."""


def num_points(space: Mapping[str, Domain], num_samples: int) -> int:
    """Return how many points `draw_points` returns."""
    return num_samples * math.prod(len(domain.values) for domain in space.values() if isinstance(domain, Grid))


def draw_points(space: Mapping[str, Domain], num_samples: int, sweep_seed: int) -> list[dict[str, Any]]:
    """Draw the points of a sweep: for each sample, one for each combination of the grids' values.

    The random values of point i come from a generator of their own, so a point depends on the space, the
    sweep seed and its own index alone: a larger `num_samples` appends points and changes none.

    Args:
        space: Domains by hyperparameter. Their order is the order of the grid (the last one varies fastest).
        num_samples: How often the whole grid is repeated, each time with new random values.
        sweep_seed: Seed of the sweep, at least 0.

    Returns:
        `num_samples` times the product of the grids' sizes points, each a dict in the order of the space.
    """
    grids = {name: domain.values for name, domain in space.items() if isinstance(domain, Grid)}
    combinations = [dict(zip(grids, values, strict=True)) for values in itertools.product(*grids.values())]
    return [
        draw_point(space, index, sweep_seed, combination)
        for index, combination in enumerate(combinations * num_samples)
    ]


def draw_point(
    space: Mapping[str, Domain], index: int, sweep_seed: int, given: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Draw only point `index`; values of grids are drawn like those of choices.

    Args:
        space: Domains by hyperparameter.
        index: The index of the point.
        sweep_seed: Seed of the sweep, at least 0.
        given: Values that are not drawn.
    """
    given = given or {}
    rng = random_streams.point_values(sweep_seed, index)
    return {name: given[name] if name in given else domain.sample(rng) for name, domain in space.items()}


def _index(end: float, q: float, *, up: bool) -> int:
    """Return an end as a factor of q, rounded into the range; 0.3 counts as exactly 3 times 0.1."""
    factor = end / q
    if math.isclose(factor, round(factor)):
        return round(factor)
    return math.ceil(factor) if up else math.floor(factor)


def _multiple(factor: int, q: float) -> float:
    """Return `factor * q` without binary rounding errors such as that of 3 * 0.1."""
    return float(Decimal(repr(q)) * factor)


def _draw_real(rng: np.random.Generator, low: float, high: float, *, log: bool) -> float:
    if not log:
        return float(rng.uniform(low, high))
    value = math.exp(rng.uniform(math.log(low), math.log(high)))
    return min(max(value, low), high)


def _draw_whole(rng: np.random.Generator, first: int, last: int, *, log: bool) -> int:
    if not log:
        return int(rng.integers(first, last, endpoint=True))
    return min(math.floor(_draw_real(rng, first, last + 1, log=True)), last)
