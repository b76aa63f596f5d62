"""Read YAML as the writer of a sweep file means it, within the limits of what a sweep file can need.

Words and numbers are those of YAML 1.2, with `_` between digits. Values that YAML 1.1 and 1.2 read differently (`010`,
`1:30`, `yes`) are refused, and the message says what they may mean. Dates are strings; keys are strings and must not
occur twice. An alias repeats what it names, so a few lines can stand for gigabytes: the size is counted before the data
are built. Everything else is PyYAML's; decision 26 says why no other library reads it.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple, NoReturn

import yaml
from typing_extensions import override

from policies.errors import SpecError
from tune_jobs.spec.plain_data import MAX_CHARACTERS, MAX_DEPTH, MAX_DIGITS, MAX_VALUES
from tune_jobs.spec.slips import text_of_no_space, text_of_toml

_TAG = "tag:yaml.org,2002:"
_NULL, _BOOL, _INT, _FLOAT, _STR = (f"{_TAG}{kind}" for kind in ("null", "bool", "int", "float", "str"))
_MERGE = f"{_TAG}merge"
_TWO_MEANINGS = "two meanings"
_CORRECT = "Correct the YAML there."
_SMALLER = "Write it shorter: a sweep file holds settings, not data."
_MOST_SHOWN = 80
_DIGITS = "[0-9]+(?:_[0-9]+)*"
# Words that YAML 1.1 reads as a number or a truth value, and YAML 1.2 as something else.
_TRUTH = {"yes": "true", "on": "true", "no": "false", "off": "false"}
_OCTAL = re.compile(r"[-+]?0[0-9_]+\Z")
_BINARY = re.compile(r"[-+]?0b[01_]+\Z")
_SEXAGESIMAL = re.compile(r"[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+(?:\.[0-9_]*)?\Z")
_PLAIN_WORDS = (
    (_MERGE, re.compile(r"<<\Z")),
    (_NULL, re.compile(r"(?:~|null|Null|NULL|)\Z")),
    (_BOOL, re.compile(r"(?:true|True|TRUE|false|False|FALSE)\Z")),
    (_TWO_MEANINGS, re.compile(rf"(?i:{'|'.join(_TRUTH)})\Z")),
    *((_TWO_MEANINGS, pattern) for pattern in (_OCTAL, _BINARY, _SEXAGESIMAL)),
    (_INT, re.compile(rf"(?:[-+]?{_DIGITS}|0o[0-7]+|0x[0-9a-fA-F]+)\Z")),
    (_FLOAT, re.compile(rf"[-+]?(?:\.{_DIGITS}|{_DIGITS}(?:\.(?:{_DIGITS})?)?)(?:[eE][-+]?{_DIGITS})?\Z")),
    (_FLOAT, re.compile(r"(?:[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z")),
)
"""The kinds of words that are not in quotes: the first that matches counts; all other words are strings."""


def parse_yaml(text: str, label: str) -> Any:
    """Return the data of a YAML text: mappings with strings as keys, lists, strings, numbers, true, false and null.

    Args:
        text: One YAML document.
        label: Its name in messages.

    Raises:
        SpecError: It is not YAML, has a key twice or a value with two meanings, or is larger than the limits.
    """
    if len(text) > MAX_CHARACTERS:
        raise SpecError(f"{label}: has {len(text):,} characters; at most {MAX_CHARACTERS:,} are read.", _SMALLER)
    try:
        return _Loader(_without_tabs(text)).get_single_data()
    except yaml.MarkedYAMLError as error:
        # Some errors have one half in each: "expected a single document in the stream", "but found another document".
        told = ", ".join(filter(None, (error.context, error.problem)))
        if "'\\t'" in told:
            told = "there is a tab where YAML takes only spaces"
        mark = error.problem_mark
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise SpecError(f"{label}{place}: {told}", error.note or _instead_of(text, mark) or _CORRECT) from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise SpecError(
            f"{label}, line {line}: the character {text[error.position]!a} is not allowed in YAML",
            "Take it out, or write it as an escape in double quotes.",
        ) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise SpecError(f"{label}: this is not YAML: {error}", "Correct the YAML.") from error


def _instead_of(text: str, mark: yaml.Mark | None) -> str | None:
    """Return what to write where a file is of another language, or the line before an error is `env:CartPole-v1`.

    YAML takes the latter for the beginning of a text of several lines, in which there can be no field. None: it is
    something else.
    """
    above = [line.strip() for line in text.splitlines()[: mark.line]] if mark is not None else []
    spaced = text_of_no_space(above[-1]) if above else None
    return text_of_toml(text) if spaced is None else f"In line {len(above)}, {spaced}."


def _without_tabs(text: str) -> str:
    """Return a JSON text with spaces for its tabs, which YAML 1.2 takes there and PyYAML does not; others as they are.

    JSON's texts hold no tabs, but escapes of them.
    """
    if "\t" in text and text.lstrip().startswith("{"):
        with suppress(ValueError, RecursionError):
            json.loads(text)
            return text.replace("\t", " ")
    return text


def parse_value(text: str, label: str) -> Any:
    """Return the data of a value that stands on a command line; the arguments are those of `parse_yaml`.

    Raises:
        SpecError: As there; or it is only a comment, which would be null, or ends with one.
    """
    value = parse_yaml(text, label)
    comment = text.strip()
    quotes = f'put it in quotes, {_quoted(comment)}, and on a command line in two pairs, "{_quoted(comment)}"'
    if value is None and comment.startswith("#"):
        raise SpecError(
            f"{label}: {_shown(comment)} is a comment in YAML, so there is no value",
            f"If it is the value, {quotes}.",
        )
    kept = comment.partition(" #")[0]
    if kept != comment and not set(comment) & set("'\"\n"):
        raise SpecError(
            f"{label}: what follows {_shown(kept)} is a comment in YAML, and no part of the value",
            f"If it is one, {quotes}; else leave it out.",
        )
    return value


def _shown(text: str) -> str:
    return text if len(text) <= _MOST_SHOWN else f"{text[: _MOST_SHOWN - 3]}..."


def _quoted(text: str) -> str:
    return "'" + _shown(text).replace("'", "''") + "'"


class _Extent(NamedTuple):
    """The size of a node's data, including all that its aliases repeat."""

    values: int
    characters: int
    depth: int


class _Loader(yaml.SafeLoader):
    """PyYAML's loader with the words above and within the limits."""

    yaml_implicit_resolvers = {None: list(_PLAIN_WORDS)}  # noqa: RUF012

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._num_nodes = 0
        self._extents: dict[yaml.Node, _Extent] = {}

    @override
    def get_single_node(self) -> yaml.Node | None:
        """Return the document, if its data are within the limits."""
        root: yaml.Node | None = super().get_single_node()
        if root is not None:
            _check_extent(self._extents[root])
        return root

    @override
    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node and note its size; stop at the limits, so that the rest is not even read."""
        self._depth += 1
        self._num_nodes += 1
        if self._depth > MAX_DEPTH:
            self._refuse_here(f"is nested {self._depth} deep; at most {MAX_DEPTH} are read")
        if self._num_nodes > 2 * MAX_VALUES:
            self._refuse_here(f"has more than {2 * MAX_VALUES:,} values and keys")
        is_alias = self.check_event(yaml.AliasEvent)
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        if node is not None and node not in self._extents:
            if is_alias:
                raise _error(node, "contains itself, by an alias", "Take the alias out.")
            self._extents[node] = self._extent(node)
        return node

    @override
    def compose_scalar_node(self, anchor: Any) -> yaml.ScalarNode:
        """Compose a scalar; the tag of `!!int "5"` asks for the meaning of the word without quotes."""
        node: yaml.ScalarNode = super().compose_scalar_node(anchor)
        # JSON escapes a character that does not fit into 16 bits as the two halves of a surrogate pair.
        node.value = node.value.encode("utf-16-le", "surrogatepass").decode("utf-16-le", "surrogatepass")
        if node.tag in (_NULL, _BOOL, _INT, _FLOAT):
            meant = self.resolve(yaml.ScalarNode, node.value, (True, False))  # type: ignore[no-untyped-call]
            if meant not in (node.tag, _TWO_MEANINGS) and (node.tag, meant) != (_FLOAT, _INT):
                _refuse_tag(self, node)
            node.tag = meant
        return node

    @override
    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Compose a mapping; its keys are strings as they are written, and must not occur twice."""
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        _refuse_commas(node)
        seen: set[str] = set()
        for index, (key, value) in enumerate(node.value):
            if not isinstance(key, yaml.ScalarNode):
                raise _error(key, "a list or a mapping is used as a key", "Use a text as the key.")
            is_merge = key.tag == _MERGE
            if key.value in seen:
                several = " (several mappings are merged by `<<: [*a, *b]`)" if is_merge else ""
                raise _error(key, f"the key {key.value!r} occurs twice{several}", "Keep one of them.")
            seen.add(key.value)
            if not is_merge:
                named = yaml.ScalarNode(_STR, key.value, key.start_mark, key.end_mark)
                node.value[index] = named, value
        return node

    @override
    def compose_sequence_node(self, anchor: Any) -> yaml.SequenceNode:
        """Compose a list; a number with commas in it is not taken for several."""
        node: yaml.SequenceNode = super().compose_sequence_node(anchor)
        _refuse_commas_in_list(node)
        return node

    def _extent(self, node: yaml.Node) -> _Extent:
        if isinstance(node, yaml.ScalarNode):
            return _Extent(1, len(node.value), 1)
        is_mapping = isinstance(node, yaml.MappingNode)
        children = itertools.chain.from_iterable(node.value) if is_mapping else node.value
        parts = [self._extents.get(child) or self._extent(child) for child in children]
        values, characters, depths = zip(*parts, strict=True) if parts else ((), (), ())
        return _Extent(1 + sum(values), 2 + sum(characters), 1 + max(depths, default=0))

    def _refuse_here(self, problem: str) -> NoReturn:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=self.get_mark(), note=_SMALLER)


def _check_extent(extent: _Extent) -> None:
    for number, limit, what in (
        (extent.values, 2 * MAX_VALUES, "values and keys"),
        (extent.characters, MAX_CHARACTERS, "characters"),
        (extent.depth, MAX_DEPTH, "nested levels"),
    ):
        if number > limit:
            # Python may refuse to print a number of more than 4,300 digits.
            shown = f"{number:,}" if number < 10**18 else "more than 10^18"
            problem = f"with its aliases it stands for {shown} {what}; at most {limit:,} are read."
            raise yaml.MarkedYAMLError(problem=problem, note=_SMALLER)


def _refuse_commas(node: yaml.MappingNode) -> None:
    """Refuse `{num_env_steps: 150,000}`, which YAML reads as 150 and a key 000 without a value."""
    for index, (_, value) in enumerate(node.value if node.flow_style else ()):
        if not _is_plain(value, r"[-+]?[0-9]+"):
            continue
        parts, end = [value.value], value.end_mark.index
        for key, nothing in itertools.islice(node.value, index + 1, None):
            if not (_is_plain(key, "[0-9]+") and _is_plain(nothing, "") and key.start_mark.index == end + 1):
                break
            parts.append(key.value)
            end = key.end_mark.index
        if len(parts) == 1:
            continue
        number, *groups = parts
        hint = "Write the number without commas."
        if number.lstrip("+-0") and len(number.lstrip("+-")) <= 3 and all(len(group) == 3 for group in groups):
            hint = f"Write {''.join(parts)} or {'_'.join(parts)}."
        elif len(groups) == 1:
            hint = f"Write {'.'.join(parts)} with a point."
        read = " and ".join(parts)
        raise _error(value, f"{','.join(parts)} is {read} here, as commas separate what is in braces", hint)


def _refuse_commas_in_list(node: yaml.SequenceNode) -> None:
    """Refuse `[20,000, 50,000]`, which YAML reads as four numbers; `[1,200]` may be two."""
    parts: list[yaml.Node] = []
    for item in node.value if node.flow_style else ():
        if parts and _is_plain(item, "[0-9]{3}") and item.start_mark.index == parts[-1].end_mark.index + 1:
            parts.append(item)
            continue
        _refuse_groups(parts)
        parts = [item] if _is_plain(item, r"[-+]?[0-9]{1,3}") else []
    _refuse_groups(parts)


def _refuse_groups(parts: Sequence[yaml.Node]) -> None:
    """Refuse what looks like the groups of one number if one begins with 0, which has two meanings by itself."""
    if any(part.tag == _TWO_MEANINGS for part in parts[1:]):
        texts = [part.value for part in parts]
        problem = f"{','.join(texts)} is {' and '.join(texts)} here, as commas separate what is in brackets"
        raise _error(parts[0], problem, f"Write {''.join(texts)} or {'_'.join(texts)}.")


def _is_plain(node: yaml.Node, pattern: str) -> bool:
    """Whether a node is a word without quotes that matches a pattern as a whole."""
    return isinstance(node, yaml.ScalarNode) and node.style is None and re.fullmatch(pattern, node.value) is not None


def _whole_number(loader: _Loader, node: yaml.ScalarNode) -> int:
    if len(node.value) > MAX_DIGITS:
        raise _error(node, f"a number of {len(node.value):,} digits; at most {MAX_DIGITS} are read", _SMALLER)
    return loader.construct_yaml_int(node)


def _refuse_two_meanings(_: _Loader, node: yaml.ScalarNode) -> NoReturn:
    text: str = node.value
    as_text = f"'{text}' in quotes if the text is meant"
    meant: int | str
    if text.lower() in _TRUTH:
        meant = _TRUTH[text.lower()]
        raise _error(node, f"{text} may mean {meant} or a text", f"Write {meant}, or {as_text}.")
    if _OCTAL.match(text):
        plain = int(text.replace("_", ""), 10)
        octal = f", 0o{abs(plain)} if it is octal" if set(text) <= set("-+_01234567") else ""
        raise _error(node, f"{text} begins with 0, which is octal to some", f"Write {plain}{octal}, or {as_text}.")
    if _BINARY.match(text):
        meant = int(text.replace("_", ""), 2) if len(text) < MAX_DIGITS else "the number itself"
        raise _error(node, f"{text} may mean a binary number or a text", f"Write {meant}, or {as_text}.")
    total = 0.0
    for part in text.lstrip("-+").replace("_", "").split(":"):
        total = total * 60 + float(part)
    if text.startswith("-"):
        total = -total
    raise _error(
        node,
        f"{text} may mean a time, {total:.10g} to some, or a text",
        f"Write {total:.10g} if that is meant, or {as_text}.",
    )


def _refuse_tag(_: _Loader, node: yaml.Node) -> NoReturn:
    tag = node.tag.replace(_TAG, "!!")
    raise _error(node, f"the tag {tag} is not known here, or not of such a value", "Take the tag out.")


def _error(node: yaml.Node, problem: str, hint: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=f"{problem}.", problem_mark=node.start_mark, note=hint)


_Loader.yaml_constructors = {
    **{tag: yaml.SafeLoader.yaml_constructors[tag] for tag in (_NULL, _BOOL, _FLOAT, _STR, f"{_TAG}seq", f"{_TAG}map")},
    _MERGE: yaml.SafeLoader.yaml_constructors[_STR],  # where it is a value
    _INT: _whole_number,
    _TWO_MEANINGS: _refuse_two_meanings,
    None: _refuse_tag,
}
