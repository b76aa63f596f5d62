"""How failed trials are run again is said wherever they are told of: `resume` alone leaves them as they are."""

from pathlib import Path
from typing import Any

import pytest
from sweep_folders import make_sweep_folder

from tune_jobs.cli.output import show_result
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.outcome import SweepResult


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    return make_sweep_folder(tmp_path / "mine")


def printed(store: SweepStore, capsys: pytest.CaptureFixture[str], *failed: str, **given: Any) -> str:
    trials = [
        trial.model_copy(update={"status": "failed", "error": "it broke"} if trial.trial_id in failed else {})
        for trial in store.read_trials()
    ]
    show_result(SweepResult(store.place, store.read_record(), trials, **given), as_json=False)
    return " ".join(capsys.readouterr().out.split())


def test_the_command_is_named_where_trials_failed(store: SweepStore, capsys: pytest.CaptureFixture[str]) -> None:
    again = f"`tune-jobs resume {store.folder} --retry-failed` runs"
    assert f"1 trial failed. Once the cause is mended, {again} it again." in printed(store, capsys, "t0000")
    assert f"2 trials failed. Once the cause is mended, {again} them again." in printed(store, capsys, "t0000", "t0001")
    assert "retry" not in printed(store, capsys)


def test_a_sweep_that_goes_on_first_names_one_command(store: SweepStore, capsys: pytest.CaptureFixture[str]) -> None:
    assert "retry" not in printed(store, capsys, "t0000", interrupted=True)
