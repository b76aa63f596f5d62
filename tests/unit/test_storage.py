"""Which folder a new sweep gets, also when several begin at once; which sweeps can be extended."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import pytest
from spec_errors import MINIMAL

from analysis.wording import shown_path
from policies.errors import CannotRunError, CheckpointError, SpecError
from policies.guard.guard import EnvGuard
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec
from tune_jobs.store.opening import open_storage
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.drive import write_new
from tune_jobs.sweeps.storage import choose_store, create_store, storage_place


def test_sweeps_that_begin_at_once_get_a_name_each(tmp_path: Path) -> None:
    number = 16
    barrier = threading.Barrier(number)

    def begin(_: int) -> str:
        barrier.wait()
        return create_store(None, "mine", tmp_path).name

    with ThreadPoolExecutor(number) as pool:
        names = set(pool.map(begin, range(number)))
    assert names == {"mine", *(f"mine-{index}" for index in range(2, number + 1))}


def test_an_automatic_name_that_is_taken_meanwhile_gives_way_to_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tune_jobs.sweeps import storage

    def choose(
        name: str | None, stem: str, folder: Path, real: Callable[..., Any] = storage.choose_store
    ) -> SweepStore:
        store = real(name, stem, folder)
        if store.name == "mine":
            # Another process makes it between the look and the making.
            store.folder.mkdir()
        return cast("SweepStore", store)

    monkeypatch.setattr(storage, "choose_store", choose)
    assert create_store(None, "mine", tmp_path).name == "mine-2"
    with pytest.raises(SpecError, match="already in"):
        create_store("mine", "x", tmp_path)


def test_what_a_killed_launch_left_is_not_to_be_resumed(tmp_path: Path) -> None:
    """It has no sweep.json yet."""
    create_store("mine", "x", tmp_path)
    with pytest.raises(SpecError, match=r"remove that folder: it has no sweep\.json") as caught:
        create_store("mine", "x", tmp_path)
    assert "resume" not in str(caught.value)


def test_storage_is_what_is_given_else_the_environments_else_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TUNE_JOBS_STORAGE", raising=False)
    assert storage_place(None) == str(tmp_path / "sweeps")
    monkeypatch.setenv("TUNE_JOBS_STORAGE", "theirs")
    assert storage_place(None) == str(tmp_path / "theirs")
    assert storage_place("mine") == str(tmp_path / "mine")


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"stop": 3}, "spec.stop: 3 is not allowed: give a mapping of its fields"),
        ({"env": None}, "spec.env: is missing"),
        ({"later": 1}, "spec.later: there is no field 'later' here"),
        ({"hyperparams": {"lr": "x"}}, "spec.hyperparams.lr: 'x'"),
    ],
)
def test_a_spec_that_was_changed_in_the_sweeps_record_is_told_in_its_words(
    tmp_path: Path, change: dict[str, int | dict[str, str] | None], part: str
) -> None:
    spec = load_spec(MINIMAL)
    store = create_store("mine", "x", tmp_path)
    write_new(store, spec, make_plan(spec, Machine(1)), None)
    record = store.read_record()
    store.write_record(record.model_copy(update={"spec": {**record.spec, **change}}))
    for call in (sweeps.resume, sweeps.best, sweeps.report):
        with pytest.raises(CheckpointError) as caught:
            call("mine", storage=tmp_path)
        assert "sweep.json of sweep mine" in caught.value.message
        assert part in caught.value.message


@pytest.mark.parametrize(
    ("space", "why"), [({}, "it has no space"), ({"lr": {"grid": [0.1, 0.2]}}, "its space has only grids")]
)
def test_a_sweep_of_the_same_points_again_is_not_extended(
    tmp_path: Path, space: dict[str, dict[str, list[float]]], why: str
) -> None:
    spec = load_spec({**MINIMAL, "space": space})
    store = create_store("mine", "x", tmp_path)
    write_new(store, spec, make_plan(spec, Machine(1)), None)
    store.write_record(store.read_record().model_copy(update={"state": "completed"}))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.json")}
    with pytest.raises(SpecError, match=f"cannot be extended: {why}.*\n.*seeds_per_point"):
        sweeps.extend("mine", 1, storage=tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.json")} == before


@pytest.mark.parametrize(
    "use",
    [
        lambda: storage_place(None),
        lambda: SweepStore(Path("mine")),
        sweeps.list_sweeps,
        lambda: sweeps.launch(MINIMAL, name="new", progress="none"),
        EnvGuard().start,
    ],
)
def test_a_working_directory_that_was_deleted_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Callable[..., Any]
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    monkeypatch.delenv("TUNE_JOBS_STORAGE", raising=False)
    (tmp_path / "gone").rmdir()
    with pytest.raises(CannotRunError, match="The folder that this process works in was deleted"):
        use()


def test_where_the_working_directory_was_deleted_whole_paths_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert sweeps.list_sweeps(tmp_path) == []
    assert shown_path(tmp_path / "index.html") == str(tmp_path / "index.html")


def test_a_link_to_what_is_not_there_takes_its_name(tmp_path: Path) -> None:
    """Such as one to a disk that is not mounted: no folder can be made there, however often it is tried."""
    storage = tmp_path / "sweeps"
    storage.mkdir()
    (storage / "cartpole").symlink_to("/mnt/big/cartpole")
    assert open_storage(storage).is_taken("cartpole")
    assert create_store(None, "cartpole", storage).name == "cartpole-2"
    choices: list[Callable[[], object]] = [
        lambda: create_store("cartpole", "x", storage),
        lambda: choose_store("cartpole", "x", storage),
    ]
    for choose in choices:
        with pytest.raises(SpecError, match="is a link, and what it leads to isn't there: /mnt/big/cartpole") as caught:
            choose()
        assert "--name" in caught.value.hint
    # One that leads to itself is nothing either, and one to a folder is that folder.
    (storage / "loop").symlink_to(storage / "loop")
    (storage / "there").symlink_to(tmp_path)
    assert [create_store(None, name, storage).name for name in ("loop", "there")] == ["loop-2", "there-2"]
    with pytest.raises(SpecError, match="A sweep 'there' is already in"):
        choose_store("there", "x", storage)


def test_after_a_file_that_is_called_as_a_baseline_a_sweep_has_a_longer_name(tmp_path: Path) -> None:
    assert choose_store(None, "constant", tmp_path).name == "constant-sweep"
    assert [create_store(None, "random", tmp_path).name for _ in range(2)] == ["random-sweep", "random-sweep-2"]
    for choose in (choose_store, create_store):
        with pytest.raises(SpecError, match="The sweep name 'random' is not allowed"):
            choose("random", "x", tmp_path)
