"""What killed processes leave half made goes; what somebody still writes stays."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from analysis.records import SweepRecord, TrialRecord
from policies.files import atomic_path, is_abandoned, write_atomic
from tune_jobs.store.sweep_store import SweepStore

# Begins a file of each folder, and is killed in the middle.
KILLED = """
import os, signal, sys
from contextlib import ExitStack
from pathlib import Path
from policies.files import atomic_path
with ExitStack() as stack:
    for path in sys.argv[1:]:
        stack.enter_context(atomic_path(Path(path))).write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def kill_while_writing(*paths: Path) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, *map(str, paths)], check=False)
    assert done.returncode < 0


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    """A sweep with a finished trial and one that is not."""
    store = SweepStore(tmp_path / "mine")
    store.create()
    for index, status in enumerate(["completed", "paused"]):
        trial = TrialRecord(
            trial_id=f"t{index:04d}", index=index, point_index=index, seed=index, point={}, status=status
        )
        store.trial(trial.trial_id).write_record(trial)
    store.write_record(
        SweepRecord(
            name="mine",
            state="interrupted",
            spec={},
            evaluation_seeds=(),
            confirmation_seeds=(),
            num_trials=2,
            created_at=0.0,
        )
    )
    return store


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_what_killed_processes_left_is_removed(store: SweepStore) -> None:
    write_atomic(store.folder / "best" / "before.mp4", "film")
    before = files(store.folder)
    kill_while_writing(
        store.folder / "sweep.json", store.folder / "best" / "before.mp4", store.folder / "report" / "index.html",
        store.folder / "report" / "figures" / "a.png", store.folder / "trials" / "t0001" / "trial.json",
        store.folder / "packs" / "p00.json",
    )  # fmt: skip
    (store.folder / ".probe").mkdir()
    (store.folder / ".probe" / "question").write_text("who are you")
    half_a_checkpoint = store.folder / "trials" / "t0000" / "checkpoints" / ".000007.deleted"
    half_a_checkpoint.mkdir(parents=True)
    (half_a_checkpoint / "manifest.json").write_text("{}")
    assert len(files(store.folder) - before) == 8
    store.remove_leftovers()
    assert files(store.folder) == before
    assert not (store.folder / ".probe").exists()


def test_a_file_that_is_being_written_stays(store: SweepStore) -> None:
    with atomic_path(store.folder / "best" / "after.mp4") as half:
        half.write_text("half")
        store.remove_leftovers()
        assert half.read_text() == "half"
    assert (store.folder / "best" / "after.mp4").read_text() == "half"


def test_nothing_else_is_taken_for_a_leftover(store: SweepStore) -> None:
    names = [".lock", ".stop", ".owner", ".mine.json", ".before.12-abc.mp4", "before.12-0123abcd.mp4"]
    for name in names:
        (store.folder / name).write_text("kept")
    (store.folder / "best").mkdir(exist_ok=True)
    elsewhere = store.folder.parent / "elsewhere"
    elsewhere.write_text("kept")
    kill_while_writing(store.folder / "sweep.json")
    (left,) = store.folder.glob(".sweep.*")
    link = store.folder / "best" / left.name
    link.symlink_to(elsewhere)
    store.remove_leftovers()
    assert not left.exists()
    assert {name for name in names if (store.folder / name).exists()} == set(names)
    assert link.is_symlink()
    assert elsewhere.read_text() == "kept"


def test_what_another_machine_writes_is_nobodys_after_a_day(tmp_path: Path) -> None:
    for name in (f".after.00000000-{os.getpid()}-0123abcd.mp4", ".after.7-0123abcd.mp4"):
        path = tmp_path / name
        path.write_text("half")
        assert not is_abandoned(path)
        day_ago = time.time() - 25 * 3600
        os.utime(path, (day_ago, day_ago))
        assert is_abandoned(path)


def test_a_process_that_ended_but_was_not_asked_how_is_gone(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path / "a.json")]) as process:
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        (left,) = tmp_path.glob(".a.*")
        assert Path(f"/proc/{process.pid}").exists()
        assert is_abandoned(left)
