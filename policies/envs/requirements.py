"""Find out which packages a user's package asks for that are not there, or are there in another version.

pip says so once, when it installs them, and installs them all the same. Later the package fails with an error that
names no version: an array of another shape, a module or an attribute that is gone.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import lru_cache
from pathlib import PurePath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from packaging.requirements import Requirement

_MOST = 3
"""How many requirements are named."""


def unmet_requirements(module: str, *, with_missing: bool = False) -> str | None:
    """Say which requirements of the package that a module belongs to are not met, as a sentence; None: all are.

    Args:
        module: A module's dotted name.
        with_missing: Whether what is not installed at all is named, too. Much of that is never imported.
    """
    top = module.partition(".")[0]
    try:
        unmet, asks = _unmet(top), _distribution_of(top)
    except Exception:  # noqa: BLE001 (damaged metadata, of whichever package: the error to be told is another one)
        return None
    said = [f"{asked}, where {found} is installed" for asked, found in unmet.items() if found is not None]
    if with_missing:
        said += [f"{asked}, which is not installed" for asked, found in unmet.items() if found is None]
    if not said:
        return None
    return f"{asks} asks for {'; '.join(said[:_MOST])}: that may be why."


def module_of_file(file: str) -> str | None:
    """Return the name of the top-level module or package that a file belongs to; None: it is in no place of imports."""
    path = PurePath(file)
    inside = [path.relative_to(place).parts for place in sys.path if place and PurePath(place) in path.parents]
    # One place may be inside another.
    return min(inside, key=len)[0].removesuffix(".py") if inside else None


@lru_cache
def _distribution_of(top: str) -> str | None:
    """Return the distribution, with its version, that installed a top-level module."""
    from importlib.metadata import packages_distributions, version

    # Of a namespace that several share nothing is known.
    names = set(packages_distributions().get(top, ()))
    return " ".join(f"{name} {version(name)}" for name in names) if len(names) == 1 else None


@lru_cache
def _unmet(top: str) -> dict[str, str | None]:
    """Return the requirements of a top-level module's distribution that are not met, each with what is installed."""
    from importlib.metadata import PackageNotFoundError, version

    known = _distribution_of(top)
    if known is None:
        return {}
    unmet = dict[str, str | None]()
    for wanted in _requirements(known.rpartition(" ")[0]):
        try:
            found = version(wanted.name)
        except PackageNotFoundError:
            unmet[f"{wanted.name}{wanted.specifier}"] = None
            continue
        if not wanted.specifier.contains(found, prereleases=True):
            unmet[f"{wanted.name}{wanted.specifier}"] = found
    return unmet


def _requirements(name: str) -> Iterator[Requirement]:
    """Yield what a distribution asks for on this machine without any of its extras."""
    from importlib.metadata import distribution

    # Loaded here: whoever only acts does without it, and then nothing is said of requirements.
    from packaging.requirements import InvalidRequirement, Requirement

    for text in distribution(name).requires or ():
        try:
            wanted = Requirement(text)
        except InvalidRequirement:  # metadata of an old package
            continue
        if wanted.marker is None or wanted.marker.evaluate({"extra": ""}):
            yield wanted
