"""Tables of the site that are drawn from the code: fields, hyperparameters, domains, commands, presets, decisions.

Types and ranges are taken from the JSON Schema of the sweep file, which is what editors check by.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM
from tune_jobs.cli.commands import cli
from tune_jobs.spec.file import json_schema, list_presets
from tune_jobs.spec.hyperparam_table import TYPE_WORDS, elsewhere_text, hyperparam_tables, range_text

Schema = Mapping[str, Any]

DECISIONS = Path(__file__).parents[1] / "decisions"
_TYPES = {**TYPE_WORDS, "boolean": "`true` or `false`", "null": "`null`"}


def sweep_fields() -> str:
    """The fields of a sweep file, and under a heading each those of its sections."""
    schema = json_schema()
    definitions = schema["$defs"]
    fields = _without_empty(schema)["properties"]
    sections = {name: section for name, field in fields.items() if (section := _section(field)) is not None}
    # A section may have one itself, whose heading is its path.
    for name, section in list(sections.items()):
        inner = definitions[section].get("properties", {})
        sections |= {f"{name}.{key}": deeper for key, field in inner.items() if (deeper := _section(field)) is not None}
    links = {section: f"mapping, [below](#{name.replace('.', '')})" for name, section in sections.items()}
    parts = [_fields({**schema, "properties": fields}, links)]
    for name, section in sections.items():
        inner = _without_empty(definitions[section])
        parts.append(f"## {name}\n\n{inner['description']}\n\n{_fields(inner, links)}")
    return "\n\n".join(parts)


def hyperparameters() -> str:
    """The hyperparameters of each algorithm, with the names that other libraries have for them."""
    definitions = json_schema()["$defs"]
    parts = []
    for table in hyperparam_tables():
        schema = definitions[HYPERPARAMS_BY_ALGORITHM[table.algorithm].__name__]
        elsewhere = {
            row.name: ". ".join(f"{library}: {_escaped(names)}" for library, names in elsewhere_text(row).items())
            for row in table.hyperparams
        }
        fields = _fields(schema, more=("elsewhere", elsewhere) if any(elsewhere.values()) else None)
        parts.append(f"## {table.algorithm}\n\n{_paragraphs(schema['description'])}\n\n{fields}")
        if table.not_here:
            lines = [f"- {row.library}: `{row.name}`: {_escaped(row.difference)}" for row in table.not_here]
            parts.append("Settings of other libraries that are no hyperparameters here:\n\n" + "\n".join(lines))
    return "\n\n".join(parts)


def domains() -> str:
    """What may stand in a space."""
    definitions = json_schema()["$defs"]
    references = re.findall(r"#/\$defs/(\w+)", json.dumps(definitions["Domain"]))
    rows: list[tuple[str, ...]] = []
    for name in dict.fromkeys(references):
        ((kind, field),) = ((key, field) for key, field in definitions[name]["properties"].items() if key != "when")
        rows.append((f"`{kind}`", field["description"], definitions[name]["description"]))
    return _table(("domain", "takes", "gives"), rows)


def commands() -> str:
    """What `--help` prints of `tune-jobs` itself, and of each command."""
    return "\n\n".join(_help(words, command) for words, command in _commands("tune-jobs", cli))


def _commands(words: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    """A command by the words that it is typed as, and those within it."""
    yield words, command
    for name, inner in command.commands.items() if isinstance(command, click.Group) else ():
        yield from _commands(f"{words} {name}", inner)


def _help(words: str, command: click.Command) -> str:
    # The terminal's width is no business of a page.
    with click.Context(command, info_name=words, terminal_width=100) as context:
        return f"### {words.removeprefix('tune-jobs ')}\n\n```text\n{command.get_help(context)}\n```"


def presets() -> str:
    """Every preset, with its file."""
    parts = []
    for preset in list_presets():
        facts = {
            "Source": preset.source, "Shows": preset.shows, "Expected": preset.expected, "Env steps": preset.env_steps,
            "Time": preset.time,
        }  # fmt: skip
        lines = "\n".join(f"- {label}: {_escaped(text)}" for label, text in facts.items() if text)
        text = "\n\n".join(part for part in (_escaped(preset.title) + ".", lines, _escaped(preset.description)) if part)
        parts.append(f"### {preset.name}\n\n{text}\n\n```yaml\n{_without_about(preset.text)}```")
    return "\n\n".join(parts)


def decisions() -> str:
    """Links to the decisions, by their headings."""
    found = [(path.name, path.read_text(encoding="utf-8")) for path in sorted(DECISIONS.glob("[0-9]*.md"))]
    return "\n".join(f"- [{text.partition(chr(10))[0].lstrip('# ')}]({name})" for name, text in found)


TABLES: dict[str, Callable[[], str]] = {
    function.__name__.replace("_", "-"): function
    for function in (sweep_fields, hyperparameters, domains, commands, presets, decisions)
}


def _fields(schema: Schema, links: Mapping[str, str] = {}, more: tuple[str, Mapping[str, str]] | None = None) -> str:
    """A table of a mapping's fields.

    Args:
        schema: The mapping.
        links: The words for fields that are mappings themselves, by definition.
        more: The heading of another column, and its texts by field.
    """
    required = schema.get("required", ())
    rows: list[tuple[str, ...]] = [
        (
            f"`{name}`",
            " or ".join(dict.fromkeys(_values(field, links))),
            "must be given" if name in required else _default(field),
            _escaped(field.get("description", "")),
            *([more[1][name]] if more is not None else []),
        )
        for name, field in schema["properties"].items()
    ]
    return _table(("field", "values", "default", "meaning", *([more[0]] if more is not None else [])), rows)


def _values(field: Schema, links: Mapping[str, str]) -> list[str]:
    """Types and ranges of a field, each in words."""
    if "$ref" in field:
        return [links[_section(field) or ""]]
    if "anyOf" in field:
        return [words for kind in field["anyOf"] for words in _values(kind, links)]
    if "prefixItems" in field:
        return [f"[{', '.join(words for item in field['prefixItems'] for words in _values(item, links))}]"]
    if "items" in field:
        return [f"list of: {words}" for words in _values(field["items"], links)]
    words = [field["const"]] if "const" in field else field.get("enum")
    if words is not None:
        return [", ".join(f"`{word}`" for word in words)]
    return [" ".join(filter(None, (_TYPES[field.get("type", "object")], range_text(field))))]


def _section(field: Schema) -> str | None:
    """The definition of the mapping that a field is, if it is one."""
    for kind in (field, *field.get("anyOf", ())):
        if "$ref" in kind:
            return str(kind["$ref"]).rpartition("/")[2]
        if kind is not field and (inner := _section(kind)) is not None:
            return inner
    return None


def _without_empty(section: Schema) -> Schema:
    """A mapping without the null of its fields that is the same as leaving them out: the page says so once."""
    fields = {name: field if field.get("default", "") is None else _without_null(field)
              for name, field in section["properties"].items()}  # fmt: skip
    return {**section, "properties": fields}


def _without_null(field: Schema) -> Schema:
    kinds = [kind for kind in field.get("anyOf", ()) if kind != {"type": "null"}]
    return {**field, "anyOf": kinds} if kinds else field


def _default(field: Schema) -> str:
    # No text is no word in a cell.
    if field.get("default", "") != "":
        default = field["default"]
        return f"`{default if isinstance(default, str) else json.dumps(default)}`"
    return "" if _section(field) is not None else "empty"


def _table(headings: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [headings, ("---",) * len(headings), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _paragraphs(text: str) -> str:
    return re.sub(r"\n(?!\n)\s*", "\n", text)


def _escaped(text: str) -> str:
    """A text that is no Markdown, as Markdown."""
    return re.sub(r"([\\*_<\[#])", r"\\\1", text)


def _without_about(text: str) -> str:
    """A preset's file without what it says about itself, which the page tells."""
    return re.sub(r"^about:\n(?: .*\n)*\n*", "", text, flags=re.MULTILINE)
