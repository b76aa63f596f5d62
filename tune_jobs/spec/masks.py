"""How a sweep file names what says which actions are allowed."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from policies.envs.mask_settings import is_setting
from tune_jobs.spec.fields import NameText, Section
from tune_jobs.spec.plain_data import yaml_text


class ListedActions(Section):
    """The actions that are allowed, listed by their numbers."""

    actions: NameText = Field(description="The name of a method, or of an info of reset and step, that lists them.")


def mask_as_given(value: Any) -> Any:
    """Let through a name, true, false, null and a mapping with the key actions, and refuse the rest in one sentence.

    Raises:
        ValueError: It is none of these.
    """
    if isinstance(value, ListedActions) or is_setting(value):
        return value
    raise ValueError(
        f"{yaml_text(value)} is not allowed: it should be a name, {{actions: the name of a list of the actions "
        "allowed}, true or false"
    )
