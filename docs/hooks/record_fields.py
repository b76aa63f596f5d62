"""What Griffe, which reads docstrings for the site, is told of fields: their descriptions, and plain defaults.

By itself it shows `Field(None, description="...")` as the field's value, and takes the description for no docstring.
"""

from __future__ import annotations

import ast
from typing import Any

import griffe

_MAKERS = ("Field", "field")
"""Pydantic's, and that of dataclasses."""


class RecordFields(griffe.Extension):
    """Has fields of models and dataclasses shown as they are read."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Take an attribute's description and default out of the call that makes it a field."""
        made = attr.value
        if not isinstance(made, griffe.ExprCall) or made.canonical_path.rpartition(".")[2] not in _MAKERS:
            return
        given = {item.name: item.value for item in made.arguments if isinstance(item, griffe.ExprKeyword)}
        first = [item for item in made.arguments if not isinstance(item, griffe.ExprKeyword)]
        description = given.get("description")
        # One that is computed, as an f-string, is an expression.
        if attr.docstring is None and isinstance(description, str):
            attr.docstring = griffe.Docstring(ast.literal_eval(description), parent=attr)
        factory = given.get("default_factory")
        attr.value = first[0] if first else given.get("default", None if factory is None else f"{factory}()")
