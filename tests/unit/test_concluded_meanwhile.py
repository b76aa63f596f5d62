"""While a policy plays or a report is drawn, another process may end the sweep, choose its best, or remove it."""

import functools
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import extend_by_leaders, make_sweep_folder

from analysis.best_records import BestRecord, ChoiceRecord
from analysis.records import TrialRecord
from policies.errors import CannotRunError, NotFoundError
from policies.files import write_atomic
from tests.narrowing import present
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude
from tune_jobs.sweeps.current_best import has_current_best
from tune_jobs.sweeps.drawing import DrawnReport
from tune_jobs.sweeps.policy_choice import with_runners_up

Meanwhile = Callable[[Callable[[], object]], None]


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    """A sweep of 4 trials."""
    return make_sweep_folder(tmp_path / "mine")


@pytest.fixture
def while_it_plays(monkeypatch: pytest.MonkeyPatch) -> Meanwhile:
    """Have something done once, while runners-up play."""
    real, to_do = with_runners_up, list[Callable[[], object]]()

    def played(*arguments: Any) -> ChoiceRecord:
        if to_do:
            to_do.pop()()
        return real(*arguments)

    monkeypatch.setattr(conclude, "with_runners_up", played)
    return to_do.append


@pytest.fixture
def while_it_draws(monkeypatch: pytest.MonkeyPatch) -> Meanwhile:
    """Have something done once, while figures are drawn; a page says of how many trials and of which winner it is."""
    to_do: list[Callable[[], object]] = []

    def build(place: str, *, target: Path, trials: list[TrialRecord], best: BestRecord | None, **others: Any) -> Path:
        write_atomic(target / "figures" / "a.svg", "a figure")
        if to_do:
            to_do.pop()()
        videos = others["videos"]
        _ = videos() if callable(videos) else videos
        page = target / "index.html"
        write_atomic(page, f"{len(trials)} trials, best {present(best).checkpoint.trial_id}")
        return page

    monkeypatch.setattr("analysis.report.build_report", build)
    return to_do.append


def end(store: SweepStore) -> BestRecord:
    """Go on and conclude, as the process does that runs the sweep: two more trials lead."""
    extend_by_leaders(store)
    best = conclude.choose_best(store, 1)
    conclude.make_report(store)
    return best


def make_another(store: SweepStore) -> None:
    """Remove a sweep, and make another one of its name."""
    store.delete()
    other = make_sweep_folder(store.folder)
    other.write_record(other.read_record().model_copy(update={"created_at": 77.0}))


def content(store: SweepStore) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in store.folder.rglob("*") if path.is_file()}


def test_what_the_run_has_chosen_meanwhile_stays(store: SweepStore, while_it_plays: Meanwhile) -> None:
    of_the_run: list[tuple[BestRecord, bytes]] = []
    weights = store.folder / "best" / "policy.safetensors"
    while_it_plays(lambda: of_the_run.append((end(store), weights.read_bytes())))
    found = conclude.choose_best(store, 1)
    assert found.checkpoint.trial_id == "t0004"
    assert [(store.read_best(), weights.read_bytes())] == of_the_run == [(found, weights.read_bytes())]
    assert has_current_best(store)


def test_what_was_chosen_before_the_sweep_went_on_is_replaced(store: SweepStore, while_it_plays: Meanwhile) -> None:
    conclude.choose_best(store, 1)
    extend_by_leaders(store)
    while_it_plays(lambda: None)
    assert conclude.choose_best(store, 1).checkpoint.trial_id == "t0004"
    assert store.read_best().checkpoint.trial_id == "t0004"


def test_the_report_of_the_run_is_not_replaced_by_an_older_one(store: SweepStore, while_it_draws: Meanwhile) -> None:
    conclude.choose_best(store, 1)
    while_it_draws(lambda: end(store))
    page = conclude.make_report(store)
    assert page.read_text() == "6 trials, best t0004"
    assert store.current_report() == page


def test_a_report_that_is_drawn_while_another_winner_is_written_shows_that(
    store: SweepStore, while_it_draws: Meanwhile
) -> None:
    with DrawnReport(store, conclude.choose_best(store, 1)) as report:
        end(store)
        page = report.written()
    assert page.read_text() == "6 trials, best t0004"


def test_a_report_of_a_sweep_whose_record_changes_all_the_time_is_written(
    store: SweepStore, while_it_draws: Meanwhile
) -> None:
    conclude.choose_best(store, 1)

    def change() -> None:
        store.write_record(store.read_record())
        while_it_draws(change)

    while_it_draws(change)
    assert conclude.make_report(store).read_text() == "4 trials, best t0003"


def test_of_a_sweep_that_is_removed_meanwhile_nothing_comes_back(
    store: SweepStore, while_it_plays: Meanwhile, while_it_draws: Meanwhile
) -> None:
    kept = shutil.copytree(store.folder, store.folder.with_name("kept"))
    while_it_plays(store.delete)
    with pytest.raises(NotFoundError):
        conclude.choose_best(store, 1)
    assert not store.folder.exists()
    shutil.copytree(kept, store.folder)
    conclude.choose_best(store, 1)
    while_it_draws(store.delete)
    with pytest.raises(NotFoundError):
        conclude.make_report(store)
    assert not store.folder.exists()


def test_another_sweep_of_its_name_is_left_as_it_is(
    store: SweepStore, while_it_plays: Meanwhile, while_it_draws: Meanwhile
) -> None:
    while_it_plays(lambda: make_another(store))
    with pytest.raises(NotFoundError, match="mine was removed meanwhile"):
        conclude.choose_best(store, 1)
    assert not store.has_best()
    conclude.choose_best(store, 1)
    store.write_record(store.read_record().model_copy(update={"created_at": 5.0}))
    while_it_draws(lambda: make_another(store))
    with pytest.raises(NotFoundError, match="mine was removed meanwhile"):
        conclude.make_report(store)
    assert store.current_report() is None


# -- one that may only be read


@pytest.fixture
def read_only(store: SweepStore, monkeypatch: pytest.MonkeyPatch) -> SweepStore:
    """A colleague's: for root, too."""
    real = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: mode & os.W_OK == 0 and real(path, mode))
    return store


def test_the_policy_of_a_sweep_that_may_only_be_read_plays(read_only: SweepStore) -> None:
    before = content(read_only)
    source = conclude.find_policy(read_only.folder)
    assert source.policy.description == "mine/t0003"
    assert [len(each.returns) for each in conclude.evaluate(source, 2, None, lambda _: None)] == [2, 2]
    assert content(read_only) == before


@pytest.mark.parametrize("write", [conclude.choose_best, conclude.make_report, conclude.make_videos])
def test_what_would_be_written_of_it_is_refused_before_anything_plays(
    read_only: SweepStore, monkeypatch: pytest.MonkeyPatch, write: Callable[[SweepStore], object]
) -> None:
    monkeypatch.setattr(conclude, "choose_policy", functools.partial(pytest.fail, "it plays"))
    with pytest.raises(CannotRunError, match=r"mine cannot be written: .*/mine may only be read") as raised:
        write(read_only)
    assert "a storage of your own" in raised.value.hint
