"""Whatever a sweep's files say, and whichever of its parts are links: nothing outside its folder is touched or read."""

import contextlib
import itertools
import os
import shutil
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import odd_files
import pytest
from store_parts import make_iteration
from sweep_folders import train

from analysis import best_records, records
from analysis.selection import policy_candidates
from policies.acting.load import load_policy
from policies.envs import modules as env_modules
from policies.errors import TuneJobsError
from tune_jobs.store.candidates import read_results, read_trials
from tune_jobs.store.event_files import ScalarWriter
from tune_jobs.store.locks import held
from tune_jobs.store.ownership import Owner
from tune_jobs.store.pack_files import Assignment, PackFiles
from tune_jobs.store.places import refuse_links_in, remove_folder
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude as finish
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.policy_choice import confirmed_best, read_candidates


class Watch:
    """What Python opens, lists, makes, moves and deletes in one folder, whoever asks for it in this process."""

    folder: Path | None = None

    def __init__(self) -> None:
        self.seen: list[Any] = []

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.folder is None or not event.startswith(("open", "os.", "shutil.")):
            return
        folder, self.folder = self.folder, None
        try:
            # Nor does it count that a link's own name is tried, if it is not to be followed.
            own_name = event == "open" and isinstance(arguments[2], int) and arguments[2] & os.O_NOFOLLOW
            for path in () if own_name else arguments:
                if isinstance(path, (str, bytes, os.PathLike)) and self._is_in(folder, path):
                    self.seen.append((event, os.fsdecode(path)))
        finally:
            self.folder = folder

    @staticmethod
    def _is_in(folder: Path, path: bytes | str | os.PathLike[Any]) -> bool:
        try:
            return Path(os.path.realpath(os.fsdecode(path))).is_relative_to(folder)
        except (OSError, ValueError):
            return False


WATCH = Watch()


@pytest.fixture(scope="module", autouse=True)
def _audit() -> None:
    sys.addaudithook(WATCH)  # for as long as the process lives; it sleeps while it has no folder


@pytest.fixture
def precious(tmp_path: Path) -> Iterator[Path]:
    """A folder outside the sweep that nobody may even look into."""
    folder = (tmp_path / "precious").resolve()
    folder.mkdir()
    (folder / "thesis.json").write_text("{}")
    (folder / "policy.json").write_text("{}")
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    WATCH.seen, WATCH.folder = [], folder
    yield folder
    WATCH.folder = None
    assert WATCH.seen == []
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = odd_files.make_template(tmp_path_factory.mktemp("template") / "mine")
    for name in ("tune", "report/figures", "packs", "trials/t0001/copied/000003", "trials/t0001/tensorboard"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for name in ("driver.log", "packs/p00.log", "trials/t0001/log.txt", "best/before.mp4", "report/index.html", ".lock",
                 ".driver-lock", ".owner", "tune/state.json"):  # fmt: skip
        (folder / name).touch()
    return folder


@pytest.fixture(autouse=True)
def _no_modules_stay_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())


@pytest.fixture
def folder(template: Path, tmp_path: Path) -> Path:
    return shutil.copytree(template, tmp_path / "sweeps" / "mine")


def write_films(store: SweepStore) -> None:
    for path in (store.best_folder / "before.mp4", refuse_links_in(store.report_folder) / "index.html"):
        path.write_bytes(b"")


def scalars(store: SweepStore) -> None:
    writer = ScalarWriter(store)
    writer.write(store.trial("t0001").read_record(), [make_iteration(1)])
    writer.flush()


def resume(store: SweepStore) -> None:
    with held(store.folder / ".lock", "", ""):
        Owner.take(store.folder / ".owner")
        store.driver_log.open("ab").close()
        remove_folder(store.tune_folder)


def use(folder: Path) -> None:
    """What readers and a driver do with a sweep, each for itself."""
    store = SweepStore(folder)
    acts = (
        lambda: sweeps.status(folder),
        lambda: read_candidates(store, policy_candidates(read_trials(store)), 4),
        lambda: confirmed_best(store),
        lambda: load_policy(finish.find_checkpoint(folder)),
        lambda: read_results(store),
        lambda: finish.find_policy(folder),
        lambda: PackFiles(folder, "p00").read(),
        lambda: PackFiles(folder, "p00").write(Assignment(("t0000",))),
        lambda: PackFiles(folder, "p00").log_tail(),
        lambda: PackFiles(folder, "p00").log_path.open("ab").close(),
        lambda: store.trial("t0001").log_tail(),
        lambda: store.trial("t0001").log_path.open("ab").close(),
        lambda: scalars(store),
        store.request_stop,
        store.clear_stop_request,
        lambda: resume(store),
        lambda: write_films(store),
        # Goes on from its latest checkpoint, writes others, and deletes those that are too many.
        lambda: train(store, "t0001", 9),
    )
    for act in acts:
        with contextlib.suppress(TuneJobsError):
            act()


def texts_in(template: Path) -> Iterator[tuple[str, tuple[int | str, ...]]]:
    """Every place of every file that holds a text, or may."""
    for file in odd_files.FILES:
        data = odd_files.read(template / file)
        for at in odd_files.places(data):
            value = data
            for key in at:
                value = value[key]
            if value is None or isinstance(value, str):
                yield file, at


def test_nothing_that_is_left_alone_looks_outside(folder: Path, precious: Path) -> None:
    use(folder)
    WATCH.folder = None
    assert (folder / "trials" / "t0001" / "checkpoints" / "000009").is_dir()
    assert not (folder / "tune").exists()


def test_the_watch_sees(precious: Path) -> None:
    """Or the other tests would say nothing."""
    (precious / "thesis.json").read_text()
    list(precious.iterdir())
    assert {event for event, _ in WATCH.seen} >= {"open", "os.listdir"}
    WATCH.seen.clear()


def test_the_files_that_are_tried_hold_every_text_of_every_record(template: Path) -> None:
    """A field that is new is tried too, or this fails."""
    known = {at[-1] for _, at in texts_in(template)} | {at[-2] for _, at in texts_in(template) if at[-1] == 0}
    for name in ("SweepRecord", "TrialRecord", "CheckpointRecord", "ChangeRecord", "BestRecord", "EvaluationRecord"):
        for field, kind in typing.get_type_hints(getattr(records, name, None) or getattr(best_records, name)).items():
            if kind is str or (str in typing.get_args(kind) and typing.get_origin(kind) is not dict):
                assert field in known, f"{name}.{field}"


@pytest.mark.parametrize("file", odd_files.FILES)
def test_no_text_in_a_file_leads_outside(template: Path, folder: Path, precious: Path, file: str) -> None:
    """Of three kinds of paths, each place is given one and the next place the next one."""
    paths = itertools.cycle([str(precious), "../../precious", "../../../../../precious", "x/../../../precious"])
    for other, at in texts_in(template):
        if other == file:
            odd_files.write(folder / file, odd_files.put(odd_files.read(template / file), at, next(paths)))
            use(folder)
            WATCH.folder = None
            shutil.rmtree(folder)
            shutil.copytree(template, folder)
            WATCH.folder = precious


def parts_of(template: Path) -> list[str]:
    """Of the trials those of the winner; the other's are as these."""
    parts = (path.relative_to(template).as_posix() for path in template.rglob("*"))
    return sorted(part for part in parts if not part.startswith("trials/t0000/"))


def test_no_part_of_a_sweep_is_followed_if_it_is_a_link(
    template: Path, folder: Path, precious: Path, tmp_path: Path
) -> None:
    followed = {}
    for part in parts_of(template):
        WATCH.folder, path = None, folder / part
        is_folder = path.is_dir()
        path.rename(tmp_path / "moved")
        path.symlink_to(precious if is_folder else precious / "thesis.json", target_is_directory=is_folder)
        WATCH.folder = precious
        use(folder)
        WATCH.folder = None
        if WATCH.seen:
            followed[part], WATCH.seen = [event for event, _ in WATCH.seen], []
        shutil.rmtree(folder)
        (shutil.rmtree if is_folder else os.unlink)(tmp_path / "moved")
        shutil.copytree(template, folder)
    assert not followed, "\n".join(f"{part}: {events}" for part, events in followed.items())
