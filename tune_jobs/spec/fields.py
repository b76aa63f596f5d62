"""What sections of a sweep file are made of: their base class, and types of fields that several of them have."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from tune_jobs.spec.domain_kinds import Number, WholeNumber
from tune_jobs.spec.plain_data import yaml_text

Flag = Annotated[bool, Field(strict=True)]
"""true or false, but no string or number in their place."""
PositiveWhole = Annotated[WholeNumber, Field(ge=1)]
NonNegativeWhole = Annotated[WholeNumber, Field(ge=0)]
PositiveNumber = Annotated[Number, Field(gt=0)]
NameText = Annotated[str, Field(min_length=1)]
"""A text of at least one letter."""


def name_or_flag(value: Any) -> Any:
    """Let through a name, true, false and null, and refuse the rest in one sentence.

    Raises:
        ValueError: It is none of these.
    """
    if value is None or isinstance(value, bool) or (isinstance(value, str) and value):
        return value
    raise ValueError(f"{yaml_text(value)} is not allowed: it should be a name, true or false")


class Section(BaseModel):
    """A part of a sweep: it cannot be changed, and refuses unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")
