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

from gymnasium.envs import registration

from policies.errors import said_by

GROUP = "gymnasium.envs"
_NO_NAMESPACE = "__root__"
_REGISTER_WHEN_IMPORTED = {"ale_py": "ale-py"}
"""Packages without such an entry point that register their environments when they are imported, with their names."""


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
            package = entry_point.dist.name if entry_point.dist is not None else entry_point.value
            problems.append(_could_not(package, error))
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
