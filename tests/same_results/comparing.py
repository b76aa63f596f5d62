"""What is equal in two recordings, and what differs; a thing is one number, text or null at its place."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

_MISSING = "(missing)"


def num_things(recording: Any) -> int:
    """Things in the recording of a sweep."""
    return sum(1 for _ in _things(recording, ""))


def differences(first: Any, second: Any) -> tuple[int, list[str]]:
    """Compare the recordings of one sweep.

    Returns:
        How many things are equal, and of each other one its place and what it is in the two.
    """
    one, other = dict(_things(first, "")), dict(_things(second, ""))
    places = [*one, *(place for place in other if place not in one)]
    different = [place for place in places if one.get(place, _MISSING) != other.get(place, _MISSING)]
    texts = [f"{place}: {one.get(place, _MISSING)} | {other.get(place, _MISSING)}" for place in different]
    return len(places) - len(different), texts


def compare(first: dict[str, Any], second: dict[str, Any]) -> int:
    """Print a line a sweep, with its differences below it; returns the exit code."""
    if first["machine"] != second["machine"]:
        print(f"note: recorded on different machines, {first['machine']} and {second['machine']}")
    total, wrong = 0, 0
    names = list(dict.fromkeys([*first["sweeps"], *second["sweeps"]]))
    for name in names:
        recordings = [recording["sweeps"].get(name) for recording in (first, second)]
        if None in recordings:
            wrong += 1
            print(f"{name}: is in one of the two recordings only")
            continue
        equal, different = differences(*recordings)
        total += equal
        wrong += bool(different)
        print(f"{name}: {equal} things are equal" + (f", {len(different)} differ:" if different else ""))
        for text in different:
            print(f"  {text}")
    print(f"{len(names) - wrong} of {len(names)} sweeps are the same; {total} things are equal")
    # Nothing compared is nothing shown.
    return 1 if wrong or not total else 0


def _things(value: Any, place: str) -> Iterator[tuple[str, str]]:
    """Place and text of everything in a document; empty lists and mappings are things too.

    Texts, as 1, 1.0 and true are equal in Python; of a float `repr` gives all bits but those of a NaN.
    """
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    if not inner or not value:
        yield place, repr(value)
        return
    for key, item in inner:
        yield from _things(item, f"{place}.{key}" if place else str(key))
