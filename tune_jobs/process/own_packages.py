"""Make `policies` and `analysis` mean the packages beside this one, even if a user's own folders have these names.

Both names are common in this field. The folder of a script comes first on its path, Ray puts the driver's folders
first on its workers' paths, and there a user's folder or file of that name would hide our package. A finder before all
others decides what the two names mean. It is installed when tune_jobs is imported, and both packages import tune_jobs
first. What another process unpickles first must be from a module in tune_jobs, or a user's folder could come first.

The user's own packages stay usable. A submodule that our package does not have is looked for in the user's
(`import analysis.my_plots`), and so is a name (`from analysis import plot_all`). Only then does the user's
`__init__.py` run: that it is on the path is no reason to run it.
"""

from __future__ import annotations

import glob
import importlib
import os
import pkgutil
import sys
import warnings
from collections.abc import Iterator, Sequence
from importlib.machinery import BuiltinImporter, FrozenImporter, ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from types import ModuleType
from typing import Any

NAMES = ("policies", "analysis")
# Strings, as in sys.path and __path__.
_ROOT = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))  # noqa: PTH100, PTH118, PTH120
_INIT = "__init__.py"
_PYTHONS_OWN = (BuiltinImporter, FrozenImporter, PathFinder)
_SHARED = ("__all__", "__version__")

_theirs: dict[str, ModuleType] = {}
"""The user's own package or module of each name, if it was loaded."""


def install() -> None:
    """Make the two names mean our packages from now on; only the first call does anything.

    Raises:
        ImportError: A module of the user's own package is already imported, and ours has one of the same name.
    """
    if not any(isinstance(finder, _Names) for finder in sys.meta_path):
        for name in NAMES:
            _refuse_loaded_clash(name)
        sys.meta_path.insert(0, _Names())
        sys.meta_path.append(_TheirSubmodules())
        for name in NAMES:
            _take_over(name)
            _warn_of_hidden(name)


def run(path: str, *args: Any) -> Any:
    """Call the function that `path` names as `module:function`; child processes begin with it."""
    return pkgutil.resolve_name(path)(*args)


class _Names:
    """Finds the two packages; it comes before all other finders."""

    def find_spec(self, fullname: str, *_: Any) -> ModuleSpec | None:
        """Return the module's spec, or None if it is not for this finder; called by the import system."""
        if fullname not in NAMES:
            return None
        folder, file = _folder(fullname), os.path.join(_folder(fullname), _INIT)  # noqa: PTH118
        return spec_from_file_location(
            fullname, file, loader=_Loader(fullname, file), submodule_search_locations=[folder]
        )


class _Loader(SourceFileLoader):
    """Loads one of the packages, and lets it fall back to the names of the user's own."""

    def exec_module(self, module: ModuleType) -> None:
        """Execute the package's `__init__.py`, and add the fallback to it; called by the import system."""
        super().exec_module(module)
        _add_fallback(module)


class _TheirSubmodules:
    """Finds submodules of the user's own package; it comes after all other finders, which look in ours."""

    def find_spec(self, fullname: str, *_: Any) -> ModuleSpec | None:
        """Return the module's spec, or None if it is not for this finder; called by the import system."""
        if fullname.count(".") != 1 or not fullname.startswith(tuple(f"{name}." for name in NAMES)):
            return None
        name = fullname.partition(".")[0]
        return PathFinder.find_spec(fullname, [place for spec in _their_specs(name) for place in _places(spec)])


def _folder(name: str) -> str:
    return os.path.join(_ROOT, name)  # noqa: PTH118


def _is_ours(spec: ModuleSpec, name: str) -> bool:
    files = [spec.origin] if spec.has_location and spec.origin else []
    return any(_is_folder_of_ours(place, name) for place in [*_places(spec), *map(os.path.dirname, files)])


def _is_folder_of_ours(place: str, name: str) -> bool:
    """Whether a folder is this package or another copy of it, such as a checkout, and not a user's own."""
    copy = os.path.join(os.path.dirname(place), "tune_jobs", _INIT)  # noqa: PTH118, PTH120
    return os.path.realpath(place) == os.path.realpath(_folder(name)) or os.path.isfile(copy)  # noqa: PTH113


def _places(spec: ModuleSpec) -> Sequence[str]:
    return list(spec.submodule_search_locations or ())


def _their_specs(name: str) -> Iterator[ModuleSpec]:
    """Yield the user's own packages and modules of a name, in the present order of the path."""
    for entry in sys.path:
        spec = PathFinder.find_spec(name, [entry])
        if spec is not None and not _is_ours(spec, name):
            yield spec
    # A project in an editable installation may have a finder of its own.
    for finder in sys.meta_path:
        known = finder in (BuiltinImporter, FrozenImporter, PathFinder) or isinstance(
            finder, (_Names, _TheirSubmodules)
        )
        find_spec = None if known else getattr(finder, "find_spec", None)
        spec = None if find_spec is None else find_spec(name, None)
        if spec is not None and not _is_ours(spec, name):
            yield spec


def _modules_in(folder: str) -> dict[str, str]:
    """Return the modules and packages in a folder, as a map from name to path."""
    try:
        entries = os.listdir(folder)  # noqa: PTH208
    except OSError:
        return {}
    paths = {entry: os.path.join(folder, entry) for entry in sorted(entries)}  # noqa: PTH118
    modules = {entry.removesuffix(".py"): path for entry, path in paths.items() if entry.endswith(".py")}
    packages = {entry: path for entry, path in paths.items() if os.path.isfile(os.path.join(path, _INIT))}  # noqa: PTH113, PTH118
    modules.pop("__init__", None)
    return {**modules, **packages}


def _folders_of_code(folder: str) -> dict[str, str]:
    """Return the packages without an `__init__.py` in a folder, as a map from name to path."""
    try:
        entries = [entry for entry in os.scandir(folder) if entry.is_dir() and entry.name.isidentifier()]
        return {
            entry.name: entry.path
            for entry in entries
            if any(glob.iglob(f"{glob.escape(entry.path)}/*.py"))  # noqa: PTH207 (as above)
        }
    except OSError:
        return {}


def _add_fallback(module: ModuleType) -> None:
    name = module.__name__

    def look_in_theirs(attribute: str) -> Any:
        missing = f"module {name!r} has no attribute {attribute!r}"
        # The import system asks for dunders and submodules before it loads them; this is no reason to run their code.
        is_dunder = attribute.startswith("__") and attribute not in _SHARED
        if is_dunder or attribute in _modules_in(_folder(name)):
            raise AttributeError(missing, name=attribute, obj=module)
        theirs = _load_theirs(name)
        if theirs is not None and attribute == "__all__" and not hasattr(theirs, attribute):
            return [public for public in vars(theirs) if not public.startswith("_")]
        if not hasattr(theirs, attribute):
            raise AttributeError(missing, name=attribute, obj=module)
        return getattr(theirs, attribute)

    module.__dict__["__getattr__"] = look_in_theirs


def _load_theirs(name: str) -> ModuleType | None:
    """Load the user's own package or module once, under its own name but not in `sys.modules`."""
    if name not in _theirs:
        spec = next((spec for spec in _their_specs(name) if spec.loader is not None), None)
        if spec is None or spec.loader is None:
            return None
        # Stored before it is executed, because its own modules may ask for it meanwhile.
        module = _theirs[name] = module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del _theirs[name]
            raise
    return _theirs[name]


def _refuse_loaded_clash(name: str) -> None:
    for submodule in sorted(_modules_in(_folder(name))):
        module = sys.modules.get(f"{name}.{submodule}")
        if module is None or module.__spec__ is None:
            continue
        file = module.__spec__.origin or next(iter(_places(module.__spec__)), "")
        if os.path.realpath(file).startswith(os.path.realpath(_folder(name)) + os.sep):
            continue
        raise ImportError(
            f"tune_jobs cannot be imported: it has a module {name}.{submodule}, and {file}, which is imported already, "
            "has the same name. Rename that file or its folder.",
            name=f"{name}.{submodule}",
            path=file,
        )


def _take_over(name: str) -> None:
    """Put our package in the place of what was imported under its name before."""
    before = sys.modules.get(name)
    if before is None:
        return
    if before.__spec__ is not None and _is_ours(before.__spec__, name):
        _add_fallback(before)
        return
    _theirs[name] = before
    del sys.modules[name]
    importlib.import_module(name)


def _warn_of_hidden(name: str) -> None:
    """Warn of the user's modules that cannot be imported any more; once, not in each process of a sweep."""
    multiprocessing = sys.modules.get("multiprocessing")
    if multiprocessing is not None and multiprocessing.parent_process() is not None:
        return
    ours = _modules_in(_folder(name))
    places = dict.fromkeys(place for spec in _their_specs(name) for place in _places(spec))
    hidden = {
        module: path
        for place in places
        for module, path in {**_folders_of_code(place), **_modules_in(place)}.items()
        if module in ours
    }
    if hidden:
        warnings.warn(
            f"tune-jobs has a package {name} too, with modules of the same names as {', '.join(hidden.values())}: "
            f"`import {name}.{next(iter(hidden))}` imports the one of tune-jobs. Rename your modules to import them.",
            stacklevel=4,
        )
