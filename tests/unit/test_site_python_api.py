"""The page of the Python API has each type that its functions return, and each error that they raise."""

import ast
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import tune_jobs
from policies.acting.policy import Policy
from tests.narrowing import present
from tune_jobs.client import Client

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "python-api.md"
OURS = ("policies", "analysis", "tune_jobs")


def found(path: str) -> Any:
    """What a dotted path of the page leads to."""
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


ENTRIES = {path: found(path) for path in re.findall(r"^::: ([\w.]+)$", PAGE.read_text(), re.MULTILINE)}
FUNCTIONS = {path: item for path, item in ENTRIES.items() if inspect.isfunction(item)}


def callables() -> Iterator[tuple[str, Any]]:
    """What a user may call: the functions of the page, and public methods of the two classes that do things."""
    yield from FUNCTIONS.items()
    for owner in (Client, Policy):
        for name, method in inspect.getmembers(owner, inspect.isfunction):
            if not name.startswith("_"):
                yield f"{owner.__name__}.{name}", method


def homes(module: Any) -> dict[str, str]:
    """Which module each name of a module comes from, those that only type checkers import among them."""
    known: dict[str, str] = {}
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.ImportFrom):
            known |= {alias.asname or alias.name: present(node.module) for alias in node.names}
        elif isinstance(node, ast.ClassDef):
            known[node.name] = module.__name__
    return known


def returned(function: Any) -> Iterator[type]:
    """The classes of this project in what a function is annotated to return, whatever they stand in."""
    function = inspect.unwrap(function)
    known = homes(inspect.getmodule(function))
    for word in re.findall(r"[\w.]+", str(function.__annotations__.get("return", ""))):
        if known.get(word, "").split(".")[0] in OURS and isinstance(thing := found(f"{known[word]}.{word}"), type):
            yield thing


def raised(text: str) -> list[str]:
    """The errors that a docstring names under "Raises:"."""
    section = re.search(r"^Raises:\n((?:(?: .*)?\n)*)", f"{inspect.cleandoc(text)}\n", re.MULTILINE)
    return [] if section is None else re.findall(r"^    (\w+): ", section[1], re.MULTILINE)


def test_a_star_imports_every_name_of_the_api() -> None:
    names: dict[str, Any] = {}
    exec("from tune_jobs import *", names)
    assert names.keys() - {"__builtins__"} == tune_jobs._HOME.keys()


def test_all_that_tune_jobs_has_is_on_the_page() -> None:
    assert {name for name in tune_jobs._HOME if f"tune_jobs.{name}" not in ENTRIES} == set()


def test_each_type_that_is_returned_is_on_the_page() -> None:
    shown = {item for item in ENTRIES.values() if isinstance(item, type)}
    wanted = {(place, item) for place, function in callables() for item in returned(function)}
    # In a list, a pair, an iterator; with its module, and imported for types alone.
    names = {item.__name__ for _, item in wanted}
    assert {"SweepStatus", "EvaluationRecord", "Event", "SweepResult", "TrialRecord", "Me"} <= names
    assert {f"{place} returns {item.__name__}" for place, item in wanted if item not in shown} == set()


def test_each_error_that_is_raised_is_on_the_page() -> None:
    shown = {path.rpartition(".")[2] for path in ENTRIES}
    wanted = {(place, error) for place, function in callables() for error in raised(function.__doc__ or "")}
    assert {"SpecError", "ObservationError", "SweepInterrupted", "ConflictError"} <= {error for _, error in wanted}
    assert {f"{place} raises {error}" for place, error in wanted if error not in shown} == set()


@pytest.mark.parametrize("path", ENTRIES)
def test_each_entry_has_the_path_that_it_is_imported_by(path: str) -> None:
    """One that `tune_jobs` or `tune_jobs.client` has is shown as theirs."""
    thing, name = ENTRIES[path], path.rpartition(".")[2]
    shorter = [home for home in ("tune_jobs", "tune_jobs.client") if getattr(import_module(home), name, None) is thing]
    assert path.rpartition(".")[0] in (shorter or [thing.__module__])
