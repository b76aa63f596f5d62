"""A sweep that can't be made as a whole leaves no name taken, and one behind a symbolic link is left as it is."""

import contextlib
import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from s3_faults import Faults, Opened
from store_parts import killed, make_sweep, make_trial
from stores import Harness

from policies.errors import CannotRunError, SpecError
from tune_jobs.store import names
from tune_jobs.store.contract import Sweep, Trial
from tune_jobs.store.half_made import free_half_made
from tune_jobs.store.local_storage import LocalStorage
from tune_jobs.store.objects import bucket
from tune_jobs.store.objects.bucket import StorageError
from tune_jobs.store.patience import impatient
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.create import CreatedSweep, removed_if_not_begun

# -- in a folder


@pytest.fixture
def full(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A disk that has room for a sweep's folder, and for none in it."""
    real = Path.mkdir

    def mkdir(path: Path, **options: bool) -> None:
        if path.name == names.TRIALS_FOLDER:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(path, **options)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    return monkeypatch


def test_a_disk_that_gets_full_leaves_the_name_free(tmp_path: Path, full: pytest.MonkeyPatch) -> None:
    store = SweepStore(tmp_path / "new" / "mine")
    with pytest.raises(CannotRunError, match="No space left"):
        store.create()
    assert list(tmp_path.iterdir()) == []
    full.undo()
    store.create()


def test_another_sweep_of_that_name_stays_where_the_disk_is_full(tmp_path: Path, full: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / names.SWEEP_RECORD).write_text("{}")
    with pytest.raises(SpecError, match="already in"):
        SweepStore(tmp_path / "mine").create()
    assert (tmp_path / "mine" / names.SWEEP_RECORD).is_file()


def test_what_to_do_about_a_folder_without_a_record_is_a_sentence(tmp_path: Path) -> None:
    store = SweepStore(tmp_path / "mine")
    store.create()
    with pytest.raises(SpecError) as raised:
        store.create()
    assert raised.value.hint == (
        "Choose another name with --name; or, if it isn't being written just now, remove that folder: it has no "
        "sweep.json."
    )
    store.write_record(make_sweep())
    with pytest.raises(SpecError, match="already in") as raised:
        store.create()
    assert raised.value.hint.startswith("Choose another name with --name, or continue it: `tune-jobs resume ")


def test_a_sweep_behind_a_link_is_not_deleted(tmp_path: Path) -> None:
    there = SweepStore(tmp_path / "large" / "mine")
    there.create()
    there.write_record(make_sweep())
    link = tmp_path / "mine"
    link.symlink_to(there.folder)
    before = sorted(there.folder.rglob("*"))
    with pytest.raises(CannotRunError) as raised:
        SweepStore(link).delete()
    assert raised.value.message == (
        f"{link} is a symbolic link to {there.folder}; a sweep is not removed through a link."
    )
    assert raised.value.hint == "Remove the link, or the folder that it points to."
    assert (link.is_symlink(), sorted(there.folder.rglob("*"))) == (True, before)
    # Links above it are nobody's business here.
    (tmp_path / "storage").symlink_to(tmp_path / "large")
    SweepStore(tmp_path / "storage" / "mine").delete()
    assert not there.folder.exists()


def test_a_removal_that_is_killed_half_way_leaves_the_name_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = SweepStore(tmp_path / "mine")

    def make() -> None:
        store.create()
        store.write_record(make_sweep())
        store.trial("t0000").write_record(make_trial())

    def killed_in_it(kill: Callable[..., None]) -> None:
        monkeypatch.setattr(shutil, "rmtree", lambda path, **_: kill() if Path(path).exists() else None)
        store.delete()

    make()
    killed(killed_in_it)
    assert [path.name for path in tmp_path.iterdir()] == [".mine.deleted"]
    assert LocalStorage(tmp_path).sweeps() == []
    make()
    store.delete()
    assert list(tmp_path.iterdir()) == []


def test_a_sweep_that_cannot_be_removed_as_what_is_left_of_another_is_in_the_way_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = SweepStore(tmp_path / "mine")
    store.create()
    store.write_record(make_sweep())
    left = tmp_path / ".mine.deleted"
    (left / "trials").mkdir(parents=True)
    # Somebody else's, which this user may not remove.
    monkeypatch.setattr(shutil, "rmtree", lambda *_, **__: None)
    with pytest.raises(CannotRunError, match="mine cannot be removed") as raised:
        store.delete()
    assert raised.value.hint == f"Remove what is left of it: {left}."
    assert store.read_record() == make_sweep()


# -- in a folder of NFS, which keeps what is removed for as long as it is open, under another name


@pytest.fixture
def on_nfs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have files that this process has open renamed where they are removed, as a client of NFS does."""
    real = os.unlink

    def unlink(path: str | Path, *, dir_fd: int | None = None) -> None:
        found = os.stat(path, dir_fd=dir_fd, follow_symlinks=False)
        for link in Path("/proc/self/fd").iterdir():
            with contextlib.suppress(OSError):
                if os.path.samestat(os.fstat(int(link.name)), found):
                    kept = Path(path).with_name(f".nfs{found.st_ino:016x}")
                    os.rename(path, kept, src_dir_fd=dir_fd, dst_dir_fd=dir_fd)
                    return
        real(path, dir_fd=dir_fd)

    monkeypatch.setattr(os, "unlink", unlink)


@pytest.mark.usefixtures("on_nfs")
def test_a_sweep_is_removed_though_its_lock_is_open_meanwhile(tmp_path: Path) -> None:
    store = SweepStore(tmp_path / "mine")
    store.create()
    store.write_record(make_sweep())
    store.delete()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("on_nfs")
def test_what_is_discarded_under_its_lock_leaves_the_name_free(tmp_path: Path) -> None:
    store, storage = SweepStore(tmp_path / "mine"), LocalStorage(tmp_path)
    store.create()
    with store.lock():
        pass
    free_half_made(storage, "mine")
    assert list(tmp_path.iterdir()) == []
    store.create()
    store.write_record(make_sweep(state="created"))
    with contextlib.suppress(RuntimeError), removed_if_not_begun(CreatedSweep("mine", store.place)):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


# -- in an object store


def test_a_store_that_fails_half_way_leaves_the_name_free(faults: Faults, opened: Opened) -> None:
    faults.rule("status", kinds="LIST", status=403, body="<Error><Code>AccessDenied</Code></Error>")
    with pytest.raises(StorageError, match="listed"):
        opened().create()
    assert opened()._bucket.listed() == []
    opened().create()


def test_a_claim_whose_answer_was_lost_leaves_the_name_free(faults: Faults, opened: Opened) -> None:
    faults.rule("after", kinds="PUT", keys="claim")
    faults.rule("status", kinds="PUT", keys="claim", status=403, body="<Error><Code>AccessDenied</Code></Error>")
    with pytest.raises(StorageError, match="claim cannot be written"):
        opened().create()
    assert opened()._bucket.listed() == []


def test_the_name_is_free_again_where_an_answer_is_wanted_now(
    faults: Faults, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The store is held for away then, and isn't asked by those who want an answer now."""
    monkeypatch.setattr(bucket, "ANSWER_S", 0.5)
    faults.rule("status", kinds="LIST", times=1_000)
    with impatient(), pytest.raises(StorageError, match="listed"):
        opened().create()
    faults.clear()
    assert opened()._bucket.listed() == []


def test_the_claim_of_another_process_stays(faults: Faults, opened: Opened) -> None:
    opened().create()
    faults.rule("status", kinds="PUT", keys="claim", status=403, body="<Error><Code>AccessDenied</Code></Error>")
    with pytest.raises(StorageError):
        opened().create()
    assert [item.key for item in opened()._bucket.listed()] == ["claim"]


# -- in each


def test_what_a_killed_process_has_written_of_a_sweep_is_removed(harness: Harness, sweep: Sweep, trial: Trial) -> None:
    with sweep.lock():
        trial.write_record(make_trial())
    free_half_made(harness.storage(), "mine")
    assert harness.keys("mine") == set()
    harness.storage().new_sweep("mine").create()


def test_of_a_name_that_is_free_nothing_is_made(harness: Harness) -> None:
    free_half_made(harness.storage(), "mine")
    assert not harness.storage().is_taken("mine")


def test_what_is_being_written_is_left_alone(harness: Harness, sweep: Sweep, trial: Trial) -> None:
    with sweep.lock():
        trial.write_record(make_trial())
        free_half_made(harness.storage(), "mine")
        sweep.write_record(make_sweep())
    assert [found.name for found in harness.storage().sweeps()] == ["mine"]
    assert harness.storage().sweep("mine").read_trials() == [make_trial()]


@pytest.mark.parametrize("key", ["sweep.json", "notes.txt", "best/policy.json"])
def test_what_is_more_than_a_new_sweep_is_left_alone(harness: Harness, sweep: Sweep, key: str) -> None:
    harness.put("mine", key, b"{}")
    before = harness.keys("mine")
    free_half_made(harness.storage(), "mine")
    assert harness.keys("mine") == before


def test_a_link_is_not_followed_where_a_name_is_freed(tmp_path: Path) -> None:
    """What it leads to is elsewhere, and may be somebody's sweep."""
    other = SweepStore(tmp_path / "elsewhere")
    other.create()
    other.record_path.write_text("{}")
    (tmp_path / "mine").symlink_to(other.folder)
    SweepStore(tmp_path / "mine").discard()
    assert (tmp_path / "mine").is_symlink()
    assert other.record_path.read_text() == "{}"
