"""Domains between two ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import override

from analysis.wording import is_number
from tune_jobs.spec.domain_kinds import AnyDomain, Number, WholeNumber


class Range(AnyDomain):
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

    @property
    def is_stepped(self) -> bool:
        """Whether the values are steps, which can be counted."""
        return self.is_whole or self.q is not None

    @property
    def codes(self) -> tuple[float, float]:
        """The ends of the numbers by which models know the values, see `code_of`; whole numbers if it is stepped."""
        return self.factors if self.is_stepped else self.bounds

    @property
    def has_log_codes(self) -> bool:
        """Whether equal ratios of codes count as equal steps."""
        return self.is_log

    def code_of(self, value: Any) -> float:
        """Return the number by which models know a value: how often q goes into it, or the value itself."""
        return round(value / (self.q or 1)) if self.is_stepped else float(value)

    def of_code(self, code: float) -> Any:
        """Return the value that models know by a number."""
        return self.at_factor(round(code)) if self.is_stepped else float(code)

    @override
    def gives(self, value: Any) -> bool:
        low, high = self.bounds
        if not (is_number(value) and low <= value <= high):
            return False
        q = self.q or (1.0 if self.is_whole else None)
        return q is None or math.isclose(self.at_factor(round(value / q)), value, abs_tol=1e-9 * q)

    @override
    def probes(self) -> list[tuple[int | None, Any]]:
        low, high = self.bounds
        if self.is_whole:
            return [(0, int(low)), (1, int(high))]
        # The ends alone don't show whether a hyperparameter that has to be a whole number could get a fraction.
        fraction = None if self.q is not None and self.q.is_integer() else low + (high - low) / math.pi
        inside = [] if fraction is None else [(None, fraction)]
        return [(0, low), (1, high), *inside]

    @override
    def all_values(self, most: int) -> Sequence[Any] | None:
        first, last = map(round, self.codes)
        if not self.is_stepped or last - first >= most:
            return None
        # Steps so small that floats hardly tell them apart may come to one value.
        return list(dict.fromkeys(map(self.of_code, range(first, last + 1))))

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


class PowerOfTwo(Range):
    """A power of two between the ends, both included, all equally likely."""

    kind: ClassVar[str] = "power_of_two"
    is_whole: ClassVar[bool] = True
    is_log: ClassVar[bool] = True
    power_of_two: tuple[WholeNumber, WholeNumber] = Field(
        description="[low, high]: 16, 32, 64, ...; both ends are powers of two and included."
    )

    @property
    @override
    def bounds(self) -> tuple[float, float]:
        return self.low, self.high

    @property
    @override
    def codes(self) -> tuple[float, float]:
        return self.code_of(self.low), self.code_of(self.high)

    @property
    @override
    def has_log_codes(self) -> bool:
        return False  # exponents are logarithms

    @model_validator(mode="after")
    def _has_powers_as_ends(self) -> Self:
        for end in self.power_of_two:
            if end < 1 or end & (end - 1):
                near = "" if end < 1 else f": {2 ** (end.bit_length() - 1)} and {2 ** end.bit_length()} are"
                raise ValueError(f"has {end!r} as an end, which is no power of two{near}")
        return self

    @override
    def code_of(self, value: Any) -> float:
        return round(math.log2(value))

    @override
    def of_code(self, code: float) -> Any:
        return 2 ** round(code)

    @override
    def gives(self, value: Any) -> bool:
        return super().gives(value) and int(value) & (int(value) - 1) == 0

    @override
    def sample(self, rng: np.random.Generator) -> Any:
        first, last = self.codes
        return self.of_code(int(rng.integers(int(first), int(last), endpoint=True)))


class OneMinusLogUniform(Range):
    """A float below 1, of which the distance to 1 is uniform on a log scale: 0.9, 0.99 and 0.999 lie equally apart."""

    kind: ClassVar[str] = "one_minus_loguniform"
    one_minus_loguniform: tuple[Number, Number] = Field(
        description="[low, high], floats < 1: 1 - value is drawn on a log scale, for gamma, gae_lambda, adam_beta2."
    )

    @property
    @override
    def codes(self) -> tuple[float, float]:
        return 1.0 - self.high, 1.0 - self.low

    @property
    @override
    def has_log_codes(self) -> bool:
        return True

    @model_validator(mode="after")
    def _is_below_one(self) -> Self:
        if self.high >= 1:
            raise ValueError(f"ends at {self.high!r}: it must be less than 1, as 1 - value is drawn on a log scale")
        return self

    @override
    def code_of(self, value: Any) -> float:
        return 1.0 - float(value)

    @override
    def of_code(self, code: float) -> Any:
        # Beyond 15 digits there is only the dust of the subtraction, such as 0.9900000000000001.
        return min(max(round(1.0 - float(code), 15), self.low), self.high)

    @override
    def sample(self, rng: np.random.Generator) -> Any:
        return self.of_code(_draw_real(rng, *self.codes, log=True))


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
