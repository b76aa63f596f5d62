"""YAML of sweep files: the words of YAML 1.2, refusals of what has two meanings, and no more than the limits."""

import json
import math
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from policies.errors import SpecError
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.plain_data import MAX_CHARACTERS, MAX_DEPTH
from tune_jobs.spec.yaml import parse_yaml

LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGES = "a: &a {k: 1}\n" + "".join(
    f"{name}: &{name} {{<<: [{', '.join([f'*{before}'] * 9)}]}}\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


def refused(text: str, label: str = "x.yaml") -> str:
    with pytest.raises(SpecError) as caught:
        parse_yaml(text, label)
    assert caught.value.hint
    return caught.value.message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\n---\na: 2\n", "line 2, column 1: expected a single document in the stream, but found another document"),
        ("a: &x 1\nb: &x 2\n", "line 2, column 4: found duplicate anchor 'x'; first occurrence, second occurrence"),
        ("a:\n\tb: 1\n", "line 2, column 1: there is a tab where YAML takes only spaces"),
        ("a: 1\t\nb: 2\n", "line 1, column 5: there is a tab where YAML takes only spaces"),
        ("a: 1\nb: \x07\n", r"line 2: the character '\x07' is not allowed in YAML"),
        ("a: 1\nb: \udcff\n", r"line 2: the character '\udcff' is not allowed in YAML"),
    ],
)
def test_what_is_no_yaml_is_told_in_whole_sentences_with_its_place(text: str, message: str) -> None:
    assert refused(text) == f"x.yaml, {message}"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None), ("~", None), ("null", None), ("Null", None), ("true", True), ("FALSE", False),
        ("0", 0), ("-0", 0), ("+12", 12), ("150_000", 150_000), ("-1_000", -1000), ("0o17", 15), ("0x1F", 31),
        ("1e-4", 1e-4), ("1E5", 1e5), ("3.", 3.0), (".5", 0.5), ("-.5e3", -500.0), ("1_000.5", 1000.5), ("08.5", 8.5),
        ("5.e1", 50.0),
        # no numbers, no dates, no truth values
        ("1__000", "1__000"), ("1_", "1_"), ("1,000", "1,000"), ("2024-01-01", "2024-01-01"), ("=", "="), ("y", "y"),
        ("1e", "1e"), ("0x", "0x"), ("-", ["-"]), ("nan", "nan"), ("inf", "inf"), ("None", "None"), ("10:70", "10:70"),
        ("a:30", "a:30"), ("'010'", "010"), ('"yes"', "yes"), ("'1:30'", "1:30"), ("!!str no", "no"), ("'<<'", "<<"),
        ("<<", "<<"),
        ("!!int '5'", 5), ("!!float 5", 5), ("|\n    010\n", "010\n"),
    ],
)  # fmt: skip
def test_words_mean_what_yaml_1_2_says_with_underscores(text: str, value: Any) -> None:
    if text == "-":
        assert parse_yaml("- '-'", "x") == value
        return
    read = parse_yaml(f"key: {text}", "x")["key"]
    assert (read, type(read)) == (value, type(value))


@pytest.mark.parametrize(("text", "value"), [(".inf", math.inf), ("-.INF", -math.inf), ("+.Inf", math.inf)])
def test_infinity_is_read_as_yaml_writes_it(text: str, value: float) -> None:
    assert parse_yaml(text, "x") == value
    assert math.isnan(parse_yaml(".NaN", "x"))


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("010", ["010 begins with 0", "Write 10, 0o10 if it is octal"]),
        ("-010", ["-010 begins with 0", "Write -10"]),
        ("089", ["089 begins with 0", "Write 89, or '089' in quotes"]),
        ("00", ["00 begins with 0"]),
        ("1:30", ["1:30 may mean a time, 90 to some", "'1:30' in quotes"]),
        ("-1:30", ["-1:30 may mean a time, -90 to some", "Write -90 if"]),
        ("1:30:00", ["5400"]),
        ("1:30.5", ["90.5"]),
        ("0b11", ["0b11 may mean a binary number", "Write 3"]),
        ("no", ["no may mean false or a text", "Write false, or 'no' in quotes"]),
        ("Yes", ["Yes may mean true or a text"]),
        ("on", ["Write true"]),
        ("OFF", ["Write false"]),
        ("!!bool yes", ["yes may mean true"]),
        ("!!int 010", ["010 begins with 0"]),
        ("!!int abc", ["the tag !!int"]),
        ("!!timestamp 2024-01-01", ["the tag !!timestamp"]),
        ("!!binary aGk=", ["the tag !!binary"]),
        ("!!set {a, b}", ["the tag !!set"]),
        ("!mine 3", ["the tag !mine"]),
        ("{[a]: 3}", ["a list or a mapping is used as a key"]),
    ],
)
def test_what_has_two_meanings_or_none_is_refused_with_both_and_its_place(text: str, parts: list[str]) -> None:
    with pytest.raises(SpecError) as caught:
        parse_yaml(f"first: 1\nkey: {text}", "x.yaml")
    assert caught.value.message.startswith("x.yaml, line 2, column ")
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        (
            "a: {b: 150,000}",
            "line 1, column 8: 150,000 is 150 and 000 here, as commas separate",
            "Write 150000 or 150_000.",
        ),
        (
            "a: {b: -1,500,000, c: 2}",
            "column 8: -1,500,000 is -1 and 500 and 000 here",
            "Write -1500000 or -1_500_000.",
        ),
        ("a: {b: 1,500,500}", "1,500,500 is 1 and 500 and 500 here", "Write 1500500 or 1_500_500."),
        ("a: {b: 0,001}", "0,001 is 0 and 001 here", "Write 0.001 with a point"),
        ("a: {b: 1,5}", "1,5 is 1 and 5 here", "Write 1.5 with a point"),
    ],
)
def test_a_comma_in_a_number_is_told_with_the_number(text: str, message: str, hint: str) -> None:
    with pytest.raises(SpecError) as caught:
        parse_yaml(text, "x.yaml")
    assert message in caught.value.message
    assert hint in caught.value.hint


@pytest.mark.parametrize(
    ("text", "message", "hint", "followed"),
    [
        (
            "{choice: [20,000, 50,000]}",
            "line 1, column 11: 20,000 is 20 and 000 here, as commas separate what is in brackets",
            "Write 20000 or 20_000.",
            "{choice: [20_000, 50_000]}",
        ),
        ("[-1,500,000]", "-1,500,000 is -1 and 500 and 000 here", "Write -1500000 or -1_500_000.", "[-1_500_000]"),
        ("[5, 1,050]", "column 5: 1,050 is 1 and 050 here", "Write 1050 or 1_050.", "[5, 1_050]"),
    ],
)
def test_a_comma_in_a_number_of_a_list_is_told_with_the_number(
    text: str, message: str, hint: str, followed: str
) -> None:
    with pytest.raises(SpecError) as caught:
        parse_yaml(text, "x.yaml")
    assert message in caught.value.message
    assert caught.value.hint == hint
    assert parse_yaml(followed, "x.yaml")


def test_several_numbers_in_a_list_need_no_space_between_them() -> None:
    assert parse_yaml("[1,200, 64,128,0]", "x") == [1, 200, 64, 128, 0]
    assert parse_yaml("[20,'000', 20,!!str 000]", "x") == [20, "000", 20, "000"]
    assert "010 begins with 0" in refused("[1, 010]")
    assert "000 begins with 0" in refused("[1500,000]")
    # Each is looked at once, which is soon done.
    many = [100] * 10_000
    assert parse_yaml(f"[{','.join(map(str, many))}]", "x") == many


def test_keys_of_digits_may_stay_empty_where_no_number_is_before_them() -> None:
    assert parse_yaml("{a: x, 000}", "x") == {"a": "x", "000": None}
    assert parse_yaml("{000, 1: 3, 5: 2}", "x") == {"000": None, "1": 3, "5": 2}
    assert parse_yaml("{a: 1, 2: }", "x") == {"a": 1, "2": None}
    assert parse_yaml("a: 1\n000:\n", "x") == {"a": 1, "000": None}


def test_keys_are_texts_as_they_are_written() -> None:
    assert parse_yaml("{no: 1, 010: 2, 1: 3, true: 4, ~: 5}", "x") == {"no": 1, "010": 2, "1": 3, "true": 4, "~": 5}


def test_characters_are_read_as_json_escapes_them(tmp_path: Path) -> None:
    args = {"\U0001f600": "a\U0001f600\U00010000b", "\U0010ffff": ["\ufeff\U0001f600", "\uffff"]}
    path = tmp_path / "mine.json"
    text = json.dumps({"env": {"id": "CartPole-v1", "args": args}, "algorithm": "random"})
    path.write_text(text, encoding="utf-8")
    assert r"\ud83d\ude00" in text
    assert parse_yaml(text, "mine.json")["env"]["args"] == args
    assert load_spec(path).env.args == args


@pytest.mark.parametrize("halves", [r"\ud83d", r"\ude00", r"\ude00\ud83d", r"\ud83d\ud83d\ude00"])
def test_half_a_character_is_refused(halves: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text(f'{{"env": {{"id": "CartPole-v1", "args": {{"a": "{halves}"}}}}}}', encoding="utf-8")
    with pytest.raises(SpecError, match="which is half a character"):
        load_spec(path)


def test_a_merged_mapping_gives_way_to_what_is_written() -> None:
    text = "a: &a {x: 1, y: 1}\nb: &b {y: 2, z: 2}\nc: {<<: [*a, *b], x: 3}\nd: {<<: *a, z: 4}"
    read = parse_yaml(text, "x")
    assert read["c"] == {"x": 3, "y": 1, "z": 2}
    assert read["d"] == {"x": 1, "y": 1, "z": 4}


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("a: &a {x: 1}\nb: {<<: *a, <<: *a}", "x.yaml, line 2, column 13: the key '<<' occurs twice (several"),
        ("{a: 1, 'a': 2}", "the key 'a' occurs twice"),
        ("<<: 3", "expected a mapping or list of mappings for merging, but found scalar"),
        ("<<: [3]", "expected a mapping for merging, but found scalar"),
        ("a: 1\n---\na: 2", "x.yaml, line 2"),
    ],
)
def test_nothing_stands_twice(text: str, part: str) -> None:
    assert part in refused(text)


@pytest.mark.parametrize(
    "text", ["a: \x00", "\x07", "a: '\ud800'", 'a: "\\u12"', "%YAML 3.0\n---\na: 1", "a: b: c", "\t- a"]
)
def test_what_is_no_yaml_is_told_so(text: str) -> None:
    assert refused(text).startswith("x.yaml")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (LAUGHS, ["stands for 490,329,064 values", "at most 100,000"]),
        (MERGES, ["values and keys; at most 100,000"]),
        ("a: &a " + "x" * 50_000 + "\nb: [" + ", ".join(["*a"] * 6) + "]", ["stands for 350,", "characters; at most"]),
        ("a: &a [*a]", ["line 1, column 4: contains itself"]),
        ("a: &a {b: {<<: *a}}", ["contains itself"]),
        ("[" * 20_000, ["is nested 65 deep; at most 64"]),
        ("{a: " * 20_000, ["is nested 65 deep; at most 64"]),
        ("- " * 20_000, ["is nested 65 deep; at most 64"]),
        (
            "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 200)),
            ["nested levels; at most 64"],
        ),
        ("x: [" + "1," * 100_001 + "]", ["has more than 100,000 values and keys"]),
        ("x: " + "y" * MAX_CHARACTERS, ["has 262,147 characters; at most 262,144"]),
        ("seed: " + "9" * 5_000, ["line 1, column 7: a number of 5,000 digits; at most 40"]),
        ("seed: 0x" + "f" * 5_000, ["a number of 5,002 digits"]),
    ],
)
def test_what_stands_for_too_much_is_refused_before_it_is_built(text: str, parts: list[str]) -> None:
    message = refused(text)
    for part in parts:
        assert part in message


def test_a_refusal_needs_little_memory() -> None:
    tracemalloc.start()
    refused(LAUGHS)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # What it stands for takes gigabytes.
    assert peak < 20_000_000


def test_the_limits_hold_for_set_too() -> None:
    flow = "{" + LAUGHS.strip().replace("\n", ", ") + "}"
    with pytest.raises(SpecError, match=r"--set env.args.*values and keys"):
        load_spec({"env": "x", "algorithm": "ppo"}, [f"env.args={flow}"])
    with pytest.raises(SpecError, match=f"nested more than {MAX_DEPTH} deep"):
        load_spec({"env": "x", "algorithm": "ppo"}, ["env." + ".".join("a" * 5_000) + "=1"])


def test_a_file_of_megabytes_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(b"#" * 5_000_000)
    with pytest.raises(SpecError, match="larger than"):
        load_spec(path)
