"""A sweep with a trial whose record is damaged: who looks at it sees the others, and nothing is trained or chosen."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import make_sweep_folder

from policies.errors import CheckpointError
from tune_jobs.service.statuses import Statuses
from tune_jobs.store.candidates import _warn
from tune_jobs.store.opening import open_storage
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sweep_folder(tmp_path_factory.mktemp("whole") / "mine").folder


@pytest.fixture
def store(template: Path, tmp_path: Path) -> SweepStore:
    """A finished sweep of four trials, of which t0001 has half a record."""
    _warn.cache_clear()
    store = SweepStore(shutil.copytree(template, tmp_path / "mine"))
    path = store.trial("t0001").record_path
    path.write_text(path.read_text()[:100])
    return store


READERS: dict[str, Callable[[Path], Any]] = {
    "status": sweeps.status,
    "list": lambda folder: sweeps.list_sweeps(folder.parent),
    "trials": sweeps.trials,
    "importance": sweeps.importance,
    "dataframe": sweeps.dataframe,
    "file": lambda folder: sweeps.export(folder, "sweep", output=folder.parent / "x.tunejobs"),
    "report": sweeps.report,
}


@pytest.mark.parametrize("reader", READERS)
def test_who_looks_is_told_which_trial_is_damaged_and_sees_the_others(
    store: SweepStore, reader: str, caplog: pytest.LogCaptureFixture
) -> None:
    READERS[reader](store.folder)
    assert "Left out: " in caplog.text
    assert "t0001/trial.json cannot be read as trial record" in caplog.text


def test_the_others_are_there(store: SweepStore) -> None:
    others = ["t0000", "t0002", "t0003"]
    assert [trial.trial_id for trial in sweeps.trials(store.folder)] == others
    (seen,) = sweeps.list_sweeps(store.folder.parent)
    assert (seen.counts, seen.sweep.num_trials) == ({"completed": 3}, 4)
    assert list(sweeps.dataframe(store.folder)["trial_id"]) == others
    # Of the service, too; what was damaged is read again when it was mended.
    statuses = Statuses(open_storage(store.folder.parent))
    assert [trial.trial_id for trial in statuses.see("mine").trials.records] == others
    store.trial("t0001").write_record(store.trial("t0000").read_record().model_copy(update={"trial_id": "t0001"}))
    assert len(Statuses(open_storage(store.folder.parent)).see("mine").trials.records) == 4


@pytest.mark.parametrize("verb", ["resume", "extend", "inject", "replicate", "best"])
def test_nothing_is_trained_or_chosen(store: SweepStore, verb: str) -> None:
    arguments: dict[str, tuple[Any, ...]] = {"extend": (1,), "inject": ({"lr": 0.005},)}
    before = {path: path.read_bytes() for path in store.folder.rglob("*.json")}
    with pytest.raises(CheckpointError, match=r"t0001/trial\.json") as caught:
        getattr(sweeps, verb)(store.folder, *arguments.get(verb, ()))
    assert "backup" in caught.value.hint
    assert {path: path.read_bytes() for path in store.folder.rglob("*.json")} == before
