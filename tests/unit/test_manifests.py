"""A manifest covers every file of its checkpoint, and itself."""

import errno
import functools
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from trial_runs import Trial

from policies.errors import CheckpointError, NotFoundError
from policies.files import sha256_file
from tune_jobs.store import manifests
from tune_jobs.store.manifests import read_manifest, verify_checkpoint
from tune_jobs.store.record_files import seal

SAMPLE = Path(__file__).parent / "samples" / "sweep_format_1" / "trials" / "t0001" / "checkpoints" / "000002"


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    trial = Trial(tmp_path / "mine", stop={"num_iterations": 2})
    trial.run()
    folder = trial.store.checkpoint_folder(2)
    # Both are made of the same files.
    assert sorted(path.name for path in SAMPLE.iterdir() if path.is_file()) == sorted(
        path.name for path in folder.iterdir() if path.is_file()
    )
    return folder


@pytest.fixture
def old_checkpoint(tmp_path: Path) -> Path:
    """Of format 1, which had no seals."""
    return shutil.copytree(SAMPLE, tmp_path / "old")


def edit(checkpoint: Path, change: Callable[[dict[str, Any]], object], *, sealed: bool = True) -> None:
    path = checkpoint / "manifest.json"
    data = json.loads(path.read_text())
    change(data)
    if sealed and data["format_version"] > 1:
        data["sha256"] = seal(data)
    path.write_text(json.dumps(data))


ENTRY = {"bytes": 0, "sha256": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"}


def with_entry(name: str, data: dict[str, Any]) -> None:
    data["files"].update({name: ENTRY})


BAD_FILES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "none": (lambda data: data.pop("files"), "files is missing"),
    "null": (lambda data: data.update(files=None), "files is missing"),
    "a list": (lambda data: data.update(files=[]), r"files is \[\]"),
    "empty": (lambda data: data.update(files={}), "policy.json"),
    "no policy": (lambda data: data["files"].pop("policy.json"), "policy.json"),
    "no weights": (lambda data: data["files"].pop("policy.safetensors"), "policy.safetensors"),
    "no engine": (lambda data: data["files"].pop("engine.json"), "engine.json|no state from which training"),
    "one too many": (lambda data: data["files"].update(more=ENTRY), "lacks the file more"),
    "no hash": (lambda data: data["files"]["policy.json"].pop("sha256"), "files.policy.json"),
    "a number as hash": (lambda data: data["files"]["policy.json"].update(sha256=1), "files.policy.json"),
    "a word as size": (lambda data: data["files"]["policy.json"].update(bytes="1"), "files.policy.json"),
    "a truth as size": (lambda data: data["files"]["policy.json"].update(bytes=True), "files.policy.json"),
    "an entry of another type": (lambda data: data["files"].update({"policy.json": 7}), "files.policy.json is 7"),
    **{
        f"the name {name!r}": (functools.partial(with_entry, name), "not a file in the folder")
        for name in ("../x", "/etc/passwd", "a/../../x", "", ".", "./policy.json", "a//b", "nul\0", "a/")
    },
}


@pytest.mark.parametrize("case", BAD_FILES)
@pytest.mark.parametrize("kind", ["checkpoint", "old_checkpoint"])
def test_a_manifest_that_does_not_cover_the_folder_is_refused(
    request: pytest.FixtureRequest, kind: str, case: str
) -> None:
    folder, (change, words) = request.getfixturevalue(kind), BAD_FILES[case]
    verify_checkpoint(folder)
    edit(folder, change)
    with pytest.raises(CheckpointError, match=words) as raised:
        verify_checkpoint(folder)
    assert str(folder) in raised.value.message


@pytest.mark.parametrize("name", ["more.pkl", "rllib/algorithm_state.pkl", ".hidden"])
@pytest.mark.parametrize("kind", ["checkpoint", "old_checkpoint"])
def test_a_file_that_the_manifest_does_not_name_is_refused(
    request: pytest.FixtureRequest, kind: str, name: str
) -> None:
    folder = request.getfixturevalue(kind)
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text("something that would be unpickled")
    with pytest.raises(CheckpointError, match=f"holds the file {name}"):
        verify_checkpoint(folder)


OF_SYSTEMS = (
    ".DS_Store", "Thumbs.db", "desktop.ini", "._policy.json", "._manifest.json", "._rllib", "rllib/.DS_Store",
    ".nfs0000000000a1b2c300000001",
)  # fmt: skip
NOT_OF_SYSTEMS = (
    ".DS_Store2", "x.DS_Store", ".DS_Store/state.pkl", "thumbs.db.pkl", ".nfs", ".nfsstate", "._", "rllib/._", "._.",
    "._..", "._gone.json", "rllib/._policy.json",
)  # fmt: skip


@pytest.mark.parametrize("name", OF_SYSTEMS)
@pytest.mark.parametrize("kind", ["checkpoint", "old_checkpoint"])
def test_what_a_system_leaves_in_a_folder_that_is_looked_at_or_copied_is_no_damage(
    request: pytest.FixtureRequest, tmp_path: Path, kind: str, name: str
) -> None:
    """A trial was begun again because its checkpoint had been opened in Finder."""
    folder = request.getfixturevalue(kind)
    (folder / "rllib").mkdir(exist_ok=True)
    (folder / name).write_bytes(b"\0\0\0\1Bud1")
    record = verify_checkpoint(folder)
    assert all(file.name != name.rpartition("/")[2] for file in manifests.files_of(folder).values())
    # It may be gone again by the next look.
    manifests.write_manifest(folder, record)
    (folder / name).unlink()
    assert verify_checkpoint(folder) == record


@pytest.mark.parametrize("name", NOT_OF_SYSTEMS)
def test_a_file_of_a_name_like_a_systems_is_refused(checkpoint: Path, name: str) -> None:
    (checkpoint / "rllib").mkdir(exist_ok=True)
    (checkpoint / name).parent.mkdir(exist_ok=True)
    (checkpoint / name).write_text("something that would be unpickled")
    with pytest.raises(CheckpointError, match=f"holds the file {re.escape(name)},"):
        verify_checkpoint(checkpoint)


@pytest.mark.parametrize("name", [".DS_Store", "._policy.json"])
def test_what_is_called_like_a_systems_file_and_is_none_is_refused(checkpoint: Path, name: str) -> None:
    os.mkfifo(checkpoint / name)
    with pytest.raises(CheckpointError, match="named pipe"):
        verify_checkpoint(checkpoint)
    (checkpoint / name).unlink()
    (checkpoint / name).symlink_to(checkpoint / "policy.json")
    with pytest.raises(CheckpointError, match="symbolic link"):
        verify_checkpoint(checkpoint)


def test_a_file_that_nfs_removes_meanwhile_is_no_damage(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = checkpoint / ".nfs0000000000a1b2c300000001"
    path.touch()
    is_folder = manifests.is_folder  # type: ignore[attr-defined]

    def asked(of: Path) -> bool:
        found: bool = is_folder(of)
        if of == path:
            path.unlink()
        return found

    monkeypatch.setattr(manifests, "is_folder", asked)
    verify_checkpoint(checkpoint)
    assert not path.exists()


@pytest.mark.parametrize("name", ["policy.json", "manifest.json", "rllib"])
def test_links_in_a_checkpoint_are_refused(checkpoint: Path, tmp_path: Path, name: str) -> None:
    if (checkpoint / name).exists():
        (checkpoint / name).rename(tmp_path / name)
    (checkpoint / name).symlink_to(tmp_path / name)
    with pytest.raises(CheckpointError, match="symbolic link"):
        verify_checkpoint(checkpoint)


@pytest.mark.parametrize("changes", [{"evaluation_return": 924.5}, {"num_env_steps": 1}, {"trial_id": "t0007"}])
def test_a_changed_manifest_is_refused(checkpoint: Path, changes: dict[str, Any]) -> None:
    """However small: 2.0 became 924.5, and won."""
    assert read_manifest(checkpoint).evaluation_return == 2.0
    edit(checkpoint, lambda data: data.update(changes), sealed=False)
    for read in (read_manifest, verify_checkpoint):
        with pytest.raises(CheckpointError, match=r"manifest\.json is not the checkpoint manifest that was written"):
            read(checkpoint)


def test_a_seal_that_is_gone_is_missed(checkpoint: Path) -> None:
    edit(checkpoint, lambda data: data.pop("sha256"), sealed=False)
    with pytest.raises(CheckpointError, match="that was written"):
        read_manifest(checkpoint)


def test_a_manifest_that_is_only_laid_out_otherwise_is_the_same(checkpoint: Path) -> None:
    path = checkpoint / "manifest.json"
    path.write_text(json.dumps(dict(reversed(json.loads(path.read_text()).items()))))
    assert verify_checkpoint(checkpoint).evaluation_return == 2.0


def test_a_manifest_of_format_1_is_read(old_checkpoint: Path) -> None:
    record = verify_checkpoint(old_checkpoint)
    assert (record.trial_id, record.iteration, record.num_env_steps, record.evaluation_return) == (
        "t0001",
        2,
        200,
        12.0,
    )


def test_a_checkpoint_that_is_removed_while_it_is_verified_is_not_there(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trial that runs keeps only its last ones, and others may read them."""

    def hashed_at_last(path: Path) -> str:
        digest = sha256_file(path)
        shutil.rmtree(checkpoint, ignore_errors=True)
        return digest

    monkeypatch.setattr(manifests, "sha256_file", hashed_at_last)
    with pytest.raises(NotFoundError, match=f"No checkpoint folder at {checkpoint}") as raised:
        verify_checkpoint(checkpoint)
    assert not isinstance(raised.value, CheckpointError)


def test_a_file_that_cannot_be_read_now_is_named_and_need_not_be_damaged(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(path: Path) -> str:
        raise OSError(errno.EIO, "Input/output error", str(path))

    monkeypatch.setattr(manifests, "sha256_file", unreadable)
    with pytest.raises(CheckpointError, match=r"cannot be read: Input/output error, .*engine.json") as raised:
        verify_checkpoint(checkpoint)
    # What tells it from a damaged one, which is set aside.
    assert isinstance(raised.value.__cause__, OSError)
