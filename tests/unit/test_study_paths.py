"""An Optuna study is in the file that the export says, whatever letters its path has."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from sweep_folders import make_sweep_folder

import tune_jobs


@pytest.mark.parametrize("output", ["lr={1e-3}/mine.db", "50%25 runs/mine.db", "what?/mine.db", "what?.db"])
def test_a_study_is_where_the_export_says(output: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("optuna")
    make_sweep_folder(tmp_path / "mine", seeds_per_point=1, num_samples=4)
    place = tmp_path / "out"
    place.mkdir()
    monkeypatch.chdir(place)
    path = tune_jobs.export("mine", "optuna", output=output, storage=tmp_path)["study"]
    assert path.absolute() == place / output
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("SELECT COUNT(*) FROM trials").fetchone() == (4,)
    assert [found for found in place.rglob("*") if found.is_file()] == [place / output]
