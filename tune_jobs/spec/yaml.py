"""YAML as the writer of a sweep file means it, and never more of it than a sweep file can need.

Words and numbers are those of YAML 1.2, with `_` between digits; whatever YAML 1.1 and 1.2 read differently (`010`,
`1:30`, `yes`) is refused with what it could mean. Dates are texts, keys are texts and stand once. An alias repeats
what it names, so a few lines can stand for gigabytes: what a text stands for is counted before it is built.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import yaml

from policies.errors import SpecError
from tune_jobs.spec.plain_data import MAX_CHARACTERS, MAX_DEPTH, MAX_DIGITS, MAX_VALUES

_TAG = "tag:yaml.org,2002:"
_MERGE, _PLAIN = f"{_TAG}merge", "plain"
_SMALLER = "Write it shorter: a sweep file holds settings, not data."
_WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}
_DIGITS = "[0-9]+(?:_[0-9]+)*"
_INTEGER = re.compile(rf"[-+]?{_DIGITS}|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(
    rf"[-+]?(?:\.{_DIGITS}|{_DIGITS}(?:\.(?:{_DIGITS})?)?)(?:[eE][-+]?{_DIGITS})?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
)
# What YAML 1.1 takes for a number or a truth value, and YAML 1.2 for something else.
_OCTAL = re.compile(r"[-+]?0[0-9_]+")
_BINARY = re.compile(r"[-+]?0b[01_]+")
_SEXAGESIMAL = re.compile(r"[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+(?:\.[0-9_]*)?")
_TRUTH = {"yes": "true", "on": "true", "no": "false", "off": "false"}


def parse_yaml(text: str, label: str) -> Any:
    """What a YAML text stands for: mappings with texts as keys, lists, texts, numbers, true, false and null.

    Args:
        text: One YAML document.
        label: What messages call it.

    Raises:
        SpecError: It is no YAML, says something twice or in two senses, or stands for more than the limits.
    """
    if len(text) > MAX_CHARACTERS:
        raise SpecError(f"{label}: has {len(text):,} characters; at most {MAX_CHARACTERS:,} are read.", _SMALLER)
    try:
        node = _Loader(text).get_single_node()
        if node is None:
            return None
        _check_extent(node, label)
        return _Builder(label).build(node)
    except yaml.MarkedYAMLError as error:
        # Some say half of it in each: "expected a single document in the stream", "but found another document".
        told = ", ".join(filter(None, (error.context, error.problem)))
        if "'\\t'" in told:
            told = "a tab stands where YAML takes spaces alone"
        raise SpecError(f"{label}{_place(error.problem_mark)}: {told}", "Correct the YAML there.") from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise SpecError(
            f"{label}, line {line}: the character {text[error.position]!a} is not allowed in YAML",
            "Take it out, or write it as an escape in double quotes.",
        ) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise SpecError(f"{label}: this is no YAML: {error}", "Correct the YAML.") from error


class _Loader(yaml.SafeLoader):
    """Nodes alone: a plain word is told from a quoted one, and read when it is built."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._num_nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Stop at the limits: what lies beyond is not even read."""
        self._depth += 1
        self._num_nodes += 1
        if self._depth > MAX_DEPTH or self._num_nodes > 2 * MAX_VALUES:
            what = (
                f"is nested {self._depth} deep; at most {MAX_DEPTH} are read"
                if self._depth > MAX_DEPTH
                else f"has more than {2 * MAX_VALUES:,} values and keys"
            )
            raise yaml.MarkedYAMLError(problem=f"{what}. {_SMALLER}", problem_mark=self.get_mark())
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def resolve(self, kind: type[yaml.Node], value: Any, implicit: Any) -> str:
        """The tag of a node that is given none."""
        if kind is yaml.ScalarNode and implicit[0]:
            return _MERGE if value == "<<" else _PLAIN
        return str(super().resolve(kind, value, implicit))  # type: ignore[no-untyped-call]


class _Extent(NamedTuple):
    """What a node stands for, with all that its aliases repeat."""

    values: int
    characters: int
    depth: int


def _children(node: yaml.Node) -> Iterator[yaml.Node]:
    if isinstance(node, yaml.SequenceNode):
        yield from node.value
    elif isinstance(node, yaml.MappingNode):
        for pair in node.value:
            yield from pair


def _check_extent(root: yaml.Node, label: str) -> None:
    """Refuse a document that stands for too much; takes time by what is written, not by what that stands for."""
    known: dict[int, _Extent] = {}
    above: set[int] = set()

    def measure(node: yaml.Node) -> _Extent:
        if (found := known.get(id(node))) is not None:
            return found
        if id(node) in above:
            raise SpecError(f"{label}{_place(node.start_mark)}: contains itself, by an alias.", "Take the alias out.")
        above.add(id(node))
        parts = [measure(child) for child in _children(node)]
        above.remove(id(node))
        own = len(node.value) if isinstance(node, yaml.ScalarNode) else 2
        extent = _Extent(
            1 + sum(part.values for part in parts),
            own + sum(part.characters for part in parts),
            1 + max((part.depth for part in parts), default=0),
        )
        known[id(node)] = extent
        return extent

    values, characters, depth = measure(root)
    for number, limit, what in (
        (values, 2 * MAX_VALUES, "values and keys"),
        (characters, MAX_CHARACTERS, "characters"),
        (depth, MAX_DEPTH, "levels, one in the other"),
    ):
        if number > limit:
            # Of the number itself, Python may refuse to print more than 4,300 digits.
            shown = f"{number:,}" if number < 10**18 else "more than 10^18"
            raise SpecError(
                f"{label}: with its aliases it stands for {shown} {what}; at most {limit:,} are read.", _SMALLER
            )


class _Builder:
    """Data from nodes whose extent is known to be small."""

    def __init__(self, label: str) -> None:
        self._label = label

    def build(self, node: yaml.Node) -> Any:
        if isinstance(node, yaml.MappingNode):
            self._check_tag(node, "map")
            return self._mapping(node)
        if isinstance(node, yaml.SequenceNode):
            self._check_tag(node, "seq")
            return [self.build(item) for item in node.value]
        assert isinstance(node, yaml.ScalarNode)
        return self._scalar(node)

    def _mapping(self, node: yaml.MappingNode) -> dict[str, Any]:
        own: dict[str, Any] = {}
        merged: dict[str, Any] = {}
        seen: set[str] = set()
        for key_node, value_node in node.value:
            key = self._key(key_node)
            is_merge = key_node.tag == _MERGE
            if key in seen:
                several = " (several mappings are merged by `<<: [*a, *b]`)" if is_merge else ""
                raise self._error(key_node, f"the key {key!r} stands twice{several}", "Keep one of them.")
            seen.add(key)
            if is_merge:
                merged = self._merged(value_node)
            else:
                own[key] = self.build(value_node)
        return {**merged, **own}

    def _merged(self, node: yaml.Node) -> dict[str, Any]:
        sources = node.value if isinstance(node, yaml.SequenceNode) else [node]
        merged: dict[str, Any] = {}
        for source in sources:
            if not isinstance(source, yaml.MappingNode):
                raise self._error(node, "<< takes a mapping, or a list of them", "Give it an alias of a mapping.")
            # Of several, the first that has a key wins.
            merged = {**self._mapping(source), **merged}
        return merged

    def _key(self, node: yaml.Node) -> str:
        if not isinstance(node, yaml.ScalarNode):
            raise self._error(node, "a list or a mapping stands as a key", "Use a text as the key.")
        return str(node.value)

    def _scalar(self, node: yaml.ScalarNode) -> Any:
        if node.tag in (_MERGE, f"{_TAG}str"):
            return node.value
        if node.tag == _PLAIN:
            return self._plain(node)
        # `!!int "5"`: the tag asks for what the bare word means.
        kinds = {"int": int, "float": int | float, "bool": bool, "null": type(None)}
        kind = kinds.get(node.tag.removeprefix(_TAG))
        if kind is None or not isinstance(value := self._plain(node), kind):
            raise self._wrong_tag(node)
        return value

    def _plain(self, node: yaml.ScalarNode) -> Any:
        text: str = node.value
        if text in _WORDS or text in ("True", "TRUE", "False", "FALSE", "Null", "NULL"):
            return _WORDS[text.lower()]
        self._refuse_two_meanings(node)
        if _INTEGER.fullmatch(text):
            if len(text) > MAX_DIGITS:
                raise self._error(node, f"a number of {len(text):,} digits; at most {MAX_DIGITS} are read", _SMALLER)
            return int(text, 0) if text.startswith(("0o", "0x")) else int(text)
        if _FLOAT.fullmatch(text):
            # Python writes infinity and NaN without the dot.
            return float(text.replace(".", "") if text[-1] in "fFnN" else text)
        return text

    def _refuse_two_meanings(self, node: yaml.ScalarNode) -> None:
        text: str = node.value
        as_text = f"'{text}' in quotes if the text is meant"
        meant: int | str
        if text.lower() in _TRUTH:
            meant = _TRUTH[text.lower()]
            raise self._error(node, f"{text} may mean {meant} or a text", f"Write {meant}, or {as_text}.")
        if _OCTAL.fullmatch(text):
            plain = int(text.replace("_", ""), 10)
            octal = f", 0o{abs(plain)} if it is octal" if set(text) <= set("-+_01234567") else ""
            raise self._error(
                node, f"{text} begins with 0, which is octal to some", f"Write {plain}{octal}, or {as_text}."
            )
        if _BINARY.fullmatch(text):
            meant = int(text.replace("_", ""), 2) if len(text) < MAX_DIGITS else "the number itself"
            raise self._error(node, f"{text} may mean a binary number or a text", f"Write {meant}, or {as_text}.")
        if _SEXAGESIMAL.fullmatch(text):
            total = 0.0
            for part in text.lstrip("-+").replace("_", "").split(":"):
                total = total * 60 + float(part)
            raise self._error(
                node,
                f"{text} may mean a time, {total:.10g} to some, or a text",
                f"Write {total:.10g} if that is meant, or {as_text}.",
            )

    def _check_tag(self, node: yaml.Node, kind: str) -> None:
        if node.tag != f"{_TAG}{kind}":
            raise self._wrong_tag(node)

    def _wrong_tag(self, node: yaml.Node) -> SpecError:
        tag = node.tag.replace(_TAG, "!!")
        return self._error(node, f"the tag {tag} is not known here, or not of such a value", "Take the tag out.")

    def _error(self, node: yaml.Node, problem: str, hint: str) -> SpecError:
        return SpecError(f"{self._label}{_place(node.start_mark)}: {problem}.", hint)


def _place(mark: yaml.Mark | None) -> str:
    return f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
