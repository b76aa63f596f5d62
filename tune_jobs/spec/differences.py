"""What sweep files say differently."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

NOT_SET = "not set"
_MAX_CHARACTERS = 500
_UNSAID = frozenset({"name"})
"""What is another in each sweep, and says nothing of how it trains."""


@dataclass(frozen=True)
class Difference:
    """A field that sweep files don't agree about."""

    path: str
    """Such as `stop.num_env_steps`."""
    texts: tuple[str, ...]
    """What each of them has there, as YAML in one line."""


def differences(specs: Sequence[Mapping[str, Any]]) -> list[Difference]:
    """Return the fields that differ, in the order of the first sweep file; names of sweeps are no difference.

    Args:
        specs: Contents of sweep files, with defaults.
    """
    flat = [_flat(spec) for spec in specs]
    paths = dict.fromkeys(path for fields in flat for path in fields)
    found = []
    for path in paths:
        texts = tuple(fields.get(path, NOT_SET) for fields in flat)
        if len(set(texts)) > 1 and path not in _UNSAID:
            found.append(Difference(path, texts))
    return found


def _flat(spec: Mapping[str, Any]) -> dict[str, str]:
    """Return the fields of a sweep file by their paths; what is searched stays whole, such as `{uniform: [0, 1]}`."""
    found: dict[str, str] = {}
    for name, value in spec.items():
        if name == "space" and isinstance(value, Mapping):
            found |= {f"space.{key}": _text(domain) for key, domain in value.items()}
        else:
            found |= _fields(str(name), value)
    return found


def _fields(path: str, value: Any) -> dict[str, str]:
    if not isinstance(value, Mapping) or not value:
        return {path: _text(value)}
    found: dict[str, str] = {}
    for name, item in value.items():
        found |= _fields(f"{path}.{name}", item)
    return found


def _text(value: Any) -> str:
    if isinstance(value, str):
        text = value
    else:
        text = yaml.safe_dump(value, sort_keys=False, allow_unicode=True, default_flow_style=True, width=float("inf"))
        # Of a single value, PyYAML marks the end of the document.
        text = text.removesuffix("...\n").strip()
    return text if len(text) <= _MAX_CHARACTERS else f"{text[: _MAX_CHARACTERS - 1]}…"
