"""A path that a user names, below a folder that may not be entered: said in our words, whichever Python it is."""

import errno
from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest
from broken_storage import Fail, fail, pathlib_of  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

import tune_jobs
from policies.acting.load import load_policy
from policies.errors import CannotRunError, CheckpointError, NotFoundError, SpecError, TuneJobsError
from tune_jobs.cli.remote import _target
from tune_jobs.client.connection import Connection
from tune_jobs.client.downloads import download
from tune_jobs.client.sources import request_of
from tune_jobs.spec.file import load_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.conclude import find_policy
from tune_jobs.sweeps.policies import _film_path
from tune_jobs.sweeps.storage import choose_store

READ: dict[str, tuple[type[TuneJobsError], Callable[[Path], object]]] = {
    "a sweep file": (SpecError, lambda closed: load_spec(closed / "mine.yaml")),
    "a sweep file for a service": (SpecError, lambda closed: request_of(closed / "mine.yaml", (), None)),
    "a storage": (CheckpointError, lambda closed: choose_store(None, "mine", closed / "sweeps")),
    "a storage for a name": (CheckpointError, lambda closed: choose_store("mine", "mine", closed / "sweeps")),
    "a policy": (NotFoundError, lambda closed: load_policy(closed / "policy.json")),
    "a policy's folder": (NotFoundError, lambda closed: load_policy(closed / "best")),
    "a policy or a sweep": (NotFoundError, lambda closed: tune_jobs.load_policy(closed / "policy.json")),
    "a policy of any kind": (CheckpointError, lambda closed: find_policy(closed / "policy.json")),
}


@pytest.mark.usefixtures("pathlib_of")
@pytest.mark.parametrize("what", READ)
def test_what_may_not_be_looked_at_cannot_be_read(what: str, tmp_path: Path, fail: Fail) -> None:  # noqa: F811
    kind, read = READ[what]
    closed = tmp_path / "closed"
    with fail(closed, errno.EACCES, below=True), pytest.raises(kind, match=f"{closed}.* cannot be read: Permission"):
        read(closed)


WRITTEN: dict[str, Callable[[Path], object]] = {
    "a new sweep": lambda closed: SweepStore(closed / "sweeps" / "mine").create(),
    "a table": lambda closed: tune_jobs.export("mine", "latex", output=closed / "mine", storage=closed.parent),
    "tables": lambda closed: tune_jobs.export("mine", "csv", output=closed / "mine", storage=closed.parent),
    "a study": lambda closed: tune_jobs.export("mine", "optuna", output=closed / "mine", storage=closed.parent),
    "a film": lambda closed: _film_path(closed / "film", "mine.mp4"),
    "a film of a service": lambda closed: _target(str(closed / "film"), "mine.mp4"),
    "a download": lambda closed: download(cast("Connection", None), "film.mp4", closed / "film.mp4"),
}


@pytest.mark.usefixtures("pathlib_of")
@pytest.mark.parametrize("what", WRITTEN)
def test_what_may_not_be_looked_at_cannot_be_written(what: str, tmp_path: Path, fail: Fail) -> None:  # noqa: F811
    if what == "a study":
        pytest.importorskip("optuna")
    make_sweep_folder(tmp_path / "mine", seeds_per_point=1, num_samples=1)
    closed = tmp_path / "closed"
    closed.mkdir()
    refused = fail(closed, errno.EACCES, below=True, calls=("stat", "lstat", "open", "mkdir"))
    with refused, pytest.raises(CannotRunError, match=f"{closed}.*: Permission denied"):
        WRITTEN[what](closed)
    assert not list(closed.iterdir())
