"""Who may drive a sweep, and who gets its name."""

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from policies.errors import CannotRunError, SpecError
from tests.narrowing import present
from tune_jobs.store import locks
from tune_jobs.store.locks import held, is_held
from tune_jobs.store.sweep_store import SweepStore


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    store = SweepStore(tmp_path / "sweeps" / "mine")
    store.create()
    return store


def test_a_sweep_has_one_driver(store: SweepStore) -> None:
    with store.lock():
        assert store.is_driven()
        with pytest.raises(CannotRunError, match="is being run by another process"), SweepStore(store.folder).lock():
            pass
    assert not store.is_driven()
    with store.lock():
        pass


def test_a_driver_that_outlived_its_client_keeps_others_away(store: SweepStore) -> None:
    """A client that was killed has lost the sweep's lock; its driver on the cluster runs a little longer."""
    with store.driver_lock():
        assert not (store.folder / ".lock").exists()
        with pytest.raises(CannotRunError, match="A cluster still runs sweep"), store.lock():
            pass
        assert store.is_driven()
    # The client holds one, its driver the other.
    with store.lock(), store.driver_lock():
        pass


def test_a_killed_process_frees_its_lock(tmp_path: Path) -> None:
    script = (
        "import sys, time\nfrom pathlib import Path\nfrom tune_jobs.store.locks import held\n"
        "with held(Path(sys.argv[1]), 'taken', ''):\n    print('held', flush=True)\n    time.sleep(600)\n"
    )
    path = tmp_path / "lock"
    with subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True) as process:
        assert present(process.stdout).readline() == "held\n"
        with pytest.raises(CannotRunError, match="taken"), held(path, "taken", ""):
            pass
        process.kill()
        process.wait()
        with held(path, "taken", ""):
            pass


def test_a_folder_that_is_gone_cannot_be_locked(tmp_path: Path) -> None:
    with pytest.raises(CannotRunError, match="cannot be written"), held(tmp_path / "gone" / "lock", "taken", ""):
        pass


def test_a_name_is_given_once(store: SweepStore) -> None:
    (store.folder / "sweep.json").write_text("{}")
    with pytest.raises(SpecError, match="A sweep 'mine' is already in"):
        SweepStore(store.folder).create()
    assert (store.folder / "sweep.json").read_text() == "{}"


def test_a_discarded_sweep_leaves_only_what_was_there_before(tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    store = SweepStore(tmp_path / "here" / "new" / "newer" / "mine")
    store.create()
    store.trial("t0000").folder.mkdir()
    store.discard()
    assert list(tmp_path.iterdir()) == [tmp_path / "here"]
    assert list((tmp_path / "here").iterdir()) == []
    other, mine = SweepStore(tmp_path / "here" / "other"), SweepStore(tmp_path / "here" / "mine")
    other.create()
    mine.create()
    mine.discard()
    assert list((tmp_path / "here").iterdir()) == [other.folder]


def test_a_storage_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotRunError, match="cannot be written"):
        SweepStore(tmp_path / "file" / "mine").create()
    assert (tmp_path / "file").read_text() == ""


ASKER = """
import sys
from pathlib import Path
from tune_jobs.store.sweep_store import SweepStore
store = SweepStore(Path(sys.argv[1]))
print("asking", flush=True)
while not (store.folder / "enough").exists():
    store.is_driven()
print("asked", flush=True)
"""


def test_asking_whether_a_sweep_is_driven_keeps_no_driver_from_it(store: SweepStore) -> None:
    """As `status` in a loop beside `resume` after `resume`."""
    with store.lock():
        pass
    arguments = [sys.executable, "-c", ASKER, str(store.folder)]
    askers = [subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    try:
        assert [present(asker.stdout).readline() for asker in askers] == ["asking\n"] * 3
        for _ in range(400):
            with store.lock(), store.driver_lock():
                assert store.is_driven()
        (store.folder / "enough").touch()
        assert [asker.communicate()[0] for asker in askers] == ["asked\n"] * 3
    finally:
        for asker in askers:
            asker.kill()
            asker.wait()


def test_who_wants_a_lock_waits_for_those_who_only_ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "lock"
    path.touch()
    with path.open() as asker:
        fcntl.flock(asker, fcntl.LOCK_SH)
        assert not is_held(path)  # others may ask at the same time
        monkeypatch.setattr(locks.time, "sleep", lambda _: fcntl.flock(asker, fcntl.LOCK_UN))  # type: ignore[attr-defined]
        with held(path, "taken", ""):
            assert is_held(path)


def test_one_may_ask_about_a_sweep_that_one_cannot_write(store: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    with store.lock():
        pass
    real = os.open

    def reading_alone(path: Path, flags: int, *mode: int) -> int:
        """As for another user; root may write what no one may."""
        if flags & os.O_ACCMODE != os.O_RDONLY:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path, flags, *mode)

    monkeypatch.setattr(locks.os, "open", reading_alone)  # type: ignore[attr-defined]
    assert not store.is_driven()
    with pytest.raises(CannotRunError, match="cannot be written: Permission denied"), store.lock():
        pass


@pytest.mark.parametrize("name", [".lock", ".driver-lock"])
def test_a_lock_is_no_link(store: SweepStore, tmp_path: Path, name: str) -> None:
    (store.folder / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(CannotRunError, match="symbolic link"), store.lock(), store.driver_lock():
        pass
    with pytest.raises(CannotRunError, match="symbolic link"):
        store.is_driven()
    assert not (tmp_path / "elsewhere").exists()
