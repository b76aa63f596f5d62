"""A race that is killed, stopped or asked for again goes on where it was."""

import shutil
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import kept_before_each_write, make_sweep_folder, train

from analysis.records import FINISHED, ReplicationRecord, TrialRecord
from policies.errors import SpecError
from tune_jobs.service import driver
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import stages
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.outcome import SweepResult

ROUNDS = [3, 2]
"""How many trainings the rounds of the race have: three settings, then two."""


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SweepStore:
    """A finished sweep of 4 settings; whatever is to be run of it afterwards is trained by a fake, in no time."""

    def run_trials(store: SweepStore, *_: object, **__: object) -> SweepResult:
        for trial in store.read_trials():
            if trial.status not in FINISHED:
                train(store, trial.trial_id, 6, scores=partial(score, trial))
        return SweepResult(store.place, store.read_record(), store.read_trials(), interrupted=False)

    monkeypatch.setattr(stages, "run_trials_of", run_trials)
    monkeypatch.setattr(stages, "finish_sweep", lambda store, result, *_, **__: result)
    return make_sweep_folder(tmp_path / "mine", num_samples=4, seeds_per_point=1)


def score(trial: TrialRecord, iteration: int) -> float:
    """What nobody can tell the settings apart by."""
    return 10.0 * ((trial.index + trial.point_index) % 3) + iteration


def race(folder: Path, **options: Any) -> list[TrialRecord]:
    keywords: dict[str, Any] = {"top": 3, "seeds": 2, "finish": False, "progress": "none"} | options
    return list(sweeps.replicate(folder, **keywords).trials)


def resume(folder: Path) -> list[TrialRecord]:
    return list(sweeps.resume(folder, finish=False, progress="none").trials)


def rounds(folder: Path) -> tuple[ReplicationRecord, ...]:
    return SweepStore(folder).read_record().replications


def seeds(trials: list[TrialRecord]) -> list[tuple[str, int, int, str]]:
    return [(trial.trial_id, trial.point_index, trial.seed, trial.status) for trial in trials]


def test_one_that_is_killed_between_any_two_files_goes_on_by_resume_and_by_the_same_call(
    store: SweepStore, tmp_path: Path
) -> None:
    with kept_before_each_write(store, tmp_path) as left:
        whole = race(store.folder)
    assert [len(item.points) for item in rounds(store.folder)] == ROUNDS
    begun = [folder for folder in left if rounds(folder)]
    assert {len(rounds(folder)) for folder in begun} == {1, 2}
    # With its first round written and not trained, with the first trained, and with all trained.
    for folder in (begun[0], [folder for folder in begun if len(rounds(folder)) == 1][-1], begun[-1]):
        copy = shutil.copytree(folder, folder.parent / "resumed" / folder.name)
        assert seeds(race(folder)) == seeds(whole)
        assert seeds(resume(copy)) == seeds(whole)
        assert rounds(folder) == rounds(copy) == rounds(store.folder)


def test_a_job_of_the_service_that_is_repeated_has_one_race(store: SweepStore, tmp_path: Path) -> None:
    def do(folder: Path) -> list[TrialRecord]:
        request = {
            "job": "j-7", "sweep": str(folder), "verb": "replicate", "arguments": {"top": 3, "seeds": 2},
            "address": None, "wait_for_nodes": 0.0, "num_cpus": 2.0,
        }  # fmt: skip
        return list(driver._done(request).trials)

    with kept_before_each_write(store, tmp_path) as left:
        whole = do(store.folder)
    for folder in [left[0], left[-1], store.folder]:
        assert seeds(do(folder)) == seeds(whole)
        assert [(item.race, len(item.points)) for item in rounds(folder)] == [("j-7", 3), ("j-7", 2)]


def test_what_is_asked_for_after_a_race_is_another_race(store: SweepStore) -> None:
    once = race(store.folder)
    assert seeds(resume(store.folder)) == seeds(once)
    twice = race(store.folder)
    assert seeds(twice)[: len(once)] == seeds(once)
    first, *_ = rounds(store.folder)
    assert [item.race for item in rounds(store.folder)][:3] == [first.race, first.race, "race-2"]
    assert len({trial.seed for trial in twice}) == len(twice)


def test_a_race_of_another_size_and_one_after_more_points_are_others(store: SweepStore, tmp_path: Path) -> None:
    with kept_before_each_write(store, tmp_path) as left:
        race(store.folder)
    begun = [folder for folder in left if len(rounds(folder)) == 1]
    race(begun[-1], top=2)
    assert [item.race for item in rounds(begun[-1])] == ["race-0", "race-1"]
    sweeps.extend(begun[0], 1, finish=False, progress="none")
    assert len(rounds(begun[0])) == 1
    race(begun[0])
    assert [item.race for item in rounds(begun[0])][:2] == ["race-0", "race-1"]


def test_no_setting_races_with_itself(store: SweepStore, tmp_path: Path) -> None:
    """Random search in a small space draws points again, which are settings of their own."""
    space = {"activation": {"choice": ["relu", "tanh"]}}
    few = make_sweep_folder(tmp_path / "few", space=space, num_samples=6, seeds_per_point=1)
    points = {trial.point_index: trial.point["activation"] for trial in few.read_trials()}
    assert len(points) == 6
    race(few.folder, top=5)
    contenders = {point for item in rounds(few.folder) for point in item.points}
    assert sorted(points[point] for point in contenders) == ["relu", "tanh"]
    same = make_sweep_folder(tmp_path / "same", space={"activation": {"choice": ["relu"]}}, num_samples=2)
    with pytest.raises(SpecError, match="has one setting that was trained"):
        race(same.folder)


def test_more_seeds_that_are_left_out_as_nothing_is_to_follow_the_trials_are_told(
    store: SweepStore, tmp_path: Path
) -> None:
    confirm = {"top": 2, "seeds": 1, "max_share": 1.0}
    folder = make_sweep_folder(tmp_path / "raced", num_samples=4, seeds_per_point=1, confirm=confirm).folder
    left_out = sweeps.resume(folder, finish=False, progress="none")
    assert len(left_out.trials) == 4
    (note,) = left_out.notes
    assert note.startswith("the 2 leading settings got no more seeds (confirm)")
    assert f"`tune-jobs resume {folder}` does both" in note
    assert len(sweeps.resume(folder, progress="none").trials) == 6
    several = make_sweep_folder(
        tmp_path / "several", num_samples=4, seeds_per_point=1, confirm=confirm | {"seeds": 2}
    ).folder
    (note,) = sweeps.resume(several, finish=False, progress="none").notes
    assert note.startswith("the 2 leading settings got no more seeds (confirm)")
    # It has had them.
    assert sweeps.resume(folder, finish=False, progress="none").notes == ()
    assert sweeps.resume(store.folder, finish=False, progress="none").notes == ()
