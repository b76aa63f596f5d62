"""`resume` of a sweep that is finished: its records stay to the byte, and only what is missing is made."""

import os
import shutil
from pathlib import Path

import pytest
from sweep_folders import make_sweep_folder

from analysis.answers import nothing_learned
from policies.errors import CannotRunError
from tests.narrowing import present
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.outcome import SweepResult


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> SweepStore:
    """A finished sweep; each test leaves it finished."""
    store = make_sweep_folder(tmp_path_factory.mktemp("storage") / "mine", iterations=4)
    assert resumed(store).exit_code == 0
    return store


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let films and report be made at once, under their names."""

    def films(store: SweepStore) -> dict[str, Path]:
        with store.writing_films() as paths:
            for path in paths.values():
                path.write_bytes(b"film")
        return dict(paths)

    def report(store: SweepStore, _: object) -> Path:
        with store.writing_report() as folder:
            folder.mkdir(exist_ok=True)
            (folder / "index.html").write_bytes(b"page")
        return folder / "index.html"

    monkeypatch.setattr(conclude, "make_videos", films)
    monkeypatch.setattr(conclude, "make_report", report)


def resumed(store: SweepStore) -> SweepResult:
    return sweeps.resume(store.folder, progress="none")


def files(store: SweepStore) -> dict[str, tuple[bytes, int]]:
    """Every file but those of locks and of the run, with its content and when it was written."""
    return {
        path.relative_to(store.folder).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in sorted(store.folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }


def written(store: SweepStore, before: dict[str, tuple[bytes, int]]) -> set[str]:
    """The files that were written since, by the folder they are in."""
    return {str(Path(name).parent) for name, found in files(store).items() if before.get(name) != found}


def aged(path: Path, seconds: int) -> None:
    """Let a file seem to be older."""
    then = path.stat().st_mtime_ns - seconds * 10**9
    os.utime(path, ns=(then, then))


def test_nothing_is_written(finished: SweepStore) -> None:
    before = files(finished)
    assert {"sweep.json", "trials/t0000/trial.json", "trials/t0000/results.jsonl", "best/evaluation.json"} <= set(
        before
    )
    result = resumed(finished)
    assert files(finished) == before
    assert (result.exit_code, result.interrupted) == (0, False)
    # The fake has trained nothing.
    assert result.notes == (nothing_learned(finished.read_best()),)
    assert set(result.artifacts) == {"policy", "before_mp4", "after_mp4", "after_gif", "before_after_mp4", "report"}
    assert all(path.is_file() for path in result.artifacts.values())
    assert present(result.best) == finished.read_best()


def test_a_confirmation_of_another_length_stays(finished: SweepStore, cheap: None) -> None:
    sweeps.best(finished.folder, num_episodes=7)
    for _ in range(2):
        resumed(finished)
        assert finished.read_best().confirmation.num_episodes == 7


def test_a_missing_film_is_made_and_shown_in_the_report(finished: SweepStore, cheap: None) -> None:
    finished.films()["after_gif"].unlink()
    before = files(finished)
    resumed(finished)
    assert written(finished, before) == {"best", "report"}
    assert files(finished)["best/evaluation.json"] == before["best/evaluation.json"]
    assert finished.current_films()


def test_a_missing_report_is_written(finished: SweepStore, cheap: None) -> None:
    present(finished.current_report()).unlink()
    before = files(finished)
    resumed(finished)
    assert written(finished, before) == {"report"}


def test_a_report_that_is_older_than_what_it_shows_is_made_again(finished: SweepStore, cheap: None) -> None:
    # Killed before the report: it still shows the sweep as it was before the trials that came last.
    aged(finished.folder / "report/index.html", 3_600)
    before = files(finished)
    resumed(finished)
    assert written(finished, before) == {"report"}
    assert files(finished)["best/evaluation.json"] == before["best/evaluation.json"]


def test_films_that_show_another_winner_are_made_again(finished: SweepStore, cheap: None) -> None:
    # Killed before the films: they still show the winner before this one.
    best = finished.read_best()
    finished.write_best(best.model_copy(update={"checkpoint": best.checkpoint.model_copy(update={"iteration": 1})}))
    with finished.writing_films():
        pass
    finished.write_best(best)
    assert not finished.films()
    before = files(finished)
    resumed(finished)
    assert written(finished, before) == {"best", "report"}
    assert files(finished)["best/evaluation.json"] == before["best/evaluation.json"]
    assert finished.current_films()


def test_films_without_a_record_count_by_their_age(finished: SweepStore, cheap: None) -> None:
    # As older versions left them.
    (finished.best_folder / "films.json").unlink()
    assert finished.current_films()
    aged(finished.best_folder / "after.mp4", 3_600)
    assert not finished.films()
    resumed(finished)
    assert finished.current_films()


@pytest.mark.parametrize("name", ["evaluation.json", "policy.safetensors"])
def test_a_damaged_winner_is_confirmed_anew(finished: SweepStore, cheap: None, name: str) -> None:
    path = finished.best_folder / name
    content = path.read_bytes()
    path.write_bytes(content[:-10])
    assert resumed(finished).exit_code == 0
    assert finished.read_best().checkpoint.trial_id == "t0003"
    assert path.read_bytes() != content[:-10]


def test_another_winner_is_confirmed_if_the_checkpoint_is_gone(tmp_path: Path, cheap: None) -> None:
    store = make_sweep_folder(tmp_path / "mine", iterations=4)
    first = present(resumed(store).best).checkpoint
    shutil.rmtree(store.checkpoint_folder(first))
    second = present(resumed(store).best).checkpoint
    assert (second.trial_id, second.iteration) != (first.trial_id, first.iteration)
    assert store.read_best().checkpoint == second


def test_a_sweep_of_a_version_with_fewer_hyperparameters_goes_on(finished: SweepStore, cheap: None) -> None:
    """A name that its records lack has its default; a value that is another one is still refused."""
    trial = finished.trial("t0001")
    record = trial.read_record()
    older = {name: value for name, value in record.hyperparams.items() if not name.startswith("clip_")}
    trial.write_record(record.model_copy(update={"hyperparams": older}))
    assert resumed(finished).exit_code == 0
    other = {**older, "gamma": 0.5}
    trial.write_record(record.model_copy(update={"hyperparams": other}))
    with pytest.raises(CannotRunError, match="t0001 of sweep mine is not the one its spec gives"):
        resumed(finished)
    del other["gamma"]
    trial.write_record(record.model_copy(update={"hyperparams": {**other, "clip_param": 0.1, "gamma": 0.99}}))
    with pytest.raises(CannotRunError, match="t0001 of sweep mine"):
        resumed(finished)
    trial.write_record(record)
