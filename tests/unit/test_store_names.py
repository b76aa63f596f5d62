"""What files a sweep has is known to the store alone: nobody else names one, or puts the path of one together."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.narrowing import present
from tune_jobs.store import contract, names, pack_contract, trial_contract

ROOT = Path(__file__).parents[2]
SOURCES = [path for path in sorted((ROOT / "tune_jobs").rglob("*.py")) if "store" not in path.relative_to(ROOT).parts]

# Words such as "best" mean other things too: as names of folders they are found where a path is put together.
FILES = {
    value
    for constant in vars(names).values()
    for value in (constant.values() if isinstance(constant, dict) else [constant])
    if isinstance(value, str) and re.fullmatch(r"\.?[a-z][a-z_-]*\.[a-z0-9]+|\.[a-z][a-z-]+", value)
}
FILE = re.compile(rf"(?<![\w-])({'|'.join(map(re.escape, sorted(FILES, key=len, reverse=True)))})(?![\w-])")
# The paths that a store hands out, and what they are called elsewhere.
HANDED_OUT = {
    node.name
    for module in (contract, trial_contract, pack_contract)
    for node in ast.walk(ast.parse(Path(present(module.__file__)).read_text()))
    if isinstance(node, ast.FunctionDef) and node.returns is not None and "Path" in ast.unparse(node.returns)
} | {"folder", "place", "sweep_place", "storage"}
ADDING = {"joinpath", "with_name", "with_stem", "with_suffix", "glob", "rglob", "iterdir", "relative_to", "parent"}


def known(source: str) -> Iterator[tuple[int, str]]:
    """What a module knows of the files in a sweep: lines, and what stands there."""
    tree = ast.parse(source)
    documentation = {
        node.body[0].value
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and node.body
        and isinstance(node.body[0], ast.Expr)
    }  # fmt: skip
    imported = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "tune_jobs.store.names"
        for alias in node.names
    }
    in_texts = {
        part.value for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)
        for part in node.values if isinstance(part, ast.FormattedValue)
    }  # fmt: skip
    for node in ast.walk(tree):
        match node:
            case ast.Constant(value=str(text)) if node not in documentation and FILE.search(text):
                yield node.lineno, text
            case ast.BinOp(op=ast.Div(), left=left) if is_handed_out(left):
                yield node.lineno, ast.unparse(node)
            case ast.Attribute(value=value, attr=attribute) if attribute in ADDING and is_handed_out(value):
                yield node.lineno, ast.unparse(node)
            case ast.Call(func=ast.Attribute(attr="join"), args=[ast.AST() as first, *_]) if is_handed_out(first):
                yield node.lineno, ast.unparse(node)
            case ast.Call(func=ast.Name(id="Path"), args=[ast.Attribute(attr="place" | "sweep_place"), *_]):
                yield node.lineno, ast.unparse(node)  # a URL is none
            case ast.Name(id=name) if name in imported and node not in in_texts:
                yield node.lineno, name
            case ast.ImportFrom(module="tune_jobs.store.places"):
                yield node.lineno, "tune_jobs.store.places"


def is_handed_out(node: Any) -> bool:
    match node:
        case ast.Attribute(attr=name) | ast.Subscript(slice=ast.Constant(value=name)):
            return name in HANDED_OUT
        case ast.Name(id=name):
            return name in HANDED_OUT - {"folder"}  # of anything
        case ast.Call(func=ast.Name(id="Path" | "str" | "open_sweep"), args=[first, *_]):
            return is_handed_out(first)
        case ast.Call(func=function):
            return is_handed_out(function)
        case ast.BinOp(left=left):
            return is_handed_out(left)
    return False


@pytest.mark.parametrize(
    "source",
    [
        'path = folder / "sweep.json"',
        'raise ValueError(f"Restore trial.json of {name}.")',
        'Owner.take(root / ".owner")',
        'FILMS = {"before": "before.mp4"}',
        'store.best_folder / "x"',
        "store.folder / name",
        'Path(config["sweep_place"]) / name',
        'os.path.join(job.sweep_place, "x")',
        "Path(store.place)",
        "store.checkpoint_folder(record) / name",
        "list(store.folder.iterdir())",
        "(trial.checkpoint_folder(3) / 'x').parent",
        "from tune_jobs.store.places import within",
        "from tune_jobs.store.names import RESULTS\npath = folder / RESULTS",
        "storage / name",
    ],
)
def test_such_knowledge_is_found(source: str) -> None:
    assert list(known(source)) != []


@pytest.mark.parametrize(
    "source",
    [
        '"""What sweep.json holds."""',
        'from tune_jobs.store.names import RESULTS\nmessage = f"{RESULTS} is damaged"',
        'summary = {"best": best, "report": path, "trials": 3}',
        "load_policy(store.best_folder)",
        "checkpoint / STATE_FOLDER",
        "folder.num_steps / 3",
    ],
)
def test_nothing_else_is(source: str) -> None:
    assert list(known(source)) == []


def test_nobody_but_the_store_knows_a_file_of_a_sweep() -> None:
    assert len(SOURCES) > 50
    assert {
        f"{path.relative_to(ROOT)}:{line}: {what}" for path in SOURCES for line, what in known(path.read_text())
    } == set()
