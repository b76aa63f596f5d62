"""Read sweep files: YAML, presets and `--set`, with all their problems in one message."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NamedTuple, get_args

from pydantic import TypeAdapter

from analysis.records import TRAINING_LENGTH, Cost, SweepRecord
from policies.arguments import checked
from policies.errors import CheckpointError, SpecError, shortened
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM
from policies.suggestions import did_you_mean
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.fields import Section
from tune_jobs.spec.plain_data import MAX_CHARACTERS, to_plain
from tune_jobs.spec.problems import SPEC_HINT, Problem, WrongSpecError
from tune_jobs.spec.sections import AboutSpec
from tune_jobs.spec.slips import text_of_no_mapping, text_of_parentheses
from tune_jobs.spec.sweep_spec import STORED, SweepSpec
from tune_jobs.spec.yaml import parse_value, parse_yaml
from tune_jobs.store.names import SWEEP_RECORD
from tune_jobs.store.presence import is_file

# The most bytes of a file, for the most characters that are read, at 4 bytes each.
_MAX_BYTES = 4 * MAX_CHARACTERS
_LENGTH = "How long a training is, in env steps; stop.num_env_steps is left out."
_KINDS = {str: "one text", list: "a list"}
_SECTIONS_OF_TEXT = {"about": "title", "env": "id", "objective": "type", "scheduler": "type", "search": "type"}
"""Sections that may be written as one string, and the field that it stands for."""


class Preset(NamedTuple):
    """A sweep file that ships with the package; all but name and text are under its key `about`."""

    name: str
    title: str
    """One line."""
    source: str
    """Where its settings come from."""
    shows: str
    expected: str
    """The score that it reaches."""
    env_steps: str
    time: str
    """On 2 cores."""
    description: str
    """More."""
    text: str
    """The whole file."""

    def __repr__(self) -> str:
        return f"Preset(name={self.name!r}, title={self.title!r}, expected={self.expected!r}, ...)"


def list_presets() -> list[Preset]:
    """Return the presets, by name."""
    return [read_preset(name, file.read_text(encoding="utf-8")) for name, file in _preset_files().items()]


def preset_names() -> list[str]:
    """Return the names of the presets, in order, without reading them."""
    return list(_preset_files())


def read_preset(name: str, text: str) -> Preset:
    """Read a preset from its file's text; fields that `about` leaves out are empty.

    Args:
        name: The file's name without its suffix.
        text: The content of the file.
    """
    about = AboutSpec.model_validate((parse_yaml(text, f"preset {name}") or {}).get("about", {}))
    return Preset(name=name, **about.model_dump(), text=text)


def find_preset(name: str) -> Preset:
    """Return the preset of a name.

    Raises:
        SpecError: There is no such preset; the message names the nearest.
    """
    files = _preset_files()
    if name not in files:
        raise SpecError(
            f"There is no preset {name!r}.{did_you_mean(name, files)}",
            f"The presets are: {', '.join(files)}.",
        )
    return read_preset(name, files[name].read_text(encoding="utf-8"))


def _preset_files() -> dict[str, Traversable]:
    """Return the presets' files by name, in order, without reading them, which takes longer than planning one."""
    files = resources.files("tune_jobs.spec").joinpath("presets").iterdir()
    presets = {file.name.removesuffix(".yaml"): file for file in files if file.name.endswith(".yaml")}
    return dict(sorted(presets.items()))


@checked
def load_spec(source: str | Path | Mapping[str, Any], overrides: Sequence[str] = ()) -> SweepSpec:
    """Read and validate a sweep.

    Args:
        source: Path of a sweep file, name of a preset, or the content of a sweep file as a mapping.
        overrides: `a.b=value` assignments, as given to `--set`; the value is YAML. An empty value takes the
            field out.

    Returns:
        The sweep, valid by itself.

    Raises:
        SpecError: There is no such file or preset, it is not YAML, or the sweep is wrong; the message lists every
            problem.
    """
    label, data, text = _read(source)
    if overrides:
        set_paths = [_apply_override(data, override) for override in overrides]
        data = to_plain(data, f"{label} with --set")
    else:
        set_paths = []
    try:
        return SweepSpec.model_validate(data)
    except WrongSpecError as error:
        found = error.problems
    told = [Problem(path, f"{what}{' (from --set)' if _is_set(path, set_paths) else ''}") for path, what in found]
    # Where numbers in parentheses are cut at their commas, each part is a problem that leads elsewhere.
    cause = text_of_parentheses(text, "\n".join(map(" ".join, told)))
    raise WrongSpecError.of(label, told if cause is None else [Problem("", cause), *told])


def stored_spec(record: SweepRecord) -> SweepSpec:
    """Return the spec that a sweep was launched with.

    Raises:
        CheckpointError: The sweep's record has no spec that this version accepts.
    """
    try:
        # Another version may have fields that are null, and that this one doesn't know.
        stored = {key: value for key, value in record.spec.items() if value is not None}
        # A sweep of a version that had no such stage ended without it, and is not to begin training when it is read.
        stored = {"confirm": "none"} | stored
        if isinstance(env := stored.get("env"), Mapping):
            # One of a version that knew no masks trains on without the one that its environment may have.
            stored["env"] = {"action_mask": False} | dict(env)
        return SweepSpec.model_validate(stored, context=STORED)
    except WrongSpecError as error:
        told = "; ".join(f"spec.{path}: {text}" for path, text in error.problems)
        raise CheckpointError(
            f"{SWEEP_RECORD} of sweep {record.name} holds no spec that this tune-jobs accepts: {told[:1_000]}",
            "Restore it from a backup, or use the version of tune-jobs that it names.",
        ) from error


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the sweep file, for editors: all fields and the hyperparameters of each algorithm."""
    schema = SweepSpec.model_json_schema(mode="validation")
    definitions: dict[str, Any] = schema["$defs"]
    domain_schema = TypeAdapter(Domain).json_schema(ref_template="#/$defs/{model}")
    definitions |= domain_schema.pop("$defs")
    definitions["Domain"] = domain_schema
    rules = []
    for algorithm, model in HYPERPARAMS_BY_ALGORITHM.items():
        fixed = model.model_json_schema(ref_template="#/$defs/{model}")
        definitions[model.__name__] = fixed
        searched = {
            name: {"$ref": "#/$defs/Domain", "description": field.get("description", "")}
            for name, field in fixed["properties"].items()
        }
        searched[TRAINING_LENGTH] = {"$ref": "#/$defs/Domain", "description": _LENGTH}
        then = {
            "hyperparams": {"anyOf": [{"$ref": f"#/$defs/{model.__name__}"}, {"type": "null"}]},
            "space": {"type": ["object", "null"], "properties": searched, "additionalProperties": False},
        }
        condition = {"properties": {"algorithm": {"const": algorithm}}, "required": ["algorithm"]}
        rules.append({"if": condition, "then": {"properties": then}})
    properties = schema["properties"]
    properties["hyperparams"] = {"description": properties["hyperparams"]["description"]}
    properties["space"] = {"description": properties["space"]["description"]}
    for section, key in _SECTIONS_OF_TEXT.items():
        text = definitions[properties[section]["$ref"].rpartition("/")[2]]["properties"][key]
        properties[section] = {
            "anyOf": [{"type": "string"} | text, {"$ref": properties[section]["$ref"]}],
            "description": properties[section]["description"],
        }
    properties["confirm"] = {
        "anyOf": [{"const": "none"}, {"type": "boolean"}, {"$ref": properties["confirm"]["$ref"]}],
        "description": properties["confirm"]["description"],
    }
    texts, mapping = properties["objective"]["anyOf"]
    texts["enum"] = ["return", *texts["enum"]]
    names = {"type": "string", "enum": [*texts["enum"], *get_args(Cost)]}
    pair = {"type": "array", "items": names, "minItems": 2, "maxItems": 2, "uniqueItems": True}
    properties["objective"]["anyOf"] = [texts, pair, mapping]
    definitions["ObjectiveSpec"]["properties"]["type"] |= {"enum": texts["enum"]}
    definitions["EnvSpec"]["properties"]["atari"]["anyOf"].append({"type": "boolean"})
    for kind in Section.__subclasses__():
        if (inner := definitions.get(kind.__name__)) is not None:
            _let_be_empty(inner["properties"], {*inner.get("required", ()), *kind.NEVER_EMPTY})
    _let_be_empty(properties, (*schema["required"], "hyperparams", "space"))
    whole: dict[str, Any] = _with_limits({**schema, "title": "tune-jobs sweep file", "allOf": rules})
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | whole


def _let_be_empty(properties: dict[str, Any], others: Collection[str]) -> None:
    """Let the fields of a section be null, as those without a value are in YAML, but for some others."""
    for name in properties.keys() - set(others):
        if {"type": "null"} in properties[name].get("anyOf", ()):
            continue
        told = {key: properties[name].pop(key) for key in ("description", "default") if key in properties[name]}
        properties[name] = {"anyOf": [properties[name], {"type": "null"}], **told}


_LIMITS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}


def _with_limits(schema: Any) -> Any:
    """Return a schema with limits in JSON Schema's words; after a validator, pydantic 2.14 leaves its own words."""
    if isinstance(schema, list):
        return [_with_limits(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    return {_LIMITS.get(key, key): _with_limits(value) for key, value in schema.items()}


def _read(source: str | Path | Mapping[str, Any]) -> tuple[str, dict[str, Any], str]:
    """Return a source's name for messages, its content as plain JSON-like data, and its text, if it has one."""
    if isinstance(source, Mapping):
        label, data, text = "sweep", source, ""
    else:
        label, text = read_sweep_file(source)
        data = parse_yaml(text, label)
    if not isinstance(data, Mapping):
        kind = "is empty" if data is None else f"holds {_KINDS.get(type(data), 'one value')}"
        raise SpecError(f"{label}: {kind}, not the fields of a sweep", text_of_no_mapping(text, data) or SPEC_HINT)
    plain: dict[str, Any] = to_plain(data, label)
    return label, plain, text


def read_sweep_file(source: str | Path) -> tuple[str, str]:
    """Return the name, for messages, and the text of a sweep file or preset.

    Raises:
        SpecError: There is no such file or preset, or it can't be read.
    """
    path = Path(source)
    try:
        is_there = is_file(path)
    except CheckpointError as error:
        raise SpecError(error.message, error.hint) from error
    if not is_there:
        presets = _preset_files()
        if str(source) in presets:
            return f"preset {source}", presets[str(source)].read_text(encoding="utf-8")
        if path.is_dir():
            raise SpecError(f"{source} is a folder, not a sweep file", "Name the .yaml file, or a preset.")
        suggestion = did_you_mean(source, presets)
        raise SpecError(
            f"There is no sweep file {str(source)!r} and no preset of that name.{suggestion}",
            f"Name a .yaml file, or one of the presets: {', '.join(presets)}.",
        )
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise SpecError(f"{path}: is larger than {_MAX_BYTES:,} bytes", "Name a sweep file; those are short.")
        return path.name, content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise SpecError(
            f"{path}: can't be read: line {line} is not UTF-8, from byte {error.object[error.start]:#04x} on",
            "Name a text file, and save it as UTF-8.",
        ) from error
    except OSError as error:
        raise SpecError(f"{path}: can't be read: {error}", "Name a text file that you may read.") from error


def _apply_override(data: dict[str, Any], override: str) -> str:
    """Set one field in place, and return its dotted path."""
    path, equals, text = override.partition("=")
    path = path.strip()
    if not equals or not all(path.split(".")):
        raise SpecError(
            f"--set {override}: this is not an assignment",
            "Write --set a.b=value, such as --set stop.num_env_steps=50000.",
        )
    *parents, last = _names_in(path)
    section = data
    for index, parent in enumerate(parents):
        child = section.get(parent)
        if child is None or (isinstance(child, str) and parent in _SECTIONS_OF_TEXT and index == 0):
            # `env: CartPole-v1` is short for a mapping, which --set env.args... has to go into.
            child = {} if child is None else {_SECTIONS_OF_TEXT[parent]: child}
            section[parent] = child
        if not isinstance(child, dict):
            here = ".".join(parents[: index + 1])
            raise SpecError(
                f"--set {override}: {here} is {shortened(child)}, which has no fields", f"Set {here} itself."
            )
        section = child
    if text.strip():
        section[last] = parse_value(text, f"--set {override if len(override) <= 80 else path}")
    elif last in section or _is_known(path):
        section.pop(last, None)
    else:
        section[last] = None  # there is no such field, which is reported with all other problems
    return path


def _names_in(path: str) -> list[str]:
    """Return the names of a path; one of them has a dot, where searched hyperparameters are named."""
    parts, names = path.split("."), list[str]()
    while parts:
        is_of_space = names == ["space"] or (names[:1] == ["space"] and names[2:] == ["when"])
        num = 2 if is_of_space and ".".join(parts[:2]) == TRAINING_LENGTH else 1
        names.append(".".join(parts[:num]))
        parts = parts[num:]
    return names


def _is_known(path: str) -> bool:
    """Whether a sweep file may have a field of this path."""
    section, *names = _names_in(path)
    if section in ("hyperparams", "space") and names:
        if section == "space" and names[0] == TRAINING_LENGTH:
            return True
        return any(names[0] in model.model_fields for model in HYPERPARAMS_BY_ALGORITHM.values())
    field = SweepSpec.model_fields.get(section)
    inner = getattr(field.annotation, "model_fields", {}) if field is not None else {}
    return field is not None and (not names or names[0] in inner)


def _is_set(path: str, set_paths: Sequence[str]) -> bool:
    """Whether a problem's path is at or below a path that --set gave."""
    return any(re.match(rf"{re.escape(given)}(?:$|[.\[])", path) for given in set_paths)
