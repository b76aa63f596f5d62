"""Decide which Python modules of a user's own may be imported: those with environments, wrappers or RLModules.

Importing a module runs its code, so a name in a sweep file or in a policy file is never enough. The person who runs
the sweep has to allow the module: by `--allow-module`, by `allow_modules`, by passing a class of it to a Python call,
or with the environment variable TUNE_JOBS_ALLOWED_MODULES (names with commas between them), which other processes
inherit. A package that is allowed includes its submodules.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from policies.arguments import checked
from policies.envs.faults import is_of_env, name_hint, numpy_hint, with_requirements
from policies.envs.rendering import display_hint
from policies.errors import SpecError, said_by

ENVIRONMENT_VARIABLE = "TUNE_JOBS_ALLOWED_MODULES"
_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
# Names of packages of this project that a user's own packages may have too; see tune_jobs/process/own_packages.py.
_SHARED = ("policies", "analysis")
_FINDER = ".__path_hook__"

_allowed: set[str] = set()
_allowed_in_block: ContextVar[set[str] | None] = ContextVar("allowed_in_block", default=None)
"""More modules, allowed in the `allowed_again` block that a thread runs; other threads may run blocks of their own."""


@checked
def allow_modules(names: Iterable[str]) -> None:
    """Allow modules, for as long as this process lives, or for the `allowed_again` block that this thread runs.

    Args:
        names: Dotted names, such as `my_envs` or `my_package.envs`.

    Raises:
        SpecError: One of them is not the name of a module; then none is allowed.
    """
    wanted = tuple(names)
    for name in wanted:
        # The name of a file looks like that of a submodule called `py`, which nobody has.
        if not isinstance(name, str) or _NAME.fullmatch(name) is None or name.endswith(".py"):
            raise SpecError(
                f"{name!r} is not the name of a Python module, so it cannot be allowed.",
                "Give the name that an import statement would: my_envs for the file my_envs.py.",
            )
    in_block = _allowed_in_block.get()
    (_allowed if in_block is None else in_block).update(wanted)


@contextlib.contextmanager
def allowed_again() -> Iterator[None]:
    """Undo at the end of the block what it allowed, so that the modules of a sweep are allowed for that sweep only."""
    token = _allowed_in_block.set(set(_allowed_in_block.get() or ()))
    try:
        yield
    finally:
        _allowed_in_block.reset(token)


def allowed_modules() -> tuple[str, ...]:
    """Return the modules that are allowed in this process, sorted, including those of the environment variable."""
    inherited = (name.strip() for name in os.environ.get(ENVIRONMENT_VARIABLE, "").split(","))
    in_block = _allowed_in_block.get() or ()
    return tuple(sorted(_allowed.union(in_block, (name for name in inherited if name))))


def is_allowed(module: str) -> bool:
    """Whether a module, or a package that it is in, is allowed."""
    return any(module == name or module.startswith(f"{name}.") for name in allowed_modules())


def module_folders() -> list[str]:
    """Return the folders on this process's path that hold the allowed modules, to be put on other processes' paths.

    Modules that this process has not imported are looked for, but not imported.
    """
    found = []
    on_path = {os.path.abspath(entry) for entry in sys.path}  # noqa: PTH100 (sys.path holds strings)
    # When a module was imported by such an entry, as by a notebook's "", the working directory may have been another.
    # What setuptools puts there for editable installations is the name of a finder, of no folder.
    folders = (entry for entry in sys.path if not str(entry).endswith(_FINDER))
    has_relative = any(not os.path.isabs(entry) for entry in folders)  # noqa: PTH117
    for name in allowed_modules():
        file, depth = _file_of(name)
        if file is None:
            continue
        path = Path(file).absolute()
        # The __file__ of a package is its __init__.py.
        place = path.parent if path.name == "__init__.py" else path
        folder = str(place.parents[depth])
        if has_relative or folder in on_path:
            found.append(folder)
    return list(dict.fromkeys(found))


def look_in(folders: Iterable[str]) -> None:
    """Let modules be found in another process's `module_folders` too, after all other places.

    Folders that are not there, as on another machine, are left out.
    """
    sys.path += [folder for folder in folders if folder not in sys.path and os.path.isdir(folder)]  # noqa: PTH112


def _file_of(name: str) -> tuple[str | None, int]:
    """Return the file or folder of a module or of a package around it, and how many packages that is in."""
    top = name.partition(".")[0]
    # The module itself comes first: two projects may share a package, as a user's own `policies` does with this one.
    module: Any = sys.modules.get(name) or (None if top in _SHARED else sys.modules.get(top))
    if module is not None:
        file = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", ())), None)
        return file, module.__name__.count(".")
    spec = None
    with contextlib.suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(name) if top in _SHARED else PathFinder.find_spec(top)
    if spec is None:
        return None, 0
    return spec.origin or next(iter(spec.submodule_search_locations or ()), None), spec.name.count(".")


def import_module_allowed(module: str) -> ModuleType:
    """Import a module, if it is allowed.

    It is looked for in the current folder too, after all other places: a script has that folder on its path, but the
    `tune-jobs` command does not.

    Raises:
        SpecError: The module is not allowed, is nowhere to be found, or raises an error.
    """
    if not is_allowed(module):
        raise SpecError(
            f"The Python module {module!r} is not allowed: importing it would run its code.",
            f"If you trust it, allow it with --allow-module {module}, or in Python with "
            f"tune_jobs.allow_modules([{module!r}]); the environment variable {ENVIRONMENT_VARIABLE}={module} does the "
            "same.",
        )
    here = os.getcwd()  # noqa: PTH109 (sys.path holds strings)
    if module in _SHARED and here not in sys.path:
        # The package itself is always found; whether the user's own has the module is seen next.
        sys.path.append(here)
    try:
        try:
            return importlib.import_module(module)
        except ModuleNotFoundError as error:
            if not _is_part(error.name, module) or here in sys.path:
                raise
            sys.path.append(here)
            importlib.invalidate_caches()
            return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if not _is_part(error.name, module):
            raise _failed(module, error) from error
        raise SpecError(
            f"The module {module!r} is allowed, but it was not found: {error}.",
            "Run the command in the folder that holds it, or add that folder to PYTHONPATH, on every machine that "
            "runs trials.",
        ) from error
    except BaseException as error:  # a user's module may raise anything
        if not is_of_env(error):
            raise
        raise _failed(module, error) from error


def _is_part(missing: str | None, module: str) -> bool:
    """Whether the missing module is this one or a package around it, and not something that it imports."""
    return missing is not None and (module == missing or module.startswith(f"{missing}."))


def _failed(module: str, error: BaseException) -> SpecError:
    known = display_hint(error) or numpy_hint(error) or name_hint(error)
    hint = known or f'Try `python -c "import {module}"`, and mend what it says.'
    return SpecError(
        f"The module {module!r} cannot be imported: {type(error).__name__}: {said_by(error)}.",
        with_requirements(hint, module, error),
    )


def import_allowed(path: str) -> Any:
    """Import and return what `module:Name` names, if the module is allowed.

    Args:
        path: A module's dotted name, a colon, and the name of something in it, such as a class.

    Raises:
        SpecError: The path has another form, its module is not allowed or cannot be imported, or nothing in it has that
            name.
    """
    module_name, _, name = path.partition(":")
    if _NAME.fullmatch(module_name) is None or not name.isidentifier():
        raise SpecError(f"{path!r} does not name something in a module.", "Write it as module:Name.")
    module = import_module_allowed(module_name)
    try:
        return getattr(module, name)
    except AttributeError as error:
        raise SpecError(
            f"The module {module_name!r} ({getattr(module, '__file__', 'built in')}) has nothing called {name!r}.",
            "Correct the name, or define it there.",
        ) from error


def path_of(thing: type[Any], what: str) -> str:
    """Return the `module:Name` under which other processes find a class, and allow its module.

    Args:
        thing: A class that was passed to a Python call.
        what: The role of the class, for messages.

    Raises:
        SpecError: It is defined in a script, a notebook or a function, where no other process finds it; or the module
            has another class by its name.
    """
    module, name = thing.__module__, thing.__qualname__
    found = getattr(sys.modules.get(module), name, None)
    is_found = isinstance(found, type) and (found.__module__, found.__qualname__) == (module, name)
    if module == "__main__" or not is_found:
        where = "the main script" if module == "__main__" else f"a function or class of {module}"
        raise SpecError(
            f"The {what} {name} is defined in {where}, where the processes of trials cannot find it.",
            "Move it to the top level of a module, such as my_envs.py next to the script, and import it from there.",
        )
    if found is not thing and not _is_written(thing):
        raise SpecError(
            f"The {what} {name} is not the class that {module}.{name} is now, which the processes of trials import.",
            f"If {module} was imported again since, take the class from there anew. A class that a function makes "
            f"needs a name of its own at the top level of {module}.",
        )
    allow_modules([module])
    return f"{module}:{name}"


def _is_written(thing: type[Any]) -> bool:
    """Whether a class was made by a class statement, as before a reload, and not by a call of `type`.

    By such calls, a function gives one name to many classes. They add the name of the module last, a statement first.
    """
    return next(iter(vars(thing)), None) == "__module__"
