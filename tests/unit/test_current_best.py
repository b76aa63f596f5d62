"""A policy that was chosen before its sweep was extended is neither shown nor used as the best one."""

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import extend_by_leaders, make_sweep_folder

from policies.errors import EnvFailedError
from tests.narrowing import present
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.attach import attach
from tune_jobs.sweeps.current_best import has_current_best
from tune_jobs.sweeps.finishing import finish_sweep
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.policy_choice import confirmed_best
from tune_jobs.sweeps.side_by_side import side_by_side
from tune_jobs.sweeps.sweep_file import sweep_file


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> SweepStore:
    store = make_sweep_folder(tmp_path_factory.mktemp("storage") / "mine")
    sweeps.best(store.folder, num_episodes=2)
    return store


@pytest.fixture
def store(made: SweepStore, tmp_path: Path) -> SweepStore:
    """A sweep of 4 trials with a best policy."""
    return SweepStore(shutil.copytree(made.folder, tmp_path / "mine"))


@pytest.fixture
def extended(store: SweepStore) -> SweepStore:
    """The same, extended since: two more trials lead by far."""
    extend_by_leaders(store)
    return store


def test_a_policy_is_current_until_others_compete_with_it(store: SweepStore) -> None:
    assert has_current_best(store)
    extend_by_leaders(store)
    assert not has_current_best(store)
    sweeps.best(store.folder, num_episodes=2)
    assert has_current_best(store)
    shutil.rmtree(store.best_folder)
    assert not has_current_best(store)


def test_while_a_sweep_runs_the_policy_that_was_chosen_last_is_taken(extended: SweepStore) -> None:
    with extended.lock():
        assert has_current_best(extended)
        assert conclude.find_checkpoint(extended.folder) == extended.checkpoint_folder(extended.read_best().checkpoint)


def test_where_nothing_can_be_chosen_anew_the_policy_stays(extended: SweepStore) -> None:
    whole = extended.trial("t0005").record_path.read_bytes()
    extended.trial("t0005").record_path.write_text("{")
    assert has_current_best(extended), "a trial's record is damaged"
    extended.trial("t0005").record_path.write_bytes(whole)
    for trial in extended.read_trials():
        shutil.rmtree(extended.trial(trial.trial_id).folder / "checkpoints")
    assert has_current_best(extended), "no checkpoint is left"


def test_a_checkpoint_that_was_damaged_before_makes_no_policy_outdated(store: SweepStore) -> None:
    manifest = store.trial("t0000").checkpoint_folder(6) / "manifest.json"
    manifest.write_text(manifest.read_text().replace("600", "601"))
    sweeps.best(store.folder, num_episodes=2)
    assert has_current_best(store)
    assert present(sweeps.status(store.folder).best).score == store.read_best().selection_score


def test_the_status_of_an_extended_sweep_is_of_its_trials(extended: SweepStore) -> None:
    best = present(sweeps.status(extended.folder).best)
    assert (best.trial_id, best.score) == ("t0004", 406.0)


@pytest.mark.parametrize("take", [conclude.find_policy, conclude.find_checkpoint])
def test_a_policy_is_chosen_anew_before_it_plays_or_is_trained_on(
    extended: SweepStore, take: Callable[[Path], Any]
) -> None:
    before = present(extended.read_best().choice).num_known
    taken = take(extended.folder)
    best = extended.read_best()
    assert (before, present(best.choice).num_known) == (8, 12)
    if isinstance(taken, Path):
        assert taken == extended.checkpoint_folder(best.checkpoint)


def test_attach_names_no_outdated_winner(extended: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    result = attach(extended.folder, progress="none")
    assert (result.best, result.artifacts, result.exit_code) == (None, {}, 0)
    why = f"the one there is was chosen before the sweep was trained on. `tune-jobs best {extended.folder}` does it"
    assert present(result.why_no_best).startswith(why)

    def broken(*_: object, **__: object) -> None:
        raise EnvFailedError("The simulator is down.", "")

    monkeypatch.setattr(conclude, "choose_best", broken)
    there = finish_sweep(extended, SweepResult(extended.place, extended.read_record(), extended.read_trials()))
    here = attach(extended.folder, progress="none")
    assert (here.best, here.exit_code) == (there.best, there.exit_code) == (None, 3)
    assert list(here.artifacts) == ["report"]


def test_a_file_and_a_comparison_have_no_outdated_winner(extended: SweepStore, tmp_path: Path) -> None:
    assert json.loads(gzip.decompress(sweep_file(extended)))["best"] is None
    other = make_sweep_folder(tmp_path / "other")
    facts = {fact.title for fact in side_by_side([extended, other]).facts}
    assert "policy to deploy" not in facts
    sweeps.best(extended.folder, num_episodes=2)
    assert json.loads(gzip.decompress(sweep_file(extended)))["best"] is not None
    assert "policy to deploy" in {fact.title for fact in side_by_side([extended, other]).facts}


# -- checkpoints that were deleted to save space, with best/ kept


def delete_checkpoints(store: SweepStore, *trial_ids: str) -> None:
    for trial_id in trial_ids:
        shutil.rmtree(store.trial(trial_id).folder / "checkpoints")


def finished(store: SweepStore) -> SweepResult:
    """What `resume` comes to where nothing is left to run."""
    result = SweepResult(store.place, store.read_record(), store.read_trials())
    return finish_sweep(store, result, keep=True)


def test_a_best_policy_stays_where_no_checkpoint_is_left(store: SweepStore) -> None:
    before, policy = store.read_best(), (store.best_folder / "policy.json").read_bytes()
    delete_checkpoints(store, "t0000", "t0001", "t0002", "t0003")
    assert has_current_best(store)
    result = finished(store)
    assert (result.best, result.why_no_best, result.finish_failed) == (before, None, False)
    assert not any("of before" in note for note in result.notes)
    assert (store.best_folder / "policy.json").read_bytes() == policy


@pytest.mark.parametrize("extend", [False, True])
def test_a_best_policy_whose_checkpoint_is_gone_is_not_replaced_without_a_word(
    store: SweepStore, *, extend: bool
) -> None:
    before = store.read_best().checkpoint
    delete_checkpoints(store, before.trial_id)
    if extend:
        extend_by_leaders(store)
    result = finished(store)
    assert present(result.best).checkpoint != before
    (note,) = [note for note in result.notes if "of before" in note]
    assert note.startswith("The best policy of before, t0003 at 600 env steps, could not compete")


def test_a_best_policy_whose_checkpoint_its_own_trial_deleted_gives_way_as_ever(store: SweepStore) -> None:
    winner = store.trial("t0003").read_record()
    left = [item for item in winner.checkpoints if item != store.read_best().checkpoint]
    delete_checkpoints(store, "t0000", "t0001", "t0002", "t0003")
    store.trial("t0003").write_record(winner.model_copy(update={"checkpoints": tuple(left)}))
    assert confirmed_best(store) is None


def test_a_damaged_policy_stays_nowhere(store: SweepStore) -> None:
    delete_checkpoints(store, "t0000", "t0001", "t0002", "t0003")
    (store.best_folder / "policy.json").write_text("{")
    assert confirmed_best(store) is None
