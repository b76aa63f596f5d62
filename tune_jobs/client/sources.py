"""What a sweep is made from, as a service takes it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from policies.arguments import fit_argument
from policies.errors import SpecError, shortened

Source = str | Path | Mapping[str, Any]
"""Path of a sweep file, name of a preset, or the content of a sweep file."""


def request_of(source: Source, overrides: Sequence[str], name: str | None) -> dict[str, Any]:
    """Return a request for a sweep.

    Args:
        source: What it is made from; a file is read here, a preset is the service's.
        overrides: `a.b=value` assignments.
        name: The sweep's name; None: the file's, else one after the file or preset.

    Raises:
        SpecError: There is no such file or preset, it can't be read, a value is none that JSON can hold, or an
            argument is of another kind.
        CheckpointError: It cannot be found out whether there is a file of a preset's name.
    """
    from tune_jobs.spec.file import preset_names, read_sweep_file
    from tune_jobs.spec.plain_data import to_plain
    from tune_jobs.store.presence import is_file

    source = fit_argument("source", source, Source)
    request = plain_values(overrides=listed("overrides", overrides), name=name)
    if isinstance(source, Mapping):
        return request | {"spec": to_plain(source, "sweep")}
    if str(source) in preset_names() and not is_file(Path(source)):
        return request | {"preset": str(source)}
    _, text = read_sweep_file(source)
    return request | {"text": text, "default_name": Path(source).stem}


def listed(name: str, given: Sequence[str]) -> list[str]:
    """Return an argument that is a list of texts; what its items are is checked with their values.

    Raises:
        SpecError: It is no list.
    """
    # A string is a sequence of letters too, but nobody means that; the service would take each for an item.
    if isinstance(given, str | bytes | bytearray | Mapping) or not isinstance(given, Iterable):
        raise SpecError(f"The argument {name} is {shortened(given)}.", "Give a list, each of its items a text.")
    return list(given)


def plain_values(**given: Any) -> dict[str, Any]:
    """Return what a caller gave as JSON holds it, by the names of the arguments; numbers of NumPy are Python's then.

    Raises:
        SpecError: A value is none that JSON can hold, such as nan; the message says where.
    """
    from tune_jobs.spec.plain_data import to_plain

    return {name: to_plain(value, name) for name, value in given.items()}
