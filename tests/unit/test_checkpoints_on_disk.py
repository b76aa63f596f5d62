"""What a power cut or a kill may leave of a checkpoint in a folder: what its name promises is on disk."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from store_parts import fill, make_checkpoint

from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.trial_store import TrialStore


@pytest.fixture
def trial(tmp_path: Path) -> TrialStore:
    store = SweepStore(tmp_path / "mine")
    store.create()
    return store.trial("t0000")


def test_all_of_a_checkpoint_is_on_disk_before_its_name_is(trial: TrialStore, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: set[str] = set()
    before: list[set[str]] = []
    replace = Path.replace

    def syncing(descriptor: int) -> None:
        synced.add(str(Path(f"/proc/self/fd/{descriptor}").readlink()))

    def replacing(path: Path, target: Any) -> Any:
        before.append({str(Path(name).relative_to(path)) for name in synced if Path(name).is_relative_to(path)})
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", syncing)
    monkeypatch.setattr(Path, "replace", replacing)
    trial.write_checkpoint(make_checkpoint(1), fill)
    written = {str(path.relative_to(trial.checkpoint_folder(1))) for path in trial.checkpoint_folder(1).rglob("*")}
    # The names in its folders, too: those of the checkpoint itself are ".".
    assert before == [{*written, "."}]
    assert {"manifest.json", "state", "state/weights"} <= written


def test_of_a_deletion_that_is_killed_half_way_no_damaged_checkpoint_is_left(
    trial: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial.write_checkpoint(make_checkpoint(1), fill)
    trial.write_checkpoint(make_checkpoint(2), fill)

    class KilledError(BaseException):
        pass

    def half(path: Any, *_: Any, **__: Any) -> None:
        if Path(path).exists():
            (Path(path) / "manifest.json").unlink()
            raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", half)
        with pytest.raises(KilledError):
            trial.delete_checkpoint(make_checkpoint(1))
    assert trial.checkpoint_iterations() == [2]
    assert trial.checkpoints() == [make_checkpoint(2)]
    trial.remove_leftovers()
    assert [path.name for path in trial.checkpoints_folder.iterdir()] == ["000002"]
