"""The search space: which values each searched hyperparameter may take, and the points drawn from it.

Words: a *domain* is the set of values of one hyperparameter; a *grid* domain is tried exhaustively, every
other domain is sampled; a *point* is one value of each. Domains mean what the functions of the same names in
`ray.tune` mean: `randint` leaves its upper end out, quantised domains (`q...`) give multiples of `q` between
the ends.

In a sweep file a domain is a mapping of one key, its kind: `lr: {loguniform: [1e-5, 1e-2]}`. A second key, `when`,
names other searched hyperparameters and the values with which this one acts: see `tune_jobs.spec.conditions`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Discriminator, Tag

from policies.suggestions import did_you_mean
from tune_jobs.spec.domain_kinds import AnyDomain, Choice, Grid, Listed
from tune_jobs.spec.layers import Layers
from tune_jobs.spec.plain_data import yaml_text
from tune_jobs.spec.ranges import (
    LogRandInt,
    LogUniform,
    OneMinusLogUniform,
    PowerOfTwo,
    QLogRandInt,
    QLogUniform,
    QRandInt,
    QUniform,
    RandInt,
    Range,
    Uniform,
)

__all__ = ["DOMAIN_KINDS", "Domain", "Grid", "Layers", "Listed", "Range"]

_KINDS: dict[str, type[AnyDomain]] = {
    domain.kind: domain
    for domain in (
        Grid, Choice, Uniform, LogUniform, QUniform, QLogUniform, RandInt, LogRandInt, QRandInt, QLogRandInt,
        PowerOfTwo, OneMinusLogUniform, Layers,
    )
}  # fmt: skip
_MOST_SHOWN = 4
DOMAIN_KINDS: tuple[str, ...] = tuple(_KINDS)


def _kind_of(value: Any) -> str | None:
    if isinstance(value, AnyDomain):
        return value.kind
    kinds = _kinds_in(value) if isinstance(value, Mapping) else []
    return kinds[0] if len(kinds) == 1 else None


def _kinds_in(value: Mapping[str, Any]) -> list[str]:
    return [key for key in value if key != "when"]


def _listed(keys: list[str]) -> str:
    return " and ".join(map(str, keys[:_MOST_SHOWN])) + (" and more" if len(keys) > _MOST_SHOWN else "")


def _check_shape(value: Any) -> Any:
    """Refuse a value that is not a domain, with a message that shows how to write one."""
    if isinstance(value, AnyDomain):
        return value
    if isinstance(value, list | tuple):
        raise ValueError(  # noqa: TRY004 - as above
            f"{value!r} is a bare list: write {{grid: {list(value) or '[...]'}}} to try each of its values"
        )
    if not isinstance(value, Mapping):
        raise ValueError(  # noqa: TRY004 - as above
            f"{yaml_text(value)} is one value: fix it under hyperparams, or write a domain such as {{grid: [...]}}"
        )
    found = _kinds_in(value)
    others = [key for key in found if key not in _KINDS]
    if others and len(found) - len(others) == 1:
        kind = next(key for key in found if key in _KINDS)
        suggestion = "" if "when" in value else did_you_mean(others[0], ["when"])
        raise ValueError(f"has {_listed(others)} beside {kind}, where only when may stand, its condition.{suggestion}")
    if len(found) != 1:
        kinds = ", ".join(DOMAIN_KINDS)
        beside = " beside when" if "when" in value else ""
        has = _listed(found) or "none"
        raise ValueError(f"needs exactly one key{beside}, the kind of the domain ({kinds}), and has {has}")
    kind = found[0]
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
    | Annotated[QLogRandInt, Tag("qlograndint")]
    | Annotated[PowerOfTwo, Tag("power_of_two")]
    | Annotated[OneMinusLogUniform, Tag("one_minus_loguniform")]
    | Annotated[Layers, Tag("layers")],
    Discriminator(_kind_of),
    BeforeValidator(_check_shape),
]
"""Any domain, for use as the type of a pydantic field."""
