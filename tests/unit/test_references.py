"""What docstrings, comments, documents, messages and the JSON Schema name is there: code, files, commands, keys."""

import ast
import builtins
import functools
import io
import keyword
import re
import tokenize
from ast import ClassDef, Module
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import click
import pytest
from click.testing import CliRunner
from pydantic import BaseModel

from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM
from tests.narrowing import present
from tune_jobs.cli.commands import cli
from tune_jobs.plan.pack_plan import AT_ONCE_BY_MODEL, SHARE_AT_ONCE_BY_MODEL
from tune_jobs.spec.domains import DOMAIN_KINDS
from tune_jobs.spec.file import json_schema, list_presets
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.exports import _SUFFIXES as SUFFIXES
from tune_jobs.sweeps.exports import FORMATS

ROOT = Path(__file__).parents[2]
PACKAGES = ("policies", "analysis", "tune_jobs")
CODE = [path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))]
TESTS = [*sorted((ROOT / "tests").rglob("*.py")), *sorted((ROOT / "docs" / "examples").rglob("*.py"))]
# CHANGELOG.md names what was: it is not looked at.
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# What decisions were made against has names too; of theirs, files and commands are looked at.
DECISIONS = "docs/decisions/"

# Names of other projects, of examples, and of what a decision speaks against.
ELSEWHERE = {
    # RLlib, Ray Tune, Gymnasium, torch, TensorBoard
    "AutoresetMode", "NEXT_STEP", "DefaultModelConfig", "Learner", "PopulationBasedTraining", "hiddens", "logdir",
    "tensorflow", "forward_exploration",
    # Python
    "Loader", "MetaPathFinder",
    # uv, systemd and Slurm
    "uv", "MemoryMax", "CPUQuota", "scancel",
    # a user's own, and a user's mistakes
    "Net", "maze", "my_nets", "my_plots", "plot_all", "epochs",
    # parts of file names, colours and commands
    "rrggbb", "p00", "bench", "dq", "language", "lunarlander", "docs", "design", "md", "pong", "Breakout",
}  # fmt: skip
BLOCK = re.compile(r"```.*?```", re.DOTALL)
ENDINGS = {"py", "yaml", "json", "jsonl", "log", "txt", "csv", "safetensors", "html", "mp4", "gif", "damaged"}


@functools.cache
def names_and_texts() -> tuple[set[str], list[tuple[str, str]]]:
    """Every word that the code itself consists of; and all texts of it that a reader sees, by place.

    For whoever asks first: each process of a run collects all tests, and reading the code takes seconds.
    """
    names, texts = set(dir(builtins)) | set(keyword.kwlist), []
    for path in [*CODE, *TESTS]:
        own = path in CODE
        source = path.read_text()
        tree = ast.parse(source)
        documentation = set()
        for node in ast.walk(tree):
            for statement in body if isinstance(body := getattr(node, "body", None), list) else ():
                if isinstance(statement, ast.Expr) and isinstance(value := statement.value, ast.Constant):
                    documentation.add(value)
                    texts += [(f"{path.relative_to(ROOT)}:{value.lineno}", str(value.value))] if own else []
        for node in ast.walk(tree):
            names |= names_in(node)
            if own and isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in documentation:
                names |= set(re.findall(r"\w+", node.value))
        if own:
            comments = tokenize.generate_tokens(io.StringIO(source).readline)
            texts += [
                (f"{path.relative_to(ROOT)}:{token.start[0]}", token.string)
                for token in comments
                if token.type == tokenize.COMMENT
            ]
    for path in DOCUMENTS:
        # The names of an example are explained by it.
        names |= {word for block in BLOCK.findall(path.read_text()) for word in re.findall(r"\w+", block)}
    names |= {part for path in [*CODE, *TESTS] for part in path.relative_to(ROOT).with_suffix("").parts}
    texts += [(str(path.relative_to(ROOT)), path.read_text()) for path in DOCUMENTS]
    return names, texts


def all_names() -> set[str]:
    return names_and_texts()[0]


def all_texts() -> list[tuple[str, str]]:
    return names_and_texts()[1]


def names_in(node: Any) -> set[str]:
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.keyword(arg=name):
            return {name or ""}
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
            return {name}
        case ast.alias(name=name, asname=other):
            return {*name.split("."), other or ""}
        case ast.ImportFrom(module=name):
            return set((name or "").split("."))
    return set()


SECTIONS = {
    name: field.annotation.model_fields
    for name, field in SweepSpec.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
}


def defined() -> dict[str, set[str]]:
    """What each module and each class has: {"policies.files": {...}, "SweepStore": {...}}."""
    found: dict[str, Any] = {}
    for path in CODE:
        dotted = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        inside = members(ast.parse(path.read_text()))
        if path.name == "__init__.py":
            inside |= {other.stem for other in path.parent.iterdir()}
        found[dotted] = found.get(dotted, set()) | inside
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                found[node.name] = found.get(node.name, set()) | members(node)
    return found


def members(tree: ClassDef | Module) -> set[str]:
    inside = set()
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.ClassDef() | ast.AsyncFunctionDef():
                inside.add(node.name)
            case ast.Assign():
                inside |= {target.id for target in node.targets if isinstance(target, ast.Name)}
                inside |= {target.attr for target in node.targets if isinstance(target, ast.Attribute)}
            case ast.AnnAssign(target=ast.Name() | ast.Attribute() as target):
                inside.add(target.id if isinstance(target, ast.Name) else target.attr)
            case ast.alias():
                inside.add(node.asname or node.name)
    return inside


def quoted(text: str) -> Iterator[str]:
    """What stands between backticks, outside of blocks of code."""
    for match in re.finditer(r"``?([^`\n]+)``?", BLOCK.sub("", text)):
        yield match.group(1)


def test_every_word_in_backticks_is_one_of_the_code() -> None:
    missing = {
        f"{place}: `{reference}`"
        for place, text in all_texts()
        if not place.startswith(DECISIONS)
        for reference in quoted(text)
        for word in re.findall(r"[A-Za-z_]\w*", reference)
        if word not in all_names() and word not in ELSEWHERE
    }
    assert missing == set()


def test_every_dotted_name_of_ours_leads_somewhere() -> None:
    known = defined()
    by_stem: dict[str, Any] = {}
    for name, names in known.items():
        if "." in name:
            by_stem.setdefault(name.rpartition(".")[2], set()).update(names)
    missing = set()
    for place, text in all_texts():
        for reference in quoted(text) if not place.startswith(DECISIONS) else ():
            match = re.fullmatch(r"((?:\w+\.)+)(\w+)(\(.*\))?", reference)
            if match is None:
                continue
            head, last = match.group(1).removesuffix("."), match.group(2)
            if head in SECTIONS:
                continue
            inside = cast("set[str] | None", known.get(head, by_stem.get(head)))
            if inside is None and head.partition(".")[0] in PACKAGES:
                missing.add(f"{place}: `{reference}`: no {head}")
            # A file of data has an ending, no attribute; an inherited one is somebody else's.
            elif inside is not None and last not in inside and last not in ENDINGS:
                missing.add(f"{place}: `{reference}`: {head} has no {last}")
    assert missing == set()


def test_every_file_that_is_named_is_there() -> None:
    pattern = re.compile(r"(?<![\w/.<>-])((?:docs|tests|policies|analysis|tune_jobs|docker)/[\w./-]*\w)")
    missing = {
        f"{place}: {name}"
        for place, text in [*all_texts(), ("Makefile", (ROOT / "Makefile").read_text())]
        for name in pattern.findall(text)
        if not (ROOT / name).exists() and not (ROOT / f"{name}.py").exists()
    }
    assert missing == set()


def test_every_command_with_its_options_exists() -> None:
    pattern = re.compile(r"(^ *(?:\$ )?|[`\"' ]|bin/)tune-jobs ([a-z]+)\b([^`\n\"]*)", re.MULTILINE)
    wrong = set()
    for place, text in [*all_texts(), *((str(path.name), path.read_text()) for path in CODE)]:
        for before, name, rest in pattern.findall(text):
            command = cli.commands.get(name)
            if command is None:
                # In prose any word may stand behind the project's name.
                if before not in ('"', "'", " ") or rest.startswith(" --"):
                    wrong.add(f"{place}: tune-jobs {name}")
                continue
            if isinstance(command, click.Group):
                inner = command.commands.get(rest.split()[0] if rest.split() else "")
                if inner is None:
                    wrong.add(f"{place}: tune-jobs {name}{rest}")
                    continue
                command = inner
            options = {option for parameter in command.params for option in parameter.opts} | {"--help"}
            used = set(re.findall(r"(?<!\S)--[a-z-]+", rest))
            wrong |= {f"{place}: {name} {option}" for option in used - options}
    assert wrong == set()


def test_every_target_of_make_exists_and_is_given_none_of_a_programs_options() -> None:
    rules = (ROOT / "Makefile").read_text()
    targets = set(present(re.search(r"^\.PHONY: (.*)$", rules, re.MULTILINE)).group(1).split())
    # As code in a line, or at the beginning of a line of a block.
    pattern = re.compile(r"(?:`|^(?:\$ )?|&& )make ([^`\n#&]+)", re.MULTILINE)
    pages = [*DOCUMENTS, *(ROOT / name for name in ("CONTRIBUTING.md", "docker/README.md"))]
    texts = [*all_texts(), *((str(path.relative_to(ROOT)), path.read_text()) for path in pages)]
    found = {
        (place, line.strip())
        for place, text in texts
        for part in [*(f"`{code}`" for code in quoted(text)), *BLOCK.findall(text)]
        for line in pattern.findall(part)
    }
    assert len(found) > 10
    # What make itself takes beside targets are values of its variables.
    wrong = {
        f"{place}: make {line}"
        for place, line in found
        for word in line.split()
        if word not in targets and not re.fullmatch(r"[A-Z]+=\S+", word)
    }
    assert wrong == set()


def test_nobody_is_told_to_get_tune_jobs_from_an_index_which_has_none() -> None:
    """An extra, by its name in brackets, is added to the tune-jobs that is installed."""
    pattern = re.compile(r"pip install(?: -\S+)* [\"']?tune-jobs\b(?!\[)")
    texts = {path: path.read_text() for path in [*CODE, *DOCUMENTS, ROOT / "docker" / "README.md"]}
    assert [path for path, text in texts.items() if pattern.search(text)] == []


# Pages with what the command prints: a part of it, and the whole of it.
TUTORIAL = {page: (ROOT / page).read_text() for page in ("README.md", "docs/getting-started.md")}


def test_the_tutorials_sweep_is_told_alike_wherever_it_is() -> None:
    readme, page = (present(re.search(r"```\n(\d+ trials: .*?)```", text, re.DOTALL)) for text in TUTORIAL.values())
    lines = iter(page.group(1).splitlines())
    assert [line for line in readme.group(1).splitlines() if line != "..." and line not in lines] == []
    (times,) = {tuple(re.findall(r"(\d+) s after installation", text)) for text in TUTORIAL.values()}
    (preset,) = (preset for preset in list_presets() if preset.name == "cartpole-ppo")
    assert [preset.time] == [f"about {seconds} s on 2 cores" for seconds in times]
    num_trials, num_env_steps = re.findall(r"[\d,]+", page.group(1).splitlines()[0])[::2]
    words = r"about ([\d,]+) in (\d+) trials: the (\d+) of the search, and (\d+) with"
    steps, trials, searched, added = present(re.match(words, preset.env_steps)).groups()
    assert trials == num_trials == str(int(searched) + int(added))
    # To three digits.
    assert int(steps.replace(",", "")) == round(int(num_env_steps.replace(",", "")), -4)


def test_how_many_trials_a_model_has_at_once_is_in_the_guide() -> None:
    guide = (ROOT / "docs" / "guides" / "search.md").read_text()
    assert SHARE_AT_ONCE_BY_MODEL == 1 / 10
    assert f"at most {AT_ONCE_BY_MODEL} trials run at once, or a tenth of all" in guide
    (elsewhere,) = re.findall(r"at\s+most (\d+), or a tenth\]\(#a-model-of-the-finished-trials\)", guide)
    assert elsewhere == str(AT_ONCE_BY_MODEL)


def test_what_export_calls_its_files_is_in_the_guide() -> None:
    guide = (ROOT / "docs" / "guides" / "exports.md").read_text()
    names = {f"mine{SUFFIXES.get(kind, f'-{kind}/')}" for kind in FORMATS}
    assert set(re.findall(r"`(mine[-.][a-z]+/?)`", guide.partition("\n\n|")[0])) == names


def test_every_key_of_a_sweep_file_that_is_named_is_one() -> None:
    known = {name: set(fields) for name, fields in SECTIONS.items() if name != "env"}
    known["hyperparams"] = known["space"] = {
        name for model in HYPERPARAMS_BY_ALGORITHM.values() for name in model.model_fields
    }
    known["space"] = {*known["space"], "stop"}  # the length of training, stop.num_env_steps
    pattern = re.compile(rf"(?<![\w./])({'|'.join(known)})\.([a-z]\w*)")
    allowed = {"json", "items", "py", "values", "hiden_sizes"}
    wrong = {
        f"{place}: {section}.{name}"
        for place, text in all_texts()
        for section, name in pattern.findall(text)
        if name not in known[section] | allowed
    }
    assert wrong == set()


def described() -> list[str]:
    """The descriptions of the JSON Schema and the helps of the command line."""
    stack, found = [json_schema()], []
    while stack:
        item = stack.pop()
        if isinstance(item, dict):
            found += [item["description"]] if isinstance(item.get("description"), str) else []
            stack += item.values()
        elif isinstance(item, list):
            stack += item
    found += [CliRunner().invoke(cli, [name, "--help"]).output for name in cli.commands]
    return found


@pytest.mark.parametrize("text", sorted(set(described())))
def test_the_schema_and_the_helps_name_fields_and_options_that_there_are(text: str) -> None:
    fields = {name for model in [SweepSpec, *HYPERPARAMS_BY_ALGORITHM.values()] for name in model.model_fields}
    fields |= {name for inner in SECTIONS.values() for name in inner}
    words = set(re.findall(r"\b[a-z]+(?:_[a-z]+)+\b", text))
    assert words <= fields | set(DOMAIN_KINDS) | {"huber_loss", "rl_module", "he_uniform", "steps_to_threshold"}
