"""Who may drive a sweep, and who gets its name."""

import subprocess
import sys

import pytest

from policies.errors import CannotRunError, SpecError
from tune_jobs.locks import held
from tune_jobs.store import SweepStore


@pytest.fixture
def store(tmp_path):
    store = SweepStore(tmp_path / "sweeps" / "mine")
    store.create()
    return store


def test_a_sweep_has_one_driver(store):
    with store.lock():
        assert store.is_driven()
        with pytest.raises(CannotRunError, match="is being run by another process"), SweepStore(store.folder).lock():
            pass
    assert not store.is_driven()
    with store.lock():
        pass


def test_a_driver_that_outlived_its_client_keeps_others_away(store):
    """A client that was killed has lost the sweep's lock; its driver on the cluster runs a little longer."""
    with store.driver_lock():
        assert not (store.folder / ".lock").exists()
        with pytest.raises(CannotRunError, match="still being run on a cluster"), store.lock():
            pass
        assert store.is_driven()
    # The client holds one, its driver the other.
    with store.lock(), store.driver_lock():
        pass


def test_a_killed_process_frees_its_lock(tmp_path):
    script = (
        "import sys, time\nfrom pathlib import Path\nfrom tune_jobs.locks import held\n"
        "with held(Path(sys.argv[1]), 'taken', ''):\n    print('held', flush=True)\n    time.sleep(600)\n"
    )
    path = tmp_path / "lock"
    with subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(CannotRunError, match="taken"), held(path, "taken", ""):
            pass
        process.kill()
        process.wait()
        with held(path, "taken", ""):
            pass


def test_a_folder_that_is_gone_cannot_be_locked(tmp_path):
    with pytest.raises(CannotRunError, match="cannot be written"), held(tmp_path / "gone" / "lock", "taken", ""):
        pass


def test_a_name_is_given_once(store):
    (store.folder / "sweep.json").write_text("{}")
    with pytest.raises(SpecError, match="A sweep 'mine' is already in"):
        SweepStore(store.folder).create()
    assert (store.folder / "sweep.json").read_text() == "{}"


def test_a_discarded_sweep_leaves_only_what_was_there_before(tmp_path):
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


def test_a_storage_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotRunError, match="cannot be written"):
        SweepStore(tmp_path / "file" / "mine").create()
    assert (tmp_path / "file").read_text() == ""
