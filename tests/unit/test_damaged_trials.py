"""What of a trial cannot be read is set aside, and the trial goes on from what is whole."""

import errno
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_engine import FakeClock, FakeEngine
from trial_runs import Trial

from analysis.records import FORMAT_VERSION
from policies.errors import CheckpointError
from tests.narrowing import present
from tune_jobs.store import record_files
from tune_jobs.store.record_files import seal
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.protocol import TrialTask


def flip_a_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "one bit": flip_a_bit,
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "gone": lambda path: path.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", ["engine.json", "policy.safetensors", "manifest.json"])
def test_a_damaged_latest_checkpoint_is_set_aside_and_the_one_before_is_taken(
    tmp_path: Path, name: str, damage: str
) -> None:
    Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 3}).run_to(6)
    store = TrialStore(tmp_path, "t0000")
    bad = store.checkpoint_folder(6)
    DAMAGES[damage](bad / name)
    files = {path.name: path.read_bytes() for path in bad.iterdir() if path.is_file()}

    again = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 3}, stop={"num_iterations": 8})
    assert again.engine.builds == ["000005"]
    assert again.loop.iteration == 5
    assert [record.iteration for record in again.results] == [1, 2, 3, 4, 5]
    # Kept, under a name that is no checkpoint's, and said.
    aside = store.folder / "damaged" / "000006"
    assert {path.name: path.read_bytes() for path in aside.iterdir() if path.is_file()} == files
    log = store.log_path.read_text()
    assert "checkpoint 000006 is damaged and kept as damaged/000006; the trial goes on from checkpoint 000005" in log
    progress = again.run()
    assert (progress.status, progress.num_iterations) == ("completed", 8)
    assert progress.notes[0] in log
    assert [record.iteration for record in again.results] == list(range(1, 9))
    assert again.kept[-1] == 8


def test_a_trial_all_of_whose_checkpoints_are_damaged_begins_again_and_says_so(tmp_path: Path) -> None:
    Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 3}).run_to(4)
    store = TrialStore(tmp_path, "t0000")
    for iteration in store.checkpoint_iterations():
        (store.checkpoint_folder(iteration) / "engine.json").write_text("{}")
    again = Trial(tmp_path)
    assert again.engine.builds == [None]
    assert (again.results, again.loop.iteration) == ([], 0)
    notes = again.run_to(1).notes
    assert len(notes) >= 2
    assert all("the trial goes on from its start" in note for note in notes)


@pytest.mark.parametrize("name", [".DS_Store", "Thumbs.db", "._engine.json"])
def test_a_checkpoint_that_somebody_has_looked_into_is_gone_on_from(tmp_path: Path, name: str) -> None:
    Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 1}).run_to(4)
    (TrialStore(tmp_path, "t0000").checkpoint_folder(4) / name).write_bytes(b"\0\0\0\1Bud1")
    again = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 1})
    assert again.engine.builds == ["000004"]
    assert [record.iteration for record in again.results] == [1, 2, 3, 4]
    assert again.run_to(6).notes == ()
    assert again.kept[-1] == 6


def test_a_checkpoint_set_aside_twice_is_kept_twice(tmp_path: Path) -> None:
    for _ in range(2):
        trial = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 3})
        trial.run_to(4)
        (trial.store.checkpoint_folder(4) / "engine.json").write_text("{}")
    Trial(tmp_path)
    assert sorted(path.name for path in (trial.store.folder / "damaged").iterdir()) == ["000004", "000004-2"]
    assert trial.store.latest_damaged() == 4


def test_a_whole_checkpoint_that_does_not_restore_is_an_error_and_no_older_one_is_taken(tmp_path: Path) -> None:
    Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 3}).run_to(4)

    class OfOtherValues(FakeEngine):
        def build(self, task: TrialTask, checkpoint: Path | None) -> None:
            raise CheckpointError(f"{present(checkpoint).name} is of other hyperparameters.")

    with pytest.raises(CheckpointError, match="000004 is of other hyperparameters"):
        Trial(tmp_path, engine=OfOtherValues())
    store = TrialStore(tmp_path, "t0000")
    assert not (store.folder / "damaged").exists()
    assert [record.iteration for record in store.read_iterations()] == [1, 2, 3, 4]


# -- results that can't be read


@pytest.mark.parametrize("junk", [b'{"iterat{"iteration": 3}', b"\x00\xff\x80", b'{"score": 1}', b"7"])
@pytest.mark.parametrize("place", [1, 3, 4, 6])
def test_a_line_that_cannot_be_read_is_set_aside_and_the_trial_goes_on(tmp_path: Path, place: int, junk: bytes) -> None:
    """Before the checkpoint, at it, after it, at the end: the rest of the curve stays."""
    first = Trial(tmp_path, scores=lambda i: -float(i), checkpoints={"every_iterations": 4, "keep": 1})
    first.run_to(6)
    lines = first.store.results_path.read_bytes().splitlines()
    lines[place - 1] = junk
    first.store.results_path.write_bytes(b"\n".join(lines) + b"\n")

    again = Trial(
        tmp_path, scores=lambda i: -float(i), checkpoints={"every_iterations": 4, "keep": 1}, stop={"num_iterations": 9}
    )
    assert again.engine.builds == ["000004"]
    assert (again.loop.iteration, again.engine.iteration) == (4, 4)
    assert (again.store.folder / "results.damaged").read_bytes() == junk + b"\n"
    progress = again.run()
    assert (progress.status, progress.num_iterations, progress.num_env_steps) == ("completed", 9, 900)
    # What the checkpoint had learned from is not done again, so of a line before it only the hole is left.
    expected = [number for number in range(1, 10) if number != place or place > 4]
    assert [record.iteration for record in again.results] == expected
    assert [record.num_env_steps for record in again.results] == [100 * number for number in expected]
    assert f"results.jsonl: line {place}" in progress.notes[0]
    assert progress.notes[0] in again.store.log_path.read_text()


@pytest.mark.parametrize("steps", [399, 10**12])
def test_a_trial_goes_on_from_the_env_steps_of_its_checkpoint_whatever_the_line_of_it_says(
    tmp_path: Path, steps: int
) -> None:
    """Else it would be over at once."""
    first = Trial(tmp_path, checkpoints={"every_iterations": 4, "keep": 1})
    first.run_to(4)
    *before, last = first.results
    first.store.keep_iterations([*before, last.model_copy(update={"num_env_steps": steps})])
    again = Trial(tmp_path, stop={"num_iterations": 6})
    progress = again.run()
    assert (progress.status, progress.num_iterations, progress.num_env_steps) == ("completed", 6, 600)
    assert f"iteration 4 says {steps} env steps; its checkpoint says 400" in progress.notes[0]
    assert [record.iteration for record in again.results if record.iteration != 4] == [1, 2, 3, 5, 6]


@pytest.mark.parametrize("time_s", [math.nan, math.inf, -1e9])
def test_a_time_that_is_none_neither_ends_a_trial_nor_keeps_it_from_ending(tmp_path: Path, time_s: float) -> None:
    first = Trial(tmp_path, clock=FakeClock(1.0), checkpoints={"every_iterations": 4, "keep": 1})
    first.run_to(4)
    *before, last = first.results
    first.store.keep_iterations([*before, last.model_copy(update={"time_s": time_s})])
    again = Trial(tmp_path, clock=FakeClock(1.0), stop={"num_iterations": 6})
    progress = again.run()
    assert (progress.status, progress.num_iterations) == ("completed", 6)
    assert before[-1].time_s < progress.time_s < 1_000


def test_results_that_are_gone_leave_a_hole_and_no_other_count(tmp_path: Path) -> None:
    first = Trial(tmp_path, checkpoints={"every_iterations": 4, "keep": 1})
    first.run_to(4)
    first.store.results_path.unlink()
    again = Trial(tmp_path, stop={"num_iterations": 6})
    assert (again.loop.iteration, again.engine.iteration) == (4, 4)
    again.run()
    assert [(record.iteration, record.num_env_steps) for record in again.results] == [(5, 500), (6, 600)]


def fill(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**31)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, fill])
def test_results_that_are_no_file_are_set_aside_and_the_trial_goes_on(
    tmp_path: Path, make: Callable[[Path], Any]
) -> None:
    first = Trial(tmp_path, checkpoints={"every_iterations": 4, "keep": 1})
    first.run_to(4)
    path = first.store.results_path
    path.unlink()
    make(path)
    again = Trial(tmp_path, stop={"num_iterations": 6})
    progress = again.run()
    assert (progress.status, [record.iteration for record in again.results]) == ("completed", [5, 6])
    assert f"{path} cannot be read: it " in progress.notes[0]
    assert "It is kept as damaged/results.jsonl" in progress.notes[0]
    assert (path.parent / "damaged" / "results.jsonl").exists()


def rewritten(folder: Path, **changes: int) -> None:
    """A manifest that says something else, with its seal."""
    manifest = json.loads((folder / "manifest.json").read_text()) | changes
    (folder / "manifest.json").write_text(json.dumps(manifest | {"sha256": seal(manifest)}))


def test_a_checkpoint_of_a_newer_version_is_not_damaged(tmp_path: Path) -> None:
    Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 3}).run_to(4)
    store = TrialStore(tmp_path, "t0000")
    rewritten(store.checkpoint_folder(4), format_version=FORMAT_VERSION + 1)
    with pytest.raises(CheckpointError, match="Upgrade tune-jobs"):
        Trial(tmp_path)
    assert store.checkpoint_iterations()[-1] == 4
    # A bit of its version that flipped is damage.
    manifest = store.checkpoint_folder(4) / "manifest.json"
    manifest.write_text(manifest.read_text().replace(f": {FORMAT_VERSION + 1}", f": {FORMAT_VERSION + 2}"))
    assert Trial(tmp_path).engine.builds == ["000003"]


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, fill])
def test_a_checkpoint_whose_manifest_is_no_file_is_damaged(tmp_path: Path, make: Callable[[Path], Any]) -> None:
    Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 3}).run_to(4)
    manifest = TrialStore(tmp_path, "t0000").checkpoint_folder(4) / "manifest.json"
    manifest.unlink()
    make(manifest)
    assert Trial(tmp_path).engine.builds == ["000003"]


def test_a_checkpoint_that_cannot_be_read_now_is_not_set_aside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk or a network that fails for a moment is no damage: the retry may find it whole."""
    Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 3}).run_to(4)
    store, read = TrialStore(tmp_path, "t0000"), record_files.read_regular  # type: ignore[attr-defined]

    def fails(path: Path) -> bytes:
        if path == store.checkpoint_folder(4) / "manifest.json":
            raise OSError(errno.EIO, "Input/output error")
        return read(path)

    with monkeypatch.context() as patch:
        patch.setattr(record_files, "read_regular", fails)
        with pytest.raises(CheckpointError, match="Input/output error"):
            Trial(tmp_path)
    assert Trial(tmp_path).engine.builds == ["000004"]
