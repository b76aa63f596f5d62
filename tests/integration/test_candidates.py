"""What is chosen as the best is what was written, and scored what it says; the rest is left out, with a warning."""

import json
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import make_sweep_folder

from analysis.records import CheckpointRecord, TrialStatus
from analysis.selection import NoUsableTrialError
from policies.errors import CheckpointError
from policies.portable.file import read_policy
from tests.narrowing import present
from tune_jobs.store.candidates import read_results, read_trials
from tune_jobs.store.record_files import seal
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.sweeps import conclude as finish
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.settings import with_present_settings

SAMPLE = Path(__file__).parents[1] / "unit" / "samples" / "sweep_format_1"


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sweep_folder(tmp_path_factory.mktemp("template") / "mine").folder


@pytest.fixture
def store(template: Path, tmp_path: Path) -> SweepStore:
    return SweepStore(shutil.copytree(template, tmp_path / "mine"))


@pytest.fixture
def old_store(tmp_path: Path) -> SweepStore:
    """Written by a version without seals."""
    return SweepStore(shutil.copytree(SAMPLE, tmp_path / "old"))


def edit(path: Path, *, sealed: bool = False, **changes: float) -> None:
    data = json.loads(path.read_text()) | changes
    if sealed:
        data["sha256"] = seal(data)
    path.write_text(json.dumps(data))


def manifest(store: SweepStore, trial_id: str, iteration: int) -> Path:
    return store.trial(trial_id).checkpoint_folder(iteration) / "manifest.json"


def chosen(store: SweepStore) -> tuple[str, int, float | None]:
    """The winner, and what it scored in training: networks are equal here, so further episodes decide nothing."""
    best = sweeps.best(store.folder, num_episodes=1)
    return best.checkpoint.trial_id, best.checkpoint.iteration, best.checkpoint.evaluation_return


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_the_best_of_an_untouched_sweep_is_chosen_without_a_warning(
    store: SweepStore, caplog: pytest.LogCaptureFixture
) -> None:
    assert chosen(store) == ("t0003", 6, 36.0)
    assert warnings_of(caplog) == []


def test_the_best_of_an_old_sweep_is_chosen_without_a_warning(
    old_store: SweepStore, caplog: pytest.LogCaptureFixture
) -> None:
    assert old_store.read_best().checkpoint.trial_id == "t0001"
    assert chosen(old_store) == ("t0001", 2, 12.0)
    assert warnings_of(caplog) == []


@pytest.mark.parametrize("sealed", [False, True])
@pytest.mark.parametrize("changes", [{"evaluation_return": 924.5}, {"evaluation_return": 36.0, "num_env_steps": 1}])
def test_an_edited_score_does_not_win(
    store: SweepStore, caplog: pytest.LogCaptureFixture, sealed: bool, changes: dict[str, Any]
) -> None:
    """Sealed by somebody who knows how, it contradicts the results."""
    edit(manifest(store, "t0000", 6), sealed=sealed, **changes)
    assert chosen(store) == ("t0003", 6, 36.0)
    (warning,) = warnings_of(caplog)
    assert "t0000/checkpoints/000006" in warning
    assert [len(trial.checkpoints) for trial in read_trials(store)] == [1, 2, 2, 2]


def test_an_edited_score_of_an_old_sweep_does_not_win(old_store: SweepStore, caplog: pytest.LogCaptureFixture) -> None:
    edit(manifest(old_store, "t0000", 2), evaluation_return=924.5)
    assert chosen(old_store) == ("t0001", 2, 12.0)
    (warning,) = warnings_of(caplog)
    assert "says that it scored 924.5 after 200 env steps; results.jsonl says 2.0 after 200" in warning


def test_the_others_of_a_trial_still_compete(store: SweepStore) -> None:
    edit(manifest(store, "t0003", 6), evaluation_return=924.5)
    assert chosen(store) == ("t0003", 5, 35.0)


def test_results_that_were_edited_leave_their_checkpoint_out_too(
    store: SweepStore, caplog: pytest.LogCaptureFixture
) -> None:
    path = store.trial("t0003").results_path
    path.write_text(path.read_text().replace('"evaluation_return":36.0', '"evaluation_return":37.0'))
    assert chosen(store) == ("t0003", 5, 35.0)
    assert len(warnings_of(caplog)) == 1


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_bytes(b"\xff\n[]\n7\n{}\n")])
def test_results_that_cannot_be_read_contradict_nothing(
    store: SweepStore, damage: Callable[[Path], int | None]
) -> None:
    damage(store.trial("t0003").results_path)
    assert chosen(store) == ("t0003", 6, 36.0)


@pytest.mark.parametrize("empty", [False, True])
def test_results_that_are_gone_are_told(store: SweepStore, caplog: pytest.LogCaptureFixture, *, empty: bool) -> None:
    assert all(read_results(store).values())
    assert warnings_of(caplog) == []
    lost = store.trial("t0002").results_path
    lost.write_bytes(b"") if empty else lost.unlink()
    assert [trial_id for trial_id, results in read_results(store).items() if not results] == ["t0002"]
    (warning,) = warnings_of(caplog)
    assert f"results of trial t0002 in {store.place}, which has trained for 6 iterations, are gone" in warning


@pytest.mark.parametrize("status", ["failed", "running"])
def test_results_that_need_not_be_written_are_not_gone(
    store: SweepStore, caplog: pytest.LogCaptureFixture, status: TrialStatus
) -> None:
    """Of a trial that was killed before it wrote any, and of one in an object store, which sends them later."""
    store.trial("t0002").results_path.unlink()
    trial = store.trial("t0002").read_record()
    store.trial("t0002").write_record(trial.model_copy(update={"status": status}))
    assert not read_results(store)["t0002"]
    assert warnings_of(caplog) == []


def test_a_trial_that_has_not_trained_has_no_results_to_lose(
    store: SweepStore, caplog: pytest.LogCaptureFixture
) -> None:
    store.trial("t0002").results_path.unlink()
    trial = store.trial("t0002").read_record()
    store.trial("t0002").write_record(trial.model_copy(update={"num_iterations": 0}))
    assert not read_results(store)["t0002"]
    assert warnings_of(caplog) == []


def test_a_winner_whose_files_are_damaged_gives_way_to_the_next(
    store: SweepStore, caplog: pytest.LogCaptureFixture
) -> None:
    for iteration in (5, 6):
        folder = store.trial("t0003").checkpoint_folder(iteration)
        (folder / "policy.safetensors").write_bytes(b"")
    assert chosen(store) == ("t0002", 6, 26.0)
    text = "\n".join(warnings_of(caplog))
    assert "t0003/checkpoints/000005" in text
    assert "t0003/checkpoints/000006" in text


def test_with_nothing_left_there_is_no_best(store: SweepStore, caplog: pytest.LogCaptureFixture) -> None:
    for path in store.folder.glob("trials/*/checkpoints/*/policy.json"):
        path.write_text("{}")
    with pytest.raises(NoUsableTrialError):
        sweeps.best(store.folder, num_episodes=1)
    assert len(warnings_of(caplog)) == 8


@pytest.mark.parametrize("changes", [{"point_index": 1}, {"seed_index": 0, "index": 3}, {"point_index": 77}])
def test_which_point_a_trial_is_of_follows_from_its_number(store: SweepStore, changes: dict[str, Any]) -> None:
    before = [(trial.index, trial.point_index, trial.seed_index) for trial in read_trials(store)]
    edit(store.trial("t0001").record_path, **changes)
    assert [(trial.index, trial.point_index, trial.seed_index) for trial in read_trials(store)] == before
    assert before == [(0, 0, 0), (1, 0, 1), (2, 1, 0), (3, 1, 1)]
    assert chosen(store) == ("t0003", 6, 36.0)


def test_an_edited_evaluation_of_the_best_is_not_shown_but_made_anew(
    store: SweepStore, caplog: pytest.LogCaptureFixture
) -> None:
    sweeps.best(store.folder, num_episodes=1)
    edit(store.best_folder / "evaluation.json", selection_score=924.5)
    with pytest.raises(CheckpointError, match=r"evaluation\.json is not the best record that was written"):
        store.read_best()
    page = finish.make_report(store).read_text()
    assert "924.5" not in page
    assert store.read_best().checkpoint.evaluation_return == 36.0
    assert "evaluation.json" in warnings_of(caplog)[0]


def test_a_checkpoint_that_is_pruned_meanwhile_is_no_reason_to_warn(
    store: SweepStore, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial = store.trial("t0003")
    real = type(trial).checkpoint

    def pruned(self: TrialStore, iteration: int) -> CheckpointRecord:
        if self.trial_id == "t0003" and iteration == 5:
            shutil.rmtree(self.checkpoint_folder(5))
        return real(self, iteration)

    monkeypatch.setattr(type(trial), "checkpoint", pruned)
    assert [record.iteration for record in read_trials(store)[3].checkpoints] == [6]
    assert warnings_of(caplog) == []


def test_settings_that_are_others_by_now_are_written_to_the_winner(store: SweepStore) -> None:
    """As after a replication that leaves the winner as it is."""
    best = finish.choose_best(store, 2)
    settings = present(best.settings)
    assert with_present_settings(store, best) is best
    old = best.model_copy(update={"settings": settings.model_copy(update={"num_settings": 1})})
    assert with_present_settings(store, old) == best
    store.write_best(old, read_policy(store.best_folder))
    assert with_present_settings(store, store.read_best()) == store.read_best() == best
