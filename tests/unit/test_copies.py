"""A trial that goes on from a copy of another's checkpoint, with values of its own."""

import dataclasses
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task
from trial_runs import Trial

from analysis.records import ChangeRecord, CheckpointRecord, TrialRecord
from analysis.selection import rank_points
from analysis.tables import trials_frame
from policies.acting.evaluate import Evaluator
from policies.errors import CheckpointError
from tune_jobs.store.copies import copy_latest_checkpoint, remove_uncounted_copies
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.protocol import TrialTask
from tune_jobs.training.trial_loop import TrialLoop


def change(iteration: int, **fields: Any) -> ChangeRecord:
    return ChangeRecord(
        **{
            "iteration": iteration, "num_env_steps": iteration * 100, "source_trial_id": "t0001",
            "source_iteration": 20, "before": {"lr": 0.1}, "after": {"lr": 0.2}, "time": 0.0,
        } | fields
    )  # fmt: skip


class Recording(FakeEngine):
    """Remembers what it was built from."""

    def build(self, task: TrialTask, checkpoint: Path | None) -> None:
        super().build(task, checkpoint)
        self.task, self.checkpoint = task, checkpoint


def built(trial: Trial) -> Recording:
    assert isinstance(trial.engine, Recording)
    return trial.engine


@pytest.fixture
def better(tmp_path: Path) -> TrialStore:
    """Another trial, 20 iterations far."""
    task = dataclasses.replace(make_task(tmp_path), trial_id="t0001")
    loop = TrialLoop(task, FakeEngine(), cast("Evaluator", FakeEvaluator()), FakeClock())
    loop.open()
    while loop.iteration < 20:
        loop.advance(60.0)
    return TrialStore(tmp_path, "t0001")


def taken_over(
    tmp_path: Path,
    better: TrialStore,
    iteration: int = 5,
    episodes: Callable[[int], tuple[float, ...]] = lambda iteration: (20.0,),
    scores: Callable[[int], int] | type[float] = float,
) -> Trial:
    """A trial that came to `iteration` and then got a copy of the better one's checkpoint."""
    worse = Trial(tmp_path, engine=FakeEngine(episodes), scores=scores)
    worse.run_to(iteration)
    copy_latest_checkpoint(better, worse.store, iteration)
    return worse


def test_the_trial_goes_on_at_its_own_count_from_the_others_checkpoint(tmp_path: Path, better: TrialStore) -> None:
    taken_over(tmp_path, better)
    after = Trial(tmp_path, engine=Recording(), changes=(change(5),))
    assert built(after).checkpoint == after.store.copied_checkpoint(5)
    assert after.engine.iteration == 20
    assert (built(after).task.num_iterations, built(after).task.num_env_steps) == (5, 500)
    assert after.loop.iteration == 5
    after.run_to(7)
    assert [record.iteration for record in after.results] == [1, 2, 3, 4, 5, 6, 7]


def test_the_copy_stays_though_the_other_trial_deletes_its_checkpoints(tmp_path: Path, better: TrialStore) -> None:
    taken_over(tmp_path, better)
    shutil.rmtree(better.folder)
    assert Trial(tmp_path, engine=Recording(), changes=(change(5),)).engine.iteration == 20


def test_a_copy_without_a_change_in_the_record_does_not_count(tmp_path: Path, better: TrialStore) -> None:
    worse = taken_over(tmp_path, better, iteration=10)
    after = Trial(tmp_path, engine=Recording())
    assert built(after).checkpoint == worse.store.checkpoint_folder(10)
    earlier = Trial(tmp_path, engine=Recording(), changes=(change(4),))
    assert built(earlier).checkpoint == worse.store.checkpoint_folder(10)


def test_a_copy_counts_before_the_trials_own_checkpoint_of_the_same_iteration_which_stays(
    tmp_path: Path, better: TrialStore
) -> None:
    taken_over(tmp_path, better, iteration=10)
    after = Trial(tmp_path, engine=Recording(), changes=(change(10),))
    assert built(after).checkpoint == after.store.copied_checkpoint(10)
    assert 10 in after.kept


def test_a_trial_that_is_opened_again_before_it_saved_goes_on_from_the_copy_and_then_from_its_own(
    tmp_path: Path, better: TrialStore
) -> None:
    taken_over(tmp_path, better)
    # Scores so low that no checkpoint is the best.
    first = Trial(tmp_path, engine=Recording(), changes=(change(5),), scores=lambda i: -1.0)
    first.run_to(8)
    again = Trial(tmp_path, engine=Recording(), changes=(change(5),), scores=lambda i: -1.0)
    assert (built(again).checkpoint, again.loop.iteration) == (again.store.copied_checkpoint(5), 5)
    again.run_to(10)
    last = Trial(tmp_path, engine=Recording(), changes=(change(5),))
    assert built(last).checkpoint == last.store.checkpoint_folder(10)
    assert not last.store.copied_checkpoint(5).exists()


def test_a_pause_before_any_training_saves_nothing_with_the_score_of_other_weights(
    tmp_path: Path, better: TrialStore
) -> None:
    # Its own best is its first, so that it has no checkpoint of iteration 5.
    taken_over(tmp_path, better, scores=lambda iteration: -iteration)
    after = Trial(tmp_path, engine=Recording(), changes=(change(5),), scores=lambda iteration: -iteration)
    assert after.kept == [1]
    after.loop.pause()
    assert after.kept == [1]
    after.run_to(6)
    after.loop.pause()
    assert after.kept[-1] == 6


def test_the_training_return_is_of_the_new_weights_alone(tmp_path: Path, better: TrialStore) -> None:
    taken_over(tmp_path, better, episodes=lambda iteration: (500.0,))
    after = Trial(tmp_path, engine=FakeEngine(lambda iteration: (7.0, 9.0)), changes=(change(5),))
    assert after.run_to(6).training_return == 8.0
    # The same after it was opened again.
    after.loop.pause()
    again = Trial(tmp_path, engine=FakeEngine(lambda iteration: (7.0, 9.0)), changes=(change(5),))
    assert again.run_to(7).training_return == 8.0


def test_a_damaged_copy_is_set_aside_and_the_trial_goes_on_from_its_own_checkpoint(
    tmp_path: Path, better: TrialStore
) -> None:
    taken_over(tmp_path, better)
    (TrialStore(tmp_path, "t0000").copied_checkpoint(5) / "engine.json").write_text("{}")
    trial = Trial(tmp_path, engine=Recording(), changes=(change(5),))
    assert built(trial).checkpoint == trial.store.checkpoint_folder(5)
    assert trial.loop.iteration == 5
    assert (trial.store.folder / "damaged" / "copied-000005" / "engine.json").is_file()
    assert "the copied checkpoint 000005 is damaged" in trial.run_to(6).notes[0]


def test_of_a_copy_that_is_missing_a_note_is_kept(tmp_path: Path, better: TrialStore) -> None:
    taken_over(tmp_path, better)
    shutil.rmtree(TrialStore(tmp_path, "t0000").copied_checkpoint(5))
    trial = Trial(tmp_path, engine=Recording(), changes=(change(5),))
    assert built(trial).checkpoint == trial.store.checkpoint_folder(5)
    note = "the copied checkpoint 000005 is missing; the trial goes on from its own latest checkpoint, with the values "
    assert trial.run_to(6).notes == (f"{note}it was given.",)
    # From here on it needs none.
    assert Trial(tmp_path, engine=Recording(), changes=(change(5),)).run_to(7).notes == ()


def test_a_copy_is_on_disk_before_the_record_that_counts_on_it(
    tmp_path: Path, better: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = TrialStore(tmp_path, "t0000")
    done: list[str] = []
    replace = Path.replace

    def replacing(path: Path, target: Path) -> Path:
        done.append("its name is given")
        return replace(path, target)

    def syncing(descriptor: int) -> None:
        done.append(str(Path(f"/proc/self/fd/{descriptor}").readlink().relative_to(own.folder / "copied")))

    monkeypatch.setattr(Path, "replace", replacing)
    monkeypatch.setattr(os, "fsync", syncing)
    copy_latest_checkpoint(better, own, 5)
    copy = own.copied_checkpoint(5)
    files = {f".000005/{path.relative_to(copy)}" for path in copy.rglob("*")}
    *before, name, last = done
    assert set(before) == {*files, ".000005"}
    assert (name, last) == ("its name is given", ".")


def test_a_damaged_checkpoint_is_not_copied(tmp_path: Path, better: TrialStore) -> None:
    (tmp_path / better.checkpoints()[-1].path / "engine.json").write_text("{}")
    own = TrialStore(tmp_path, "t0000")
    with pytest.raises(CheckpointError, match=r"engine\.json"):
        copy_latest_checkpoint(better, own, 5)
    assert not own.copied_checkpoint(5).exists()


def test_a_checkpoint_that_is_deleted_while_it_is_copied_gives_way_to_the_newer_one(
    tmp_path: Path, better: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = better.checkpoints()
    real, calls = better.checkpoints, []

    def checkpoints() -> list[CheckpointRecord]:
        calls.append(1)
        gone = CheckpointRecord(trial_id="t0001", iteration=15, num_env_steps=1)
        return [gone] if len(calls) == 1 else real()

    monkeypatch.setattr(better, "checkpoints", checkpoints)
    assert copy_latest_checkpoint(better, TrialStore(tmp_path, "t0000"), 5) == known[-1]


def test_a_trial_without_a_checkpoint_cannot_be_copied(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="t0001 has no checkpoint"):
        copy_latest_checkpoint(TrialStore(tmp_path, "t0001"), TrialStore(tmp_path, "t0000"), 5)


# -- what a changed trial's record says


def changed_trial() -> TrialRecord:
    changes = (
        change(10, before={"lr": 0.1}, after={"lr": 0.2}),
        change(20, before={"lr": 0.2}, after={"lr": 0.3}, source_trial_id="t0002"),
    )
    best = CheckpointRecord(trial_id="t0000", iteration=15, num_env_steps=1500, evaluation_return=9.0)
    return TrialRecord(
        trial_id="t0000", index=0, point_index=0, seed=0, point={"lr": 0.3}, hyperparams={"lr": 0.3, "gamma": 0.9},
        changes=changes, checkpoints=(best,), status="completed",
    )  # fmt: skip


def test_a_change_acts_from_the_next_iteration_on() -> None:
    trial = changed_trial()
    values = {iteration: trial.point_at(iteration)["lr"] for iteration in (1, 10, 11, 20, 21, 99)}
    assert values == {1: 0.1, 10: 0.1, 11: 0.2, 20: 0.2, 21: 0.3, 99: 0.3}
    assert trial.first_hyperparams == {"lr": 0.1, "gamma": 0.9}


def test_a_score_stands_beside_the_values_it_was_reached_with() -> None:
    assert rank_points([changed_trial()])[0].point == {"lr": 0.2}
    row = trials_frame([changed_trial()]).iloc[0]
    assert row["lr"] == 0.2
    assert row["changes"] == "at 1,000 env steps from t0001: lr 0.2; at 2,000 env steps from t0002: lr 0.3"
    plain = changed_trial().model_copy(update={"changes": ()})
    assert "changes" not in trials_frame([plain]).columns


def test_copies_that_do_not_count_are_removed(tmp_path: Path, better: TrialStore) -> None:
    """A driver was killed while it copied, or before it wrote of what the trial goes on from."""
    taken_over(tmp_path, better)
    store = TrialStore(tmp_path, "t0000")
    for name in (".000007", "000007"):
        shutil.copytree(store.copied_checkpoint(5), store.folder / "copied" / name)
    remove_uncounted_copies(store, (change(5),))
    assert [path.name for path in (store.folder / "copied").iterdir()] == ["000005"]
    remove_uncounted_copies(store, ())
    assert not (store.folder / "copied").exists()
    remove_uncounted_copies(store, ())


def test_a_trial_that_goes_back_before_a_change_has_its_own_episodes(tmp_path: Path, better: TrialStore) -> None:
    """Its checkpoints since were damaged: what it goes on from are its own weights, from before."""
    taken_over(tmp_path, better, episodes=lambda iteration: (500.0,))
    task: dict[str, Any] = {"changes": (change(5),), "checkpoints": {"every_iterations": 10, "keep": 9}}
    after = Trial(tmp_path, engine=FakeEngine(lambda iteration: (7.0,)), **task)
    after.run_to(6)
    assert after.kept == [4, 5, 6]
    for iteration in (5, 6):
        (after.store.checkpoint_folder(iteration) / "engine.json").write_text("{}")
    again = Trial(tmp_path, engine=FakeEngine(lambda iteration: (7.0,)), **task)
    assert again.loop.iteration == 4
    assert again.run_to(5).training_return == (4 * 500.0 + 7.0) / 5
