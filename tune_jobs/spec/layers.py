"""A network's hidden layers as a domain: how many there are, and a size for each."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, model_validator
from typing_extensions import override

from analysis.wording import is_number
from tune_jobs.spec.domain_kinds import AnyDomain, Choice, WholeNumber
from tune_jobs.spec.plain_data import yaml_text
from tune_jobs.spec.ranges import LogRandInt, PowerOfTwo, QLogRandInt, QRandInt, RandInt

MOST_LAYERS = 16
"""More hidden layers than anybody trains."""
_Sizes = TypeVar("_Sizes", bound=AnyDomain)
_SIZES = ("choice", "power_of_two", "randint", "lograndint", "qrandint", "qlograndint")


def _ends(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return value
    if not is_number(value) or not float(value).is_integer():
        raise ValueError(f"{yaml_text(value)} is not allowed: it should be a whole number, or [fewest, most]")
    return value, value


def _domain_of_sizes(value: Any) -> Any:
    """Let sizes be written as a list; refuse what is no domain of whole numbers, with what to write."""
    if isinstance(value, list | tuple):
        return {"choice": value}
    if isinstance(value, Mapping) and (len(value) != 1 or next(iter(value)) not in _SIZES):
        raise ValueError(
            f"{dict(value)!r} is no domain of sizes: give a list such as [32, 64], or one of {', '.join(_SIZES)}"
        )
    if not isinstance(value, AnyDomain | Mapping):
        raise ValueError(  # noqa: TRY004 - pydantic reports ValueErrors only
            f"{yaml_text(value)} is not allowed: give a list such as [32, 64], or {{power_of_two: [16, 256]}}"
        )
    return value


def _has_whole_sizes(sizes: _Sizes) -> _Sizes:
    """Refuse listed sizes that are no whole numbers, which is not told of the lists that are made of them."""
    for size in sizes.values if isinstance(sizes, Choice) else ():
        if not (is_number(size) and size >= 1 and float(size).is_integer()):
            raise ValueError(
                f"{yaml_text(size)} is not allowed: each size is a whole number of at least 1, as in [32, 64], and how "
                "many layers there are is the number"
            )
    return sizes


def _kind_of(value: Any) -> str:
    return value.kind if isinstance(value, AnyDomain) else str(next(iter(value)))


Sizes = Annotated[
    Annotated[Choice, Tag("choice")]
    | Annotated[PowerOfTwo, Tag("power_of_two")]
    | Annotated[RandInt, Tag("randint")]
    | Annotated[LogRandInt, Tag("lograndint")]
    | Annotated[QRandInt, Tag("qrandint")]
    | Annotated[QLogRandInt, Tag("qlograndint")],
    Discriminator(_kind_of),
    BeforeValidator(_domain_of_sizes, json_schema_input_type=Any),
    AfterValidator(_has_whole_sizes),
]


class LayersFields(BaseModel):
    """The two things that say which layers there may be."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    number: Annotated[
        tuple[WholeNumber, WholeNumber],
        BeforeValidator(_ends, json_schema_input_type=WholeNumber | tuple[WholeNumber, WholeNumber]),
    ] = Field(description="[fewest, most] layers, both included; a single number: always as many.")
    sizes: Sizes = Field(description="The sizes that each layer may have: a list, or a domain of whole numbers.")

    @model_validator(mode="after")
    def _has_layers(self) -> Self:
        fewest, most = self.number
        if not 1 <= fewest <= most <= MOST_LAYERS:
            raise ValueError(
                f"has number [{fewest}, {most}]: give [fewest, most] layers, from 1 to {MOST_LAYERS}, the fewest first"
            )
        return self


class Layers(AnyDomain):
    """A list of sizes: first how many, each number equally likely, then the size of each layer by itself."""

    kind: ClassVar[str] = "layers"
    layers: LayersFields = Field(
        description="{number: [fewest, most], sizes: [16, 32, 64]}, for hidden_sizes: a size for each of so many "
        "layers; sizes may be a domain of whole numbers, such as {power_of_two: [16, 256]}."
    )

    @property
    def sizes(self) -> Sizes:
        """The domain of each layer's size."""
        return self.layers.sizes

    @override
    def sample(self, rng: np.random.Generator) -> Any:
        fewest, most = self.layers.number
        number = int(rng.integers(fewest, most, endpoint=True))
        # As many are drawn whatever the number is, so that it changes nothing that is drawn after it.
        return [self.sizes.sample(rng) for _ in range(most)][:number]

    @override
    def gives(self, value: Any) -> bool:
        fewest, most = self.layers.number
        return isinstance(value, list | tuple) and fewest <= len(value) <= most and all(map(self.sizes.gives, value))

    @override
    def probes(self) -> list[tuple[int | None, Any]]:
        return [
            (None, [size] * number) for _, size in self.sizes.probes() for number in dict.fromkeys(self.layers.number)
        ]

    @override
    def all_values(self, most: int) -> Sequence[Any] | None:
        fewest, longest = self.layers.number
        numbers, sizes = range(fewest, longest + 1), self.sizes.all_values(most)
        if sizes is None or sum(len(sizes) ** number for number in numbers) > most:
            return None
        return [list(layers) for number in numbers for layers in itertools.product(sizes, repeat=number)]
