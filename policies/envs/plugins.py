"""Register the environments of other installed packages.

A package with environments declares a function that registers them as an entry point of the group `gymnasium.envs`,
under the name of their namespace, or `__root__` for none. Gymnasium called these functions until 1.0 and calls none
since; they are called here, when an id is not registered yet, in the process that plans a sweep and in those that run
its trials alike. An installed package is trusted to run its code; what a sweep file names is not.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
from importlib import metadata
from typing import NamedTuple

from gymnasium.envs import registration

from policies.errors import said_by

GROUP = "gymnasium.envs"
_NO_NAMESPACE = "__root__"
_REGISTER_WHEN_IMPORTED = {"ale_py": "ale-py"}
"""Packages without such an entry point that register their environments when they are imported, with their names."""


class Registering(NamedTuple):
    """The function by which an installed package registers its environments."""

    package: str
    module: str
    attr: str
    """Its name in the module."""
    namespace: str | None


def who_may_register(env_id: str) -> list[Registering]:
    """Return the functions of which one registers an id, as far as their names tell; nothing is imported for it.

    They are those of its namespace, or else those of none, which may register any; an id of Gymnasium's own has none.
    """
    if _is_gymnasiums_own(env_id):
        return []
    found = [
        Registering(
            _package_of(entry_point), entry_point.module, entry_point.attr,
            None if entry_point.name == _NO_NAMESPACE else entry_point.name,
        )
        for entry_point in metadata.entry_points(group=GROUP)
    ]  # fmt: skip
    namespace = env_id.rpartition("/")[0]
    return [item for item in found if item.namespace == namespace] or [item for item in found if item.namespace is None]


def _is_gymnasiums_own(env_id: str) -> bool:
    """Whether Gymnasium registers an id, with or without its version, when it is imported."""
    return any(
        str(spec.entry_point).startswith("gymnasium.")
        for known, spec in registration.registry.items()
        if env_id in (known, known.rpartition("-v")[0])
    )


def _package_of(entry_point: metadata.EntryPoint) -> str:
    return entry_point.dist.name if entry_point.dist is not None else entry_point.value


@functools.cache
def load_env_plugins() -> tuple[str, ...]:
    """Let installed packages register their environments; only the first call does anything.

    Returns:
        A sentence for each package that could not, which says why.
    """
    problems = []
    for entry_point in metadata.entry_points(group=GROUP):
        before = registration.current_namespace
        registration.current_namespace = None if entry_point.name == _NO_NAMESPACE else entry_point.name
        try:
            entry_point.load()()
        except Exception as error:  # noqa: BLE001 (then only its own environments are missing)
            problems.append(_could_not(_package_of(entry_point), error))
        finally:
            registration.current_namespace = before
    for module, package in _REGISTER_WHEN_IMPORTED.items():
        try:
            if importlib.util.find_spec(module) is not None:
                importlib.import_module(module)
        except Exception as error:  # noqa: BLE001 (as above)
            problems.append(_could_not(package, error))
    return tuple(problems)


def _could_not(package: str, error: Exception) -> str:
    return f"The package {package} could not register its own: {type(error).__name__}: {said_by(error)}."
