"""Results that were written over in their own file, and records that are nested as no record is."""

from __future__ import annotations

from pathlib import Path

import pytest
from store_parts import make_iteration

from policies.errors import CheckpointError
from tune_jobs.store.record_files import read_json
from tune_jobs.store.results_tail import ResultsMark, read_new_points


def lines(*iterations: int) -> str:
    return "".join(make_iteration(number).model_dump_json() + "\n" for number in iterations)


def test_a_file_of_the_same_number_that_holds_something_else_is_read_anew(tmp_path: Path) -> None:
    """As the number of a file that is gone is given to another one, or a backup is copied over it."""
    path = tmp_path / "results.jsonl"
    path.write_text(lines(1, 2, 3))
    read = read_new_points(path, ResultsMark())
    assert [point.iteration for point in read.points] == [1, 2, 3]
    inode = path.stat().st_ino
    path.write_text(lines(1, 3, 4, 5, 6))
    assert path.stat().st_ino == inode
    again = read_new_points(path, read.mark)
    assert again.replaced
    assert [point.iteration for point in again.points] == [1, 3, 4, 5, 6]
    with path.open("a") as file:
        file.write(lines(7))
    last = read_new_points(path, again.mark)
    assert not last.replaced
    assert [point.iteration for point in last.points] == [7]


@pytest.mark.parametrize(("depth", "is_read"), [(250, True), (300, False)])
def test_a_record_that_is_nested_as_none_is_is_refused(tmp_path: Path, depth: int, is_read: bool) -> None:
    path = tmp_path / "sweep.json"
    path.write_text('{"a": ' + "[" * depth + "]" * depth + "}")
    if is_read:
        assert set(read_json(path, "sweep record")) == {"a"}
    else:
        with pytest.raises(CheckpointError, match="nested more than"):
            read_json(path, "sweep record")
