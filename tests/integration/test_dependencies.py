"""What pyproject.toml requires is what the code imports, no less and no more."""

import ast
import re
import sys
import tomllib
from collections.abc import Sequence
from importlib.metadata import packages_distributions, requires
from pathlib import Path
from typing import Any, cast

import pytest
from packaging.requirements import Requirement

from tests.narrowing import present

OWN = {"policies", "analysis", "tune_jobs"}
# What later versions of Python have.
STANDARD_LIBRARY = {*sys.stdlib_module_names, "annotationlib"}
# Why something is required that nothing here imports; by distribution.
NOT_IMPORTED = {
    "psycopg": "SQLAlchemy loads it for PostgreSQL",
    "check-jsonschema": "it carries the schema of compose files",
    "kubernetes-validate": "it carries Kubernetes' schemas",
    "ale-py": "policies/envs/plugins.py imports it by its name",
    "opencv-python-headless": "Gymnasium's preprocessing of Atari games loads it",
    "build": "the tests build the wheel by `python -m build`",
    "optuna-dashboard": "a command, beside which the page is measured",
    "mkdocs-material": "the theme of the site",
    "mkdocstrings-python": "a plugin of MkDocs",
    "flask": "moto's server needs it",
    "flask-cors": "moto's server needs it",
    "mypy": "a command",
    "ruff": "a command",
    "pandas-stubs": "types, for mypy",
    "pytest-xdist": "a plugin of pytest, for `make unit`",
    "types-pyyaml": "types, for mypy",
}
# Gymnasium's own environments import it, by the same name from either.
DRAWN_WITH = {"pygame", "pygame-ce"}


@pytest.fixture(scope="module")
def project(pytestconfig: pytest.Config) -> dict[str, Any]:
    return cast("dict[str, Any]", tomllib.loads((pytestconfig.rootpath / "pyproject.toml").read_text())["project"])


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def distributions(requirements: Sequence[str]) -> set[str]:
    return {normal(present(re.match(r"[\w.-]+", text)).group()) for text in requirements}


def imported(folder: Path, names: Sequence[str] | set[str]) -> set[str]:
    """Distributions of other people's that the Python files of some folders import at their top level or anywhere."""
    tops = set()
    for path in [path for name in names for path in (folder / name).rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                tops |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                tops.add(present(node.module).partition(".")[0])
            elif isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.importorskip":
                tops.add(ast.literal_eval(node.args[0]).partition(".")[0])
    local = {path.stem for path in (folder / "tests").rglob("*.py")} | {"tests"} | OWN
    others = sorted(tops - STANDARD_LIBRARY - local)
    # An extra that is not installed here is not in what Python knows of its packages; MuJoCo's is in several parts.
    known = {"sklearn": ["scikit-learn"], **packages_distributions(), "mujoco": ["mujoco"]}
    return {normal(known[top][0]) if top in known else normal(top) for top in others}


def test_the_code_imports_what_it_requires_and_requires_what_it_imports(
    project: dict[str, Any], pytestconfig: pytest.Config
) -> None:
    required = distributions(project["dependencies"])
    optional = project["optional-dependencies"]
    used = imported(pytestconfig.rootpath, OWN)
    optionally = distributions([*optional["tpe"], *optional["forest"], *optional["box2d"]])
    assert (used - optionally) | DRAWN_WITH == required


def asked_for(requirements: Sequence[str], python: str, extra: str = "") -> set[str]:
    """What requirements ask for with a version of Python, with what the extras in them ask for of packages here."""
    found = set()
    for requirement in map(Requirement, requirements):
        if requirement.marker is None or requirement.marker.evaluate({"python_version": python, "extra": extra}):
            found.add(normal(requirement.name))
            for name in requirement.extras:
                found |= asked_for(requires(requirement.name) or [], python, name)
    return found


@pytest.mark.parametrize(("python", "drawn_with"), [("3.11", "pygame"), ("3.13", "pygame"), ("3.14", "pygame-ce")])
def test_environments_are_drawn_with_what_has_wheels(project: dict[str, Any], python: str, drawn_with: str) -> None:
    wanted = [*project["dependencies"], *project["optional-dependencies"]["test"]]
    assert asked_for(wanted, python) & DRAWN_WITH == {drawn_with}


def test_the_extras_are_what_the_tests_import(project: dict[str, Any], pytestconfig: pytest.Config) -> None:
    optional = project["optional-dependencies"]
    extras = distributions(
        [text for name in ("test", "docs", "bench", "box2d", "tpe", "forest") for text in optional[name]]
    )
    used = imported(pytestconfig.rootpath, ["tests"])
    assert used - extras - distributions(project["dependencies"]) == set()
    assert extras - used == set(NOT_IMPORTED)


def test_the_constraints_pin_everything_that_is_required(project: dict[str, Any], pytestconfig: pytest.Config) -> None:
    lines = (pytestconfig.rootpath / "constraints.txt").read_text().splitlines()
    pinned = {normal(line.partition("==")[0]) for line in lines if "==" in line}
    optional = project["optional-dependencies"]
    wanted = [*project["dependencies"], *(text for extra in optional.values() for text in extra)]
    assert distributions(wanted) - pinned == set()
