"""Nothing that is read from a sweep folder names a place outside it, and no link in it is followed."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from trial_runs import Trial

from analysis.records import CheckpointRecord, TrialRecord
from policies.errors import CheckpointError, NotFoundError
from tune_jobs.store.pack_files import Assignment, PackFiles
from tune_jobs.store.record_files import seal
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.trial_store import TrialStore


def edit(file: Path, /, **changes: Any) -> None:
    """As somebody would who knows how manifests are sealed."""
    data = json.loads(file.read_text()) | changes
    file.write_text(json.dumps(data | {"sha256": seal(data)}))


@pytest.fixture
def precious(tmp_path: Path) -> Iterator[Path]:
    """A folder outside the sweep, with what must not be touched."""
    folder = tmp_path / "precious"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    yield folder
    assert [path.name for path in folder.iterdir()] == ["thesis.txt"]
    assert (folder / "thesis.txt").read_text() == "years of work"


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """A sweep's folder whose trial has checkpoints 10, 20 and 25, the latest."""
    folder = tmp_path / "sweeps" / "mine"
    trial = Trial(
        folder, stop={"num_iterations": 25}, scores=lambda iteration: -float(iteration), checkpoints={"keep": 3}
    )
    trial.run()
    return folder


@pytest.mark.parametrize("place", ["{precious}", "../../precious", "trials/t0000/checkpoints/../../../../../precious"])
def test_a_manifest_does_not_say_what_is_deleted_when_old_checkpoints_are_pruned(
    sweep: Path, precious: Path, place: str
) -> None:
    store = TrialStore(sweep, "t0000")
    kept = [record.iteration for record in store.checkpoints()]
    for iteration in kept:
        edit(store.checkpoints_folder / f"{iteration:06d}" / "manifest.json", path=place.format(precious=precious))
    # It goes on as `resume` lets it.
    Trial(sweep, stop={"num_iterations": 60}).run()
    assert precious.is_dir()
    left = {record.iteration for record in store.checkpoints()}
    assert len(left) < len(kept) + 4
    assert left - set(kept)
    assert set(kept) - left


@pytest.mark.parametrize(
    "changes", [{"trial_id": "t0001"}, {"iteration": 5}, {"trial_id": "../../precious"}, {"iteration": -1}]
)
def test_a_manifest_of_another_checkpoint_is_refused(sweep: Path, precious: Path, changes: dict[str, Any]) -> None:
    folder = TrialStore(sweep, "t0000").checkpoint_folder(25)
    edit(folder / "manifest.json", **changes)
    with pytest.raises(CheckpointError, match="000025"):
        TrialStore(sweep, "t0000").checkpoints()


@pytest.mark.parametrize(
    "name",
    ["../../precious", "..", "", "t1", "t0000/../t0000", "t\u0660\u0660\u0660\u0660", "t0000\n", "t" + "0" * 300],
)
def test_a_trial_is_called_by_its_number_alone(sweep: Path, precious: Path, name: str) -> None:
    with pytest.raises(NotFoundError, match="is not a trial's id"):
        SweepStore(sweep).trial(name)
    with pytest.raises(ValueError, match="trial_id"):
        TrialRecord(trial_id=name, index=0, point_index=0, seed=1, point={})
    with pytest.raises(ValueError, match="trial_id"):
        CheckpointRecord(trial_id=name, iteration=1, num_env_steps=1)


def test_the_record_in_a_trials_folder_is_that_trials(sweep: Path) -> None:
    store = SweepStore(sweep)
    store.trial("t0000").write_record(TrialRecord(trial_id="t0000", index=0, point_index=0, seed=1, point={}))
    assert [record.trial_id for record in store.read_trials()] == ["t0000"]
    edit(store.trial("t0000").record_path, trial_id="t0001")
    with pytest.raises(CheckpointError, match="is in the folder of t0000"):
        store.read_trials()


def move_and_link(path: Path, precious: Path) -> None:
    """A link to the precious folder, or its file, where a part of the sweep was."""
    if path.is_dir():
        path.rename(path.parent.parent / "moved")
        path.symlink_to(precious, target_is_directory=True)
    else:
        path.unlink(missing_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(precious / "thesis.txt")


@pytest.mark.parametrize(
    "part",
    ["trials", "trials/t0000", "trials/t0000/checkpoints", "trials/t0000/checkpoints/000025",
     "trials/t0000/results.jsonl"],
)  # fmt: skip
def test_a_trial_does_not_go_on_through_a_link(sweep: Path, precious: Path, part: str) -> None:
    move_and_link(sweep / part, precious)
    with pytest.raises(CheckpointError, match="symbolic link"):
        Trial(sweep, stop={"num_iterations": 60}).run()


def test_a_link_is_no_checkpoint_to_go_on_from(sweep: Path, precious: Path) -> None:
    (sweep / "trials" / "t0000" / "checkpoints" / "000030").symlink_to(precious, target_is_directory=True)
    with pytest.raises(CheckpointError, match="000030 is a symbolic link"):
        Trial(sweep)


@pytest.mark.parametrize("name", [".000026.1234", ".000025.deleted"])
def test_a_link_among_the_leftovers_is_left(sweep: Path, precious: Path, name: str) -> None:
    link = sweep / "trials" / "t0000" / "checkpoints" / name
    link.symlink_to(precious, target_is_directory=True)
    Trial(sweep)
    assert link.is_symlink()


@pytest.mark.parametrize("attribute", ["best_folder", "report_folder", "tune_folder", "driver_log"])
def test_the_other_parts_of_a_sweep_are_no_links(sweep: Path, precious: Path, attribute: str) -> None:
    store = SweepStore(sweep)
    getattr(store, attribute).symlink_to(precious, target_is_directory=True)
    with pytest.raises(CheckpointError, match="symbolic link"):
        getattr(store, attribute)


def test_a_pack_reads_and_writes_through_no_link(sweep: Path, precious: Path) -> None:
    (sweep / "packs").symlink_to(precious, target_is_directory=True)
    files = PackFiles(sweep, "p00")
    with pytest.raises(CheckpointError, match="symbolic link"):
        files.write(Assignment(("t0000",)))
    with pytest.raises(CheckpointError, match="symbolic link"):
        files.read()
