"""What the benchmark of the search keeps: runs with their own date and machine, none of which is lost or renamed."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from tests.benchmarks.search import kept
from tests.benchmarks.search.kept import DATA, keep, made, read_runs, runs_file
from tests.benchmarks.search.runs import Run


def runs(*scores: float, method: str = "gp") -> dict[tuple[str, int], Run]:
    return {
        (method, number): Run((0.0, score), {"lr": 0.1, "sizes": (64, 64)}, score - 1)
        for number, score in enumerate(scores)
    }


def read(folder: Path) -> list[dict[str, Any]]:
    found = read_runs("acrobot-dqn", "gp", folder)
    assert found is not None
    return list(found["runs"])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Five runs of one machine; what is kept from now on is of another one."""
    monkeypatch.setattr(kept, "machine_name", lambda: "the first")
    keep("acrobot-dqn", runs(1, 2, 3, 4, -math.inf), tmp_path)
    monkeypatch.setattr(kept, "machine_name", lambda: "the second")
    return tmp_path


def test_a_file_has_what_was_found(folder: Path) -> None:
    assert [run["scores"][1] for run in read(folder)] == [1, 2, 3, 4, None]
    assert read(folder)[0] == {**read(folder)[0], "best": {"lr": 0.1, "sizes": [64, 64]}, "test": 0}
    assert {run["machine"] for run in read(folder)} == {"the first"}


@pytest.mark.parametrize("number", [5, 2, 0])
def test_runs_that_are_found_again_are_not_written(folder: Path, number: int) -> None:
    file = runs_file("acrobot-dqn", "gp", folder)
    before = file.read_bytes()
    keep("acrobot-dqn", runs(*[1, 2, 3, 4, -math.inf][:number]), folder)
    assert file.read_bytes() == before


def test_a_further_run_leaves_those_before_to_their_machine(folder: Path) -> None:
    keep("acrobot-dqn", runs(1, 2, 3, 4, -math.inf, 6), folder)
    assert [run["machine"] for run in read(folder)] == ["the first"] * 5 + ["the second"]


def test_a_run_that_comes_out_otherwise_is_new_and_those_behind_it_are_gone(folder: Path) -> None:
    keep("acrobot-dqn", runs(1, 9, 3), folder)
    assert [(run["machine"], run["test"]) for run in read(folder)] == [
        ("the first", 0), ("the second", 8), ("the first", 2),
    ]  # fmt: skip


def test_the_sentence_names_each_machine_with_its_days() -> None:
    days = [("2026-11-24", "an AMD"), ("2026-11-23", "an Intel"), ("2026-11-26", "an AMD"), ("2026-11-25", "an AMD")]
    files = [{"runs": [{"date": day, "machine": machine}]} for day, machine in days]
    assert made(files) == "Made on an Intel, 2026-11-23; on an AMD, 2026-11-24 to 2026-11-26."


def test_each_run_that_is_kept_says_where_it_was_made() -> None:
    files = [file for file in DATA.glob("*.json") if "runs" in json.loads(file.read_text())]
    assert len(files) > 50
    for file in files:
        assert all(run["date"] and run["machine"] for run in json.loads(file.read_text())["runs"]), file.name
