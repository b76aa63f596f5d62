"""A sweep that can't be made as a whole leaves no name taken, and one behind a symbolic link is left as it is."""

import errno
import os
from pathlib import Path

import pytest
from s3_faults import Faults, Opened
from store_parts import make_sweep

from policies.errors import CannotRunError, SpecError
from tune_jobs.store import names
from tune_jobs.store.objects import bucket
from tune_jobs.store.objects.bucket import StorageError
from tune_jobs.store.patience import impatient
from tune_jobs.store.sweep_store import SweepStore

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
