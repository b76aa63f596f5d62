"""What sections of a sweep file are made of: their base class, and types of fields that several of them have."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from tune_jobs.spec.domain_kinds import Number, WholeNumber

Flag = Annotated[bool, Field(strict=True)]
"""true or false, but no string or number in their place."""
PositiveWhole = Annotated[WholeNumber, Field(ge=1)]
NonNegativeWhole = Annotated[WholeNumber, Field(ge=0)]
PositiveNumber = Annotated[Number, Field(gt=0)]
NameText = Annotated[str, Field(min_length=1)]
"""A text of at least one letter."""


class Section(BaseModel):
    """A part of a sweep: it cannot be changed, and refuses unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")
