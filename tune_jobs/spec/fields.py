"""What sections of a sweep file are made of: their base class, and types of fields that several of them have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from tune_jobs.spec.domain_kinds import Number, WholeNumber

Flag = Annotated[bool, Field(strict=True)]
"""true or false, but no string or number in their place."""
PositiveWhole = Annotated[WholeNumber, Field(ge=1)]
NonNegativeWhole = Annotated[WholeNumber, Field(ge=0)]
PositiveNumber = Annotated[Number, Field(gt=0)]
NameText = Annotated[str, Field(min_length=1)]
"""A text of at least one letter."""


class Section(BaseModel):
    """A part of a sweep: it cannot be changed, and refuses unknown fields. A field that is null is as if left out."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    NEVER_EMPTY: ClassVar[frozenset[str]] = frozenset()
    """Fields that null is refused for: it may be meant as no limit, which the default is not."""

    @model_validator(mode="before")
    @classmethod
    def _empty_is_left_out(cls, data: Any) -> Any:
        # In YAML a field without a value is null, and so is a section whose lines are all commented out.
        if not isinstance(data, Mapping):
            return data
        kept = {*(data.keys() - cls.model_fields.keys()), *cls.NEVER_EMPTY}
        return {key: value for key, value in data.items() if value is not None or key in kept}
