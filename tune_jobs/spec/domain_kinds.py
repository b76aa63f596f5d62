"""What all domains have in common, and those that list their values; the others are in `ranges` and `layers`."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Generator, Sequence
from functools import cached_property
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)
from typing_extensions import override

from analysis.wording import is_number
from tune_jobs.spec.plain_data import yaml_text
from tune_jobs.spec.slips import number_in


def _refuse_coercion(value: Any) -> Any:
    # Pydantic would read true as 1 and "5" as 5, but a quoted or misspelt value is better refused than guessed.
    if isinstance(value, str) and (meant := number_in(value)) is not None:
        raise ValueError(f"{yaml_text(value)} is of the wrong type: write {meant!r} if that is meant")
    if isinstance(value, bool | str):
        raise ValueError(f"{yaml_text(value)} is not a number")  # noqa: TRY004 - pydantic reports ValueErrors only
    return value


Number = Annotated[float, BeforeValidator(_refuse_coercion), Field(allow_inf_nan=False)]
"""A finite float; strings and true/false are refused."""

WholeNumber = Annotated[int, BeforeValidator(_refuse_coercion)]
"""An int, or a float without a fraction such as 1e5; strings and true/false are refused."""


def text_of(value: Any) -> str:
    """Return a text that is equal for values that mean the same: 2e4 is 20000, [64] is 64, but true is not 1."""
    return json.dumps(_in_one_form(value), default=repr)


def _in_one_form(value: Any) -> Any:
    if isinstance(value, list | tuple):
        items = list(map(_in_one_form, value))
        return items[0] if len(items) == 1 and is_number(items[0]) else items
    return int(value) if isinstance(value, float) and value.is_integer() else value


class AnyDomain(BaseModel, ABC):
    """The values of one hyperparameter; besides `when`, the only field of a subclass has the name of its kind."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: ClassVar[str]
    is_random: ClassVar[bool] = True
    is_whole: ClassVar[bool] = False

    when: dict[str, Any] | None = Field(
        None,
        min_length=1,
        description="Other searched hyperparameters, each with the value, or the list of values, that it must have for "
        "this one to act.",
    )

    @override
    def __iter__(self) -> Generator[tuple[str, Any], None, None]:
        # Field by field, as it is written too: without a condition where it has none.
        yield self.kind, getattr(self, self.kind)
        if self.when is not None:
            yield "when", self.when

    @model_serializer(mode="wrap")
    def _as_in_the_file(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Without a condition as it always was, for versions that know of none; with one, the kind comes first.
        data: dict[str, Any] = write(self)
        when = data.pop("when", None)
        return data if when is None else data | {"when": when}

    @abstractmethod
    def sample(self, rng: np.random.Generator) -> Any:
        """Draw one value, as a plain Python object."""

    @abstractmethod
    def gives(self, value: Any) -> bool:
        """Whether the domain can give a value."""

    @abstractmethod
    def probes(self) -> list[tuple[int | None, Any]]:
        """Return values to validate, each with its index in the sweep file (None: it is not listed there).

        If the hyperparameter accepts all of these, it accepts every value of the domain.
        """

    @abstractmethod
    def all_values(self, most: int) -> Sequence[Any] | None:
        """Return every value that the domain can give, once.

        None: they are not listed and more than `most`, or real numbers.
        """


class Listed(AnyDomain):
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
                    f"lists {yaml_text(value)} twice: list it once (seeds_per_point repeats points with other seeds)"
                )
            seen.append(key)
        return self

    def index_of(self, value: Any) -> int:
        """Return the index of a value in the list; types have to be equal, but a tuple equals a list.

        Raises:
            ValueError: The value isn't in the list.
        """
        return self._texts.index(json.dumps(value))

    @override
    def gives(self, value: Any) -> bool:
        return json.dumps(value) in self._texts

    def lists(self, value: Any) -> bool:
        """Whether a value is listed in whatever form: 2e4 is 20000, and 64 is the list [64]."""
        return text_of(value) in self._meanings

    @cached_property
    def _meanings(self) -> frozenset[str]:
        return frozenset(map(text_of, self.values))

    @cached_property
    def _texts(self) -> list[str]:
        return [json.dumps(known) for known in self.values]

    @override
    def probes(self) -> list[tuple[int | None, Any]]:
        return list(enumerate(self.values))

    @override
    def all_values(self, most: int) -> Sequence[Any]:
        return self.values


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
