"""Where standard output lacks characters, commands say what they have to say, and JSON is JSON."""

import io
import json
import os
import subprocess
import sys

import pytest

from tune_jobs.cli.characters import has_all_characters, spell_missing_characters
from tune_jobs.cli.output import print_json

MAIN = [sys.executable, "-c", "from tune_jobs.cli.commands import main; main()"]


def printed(monkeypatch: pytest.MonkeyPatch, text: str, encoding: str, errors: str = "strict") -> bytes:
    written = io.BytesIO()
    with monkeypatch.context() as patch:
        stream = io.TextIOWrapper(written, encoding, errors)
        patch.setattr(sys, "stdout", stream)
        spell_missing_characters()
        stream.write(text)
        stream.flush()
        return written.getvalue()


@pytest.mark.parametrize(
    ("encoding", "errors", "expected"),
    [
        ("utf-8", "strict", "≥ 1, 5 ± 2, ██ …日".encode()),
        ("iso8859-1", "strict", b">= 1, 5 \xb1 2, ## ...?"),
        ("ascii", "strict", b">= 1, 5 +/- 2, ## ...?"),
        ("ascii", "ignore", b" 1, 5  2,  "),
    ],
)
def test_characters_that_are_missing_are_spelt_in_others(
    monkeypatch: pytest.MonkeyPatch, encoding: str, errors: str, expected: bytes
) -> None:
    assert printed(monkeypatch, "≥ 1, 5 ± 2, ██ …日", encoding, errors) == expected


@pytest.mark.parametrize("encoding", ["utf-8", "utf8", "iso8859-1", "ascii"])
def test_json_is_utf8_in_every_encoding(monkeypatch: pytest.MonkeyPatch, encoding: str) -> None:
    written = io.BytesIO()
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stream := io.TextIOWrapper(written, encoding))
        print_json({"names": ["é", "日"]})
        stream.flush()
        assert has_all_characters() == encoding.startswith("utf")
    assert json.loads(written.getvalue().decode("utf-8")) == {"names": ["é", "日"]}
    assert ("é".encode() in written.getvalue()) == encoding.startswith("utf")


def test_what_stands_for_standard_output_in_a_program_takes_every_character(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", io.StringIO())
        spell_missing_characters()
        assert has_all_characters()


def test_a_command_ends_well_in_an_encoding_that_lacks_what_it_prints() -> None:
    env = os.environ | {"PYTHONIOENCODING": "iso8859-1"}
    done = subprocess.run([*MAIN, "hyperparams", "ppo"], env=env, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"num_envs: 8  (whole number from 1 to 512)" in done.stdout
    assert b"(whole number >= 1 or null)" in done.stdout
