"""What a power cut or a kill may leave of a checkpoint in a folder: what its name promises is on disk."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from fake_engine import FakeEngine
from store_parts import fill, make_checkpoint, make_iteration
from trial_runs import Trial

from policies.errors import CannotRunError
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


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """What is synced, in order, with the bytes it has."""
    found: list[tuple[str, int]] = []

    def syncing(descriptor: int) -> None:
        name = Path(f"/proc/self/fd/{descriptor}").readlink().name
        found.append((name, os.fstat(descriptor).st_size))

    monkeypatch.setattr(os, "fsync", syncing)
    return found


def test_a_checkpoints_results_are_on_disk_before_its_name_is_and_its_name_when_it_is_written(
    trial: TrialStore, synced: list[tuple[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    trial.append_iterations([make_iteration(1)])
    replace = Path.replace

    def replacing(path: Path, target: Any) -> Any:
        synced.append((f"to {Path(target).name}", 0))
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", replacing)
    trial.write_checkpoint(make_checkpoint(1), fill)
    names = [name for name, _ in synced]
    assert names.index("results.jsonl") < names.index("to 000001")
    assert names[-2:] == ["to 000001", "checkpoints"]


def test_the_results_are_on_disk_before_anybody_hears_that_a_trial_has_ended(
    tmp_path: Path, synced: list[tuple[str, int]]
) -> None:
    """Those of a trial that failed have no checkpoint."""
    trial = Trial(tmp_path, engine=FakeEngine(nan_from=3))
    assert trial.run().status == "failed"
    size = trial.store.results_path.stat().st_size
    assert [number for name, number in synced if name == "results.jsonl"][-1] == size
    assert len(trial.results) == 3


def test_a_disk_that_tells_late_that_it_is_full_is_told_with_the_file(
    trial: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial.append_iterations([make_iteration(1)])

    def full(_: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CannotRunError, match=r"results\.jsonl cannot be written: Disk quota exceeded") as raised:
        trial.settle()
    assert raised.value.hint == "Free space on its disk."


def test_a_trial_without_results_has_none_to_sync(trial: TrialStore, synced: list[tuple[str, int]]) -> None:
    trial.settle()
    trial.write_checkpoint(make_checkpoint(1), fill)
    assert "results.jsonl" not in [name for name, _ in synced]


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
