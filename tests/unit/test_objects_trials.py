"""A trial that trains, in an object store: what is there for others at the moment that they hear of it."""

import dataclasses
import functools
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, cast

import pytest
from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task
from store_parts import fill, make_checkpoint, make_sweep, make_trial
from stores import ObjectHarness

from analysis.records import ChangeRecord
from policies.acting.evaluate import Evaluator
from tune_jobs.store.contract import Sweep
from tune_jobs.store.copies import copy_latest_checkpoint
from tune_jobs.store.objects.bucket import StorageError
from tune_jobs.store.objects.copy_objects import CopyObjects
from tune_jobs.store.objects.outbox import Outbox
from tune_jobs.store.opening import open_sweep
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.training.trial_loop import TrialLoop

ONCE_AN_HOUR: dict[str, Any] = {"evaluation": {"every_iterations": 50}, "checkpoints": {"every_iterations": 50}}


@pytest.fixture
def sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sweep:
    """Nothing is uploaded before somebody waits for it."""
    made = ObjectHarness(tmp_path).storage().sweep("mine")
    made.create()
    made.write_record(make_sweep())
    made.trial("t0000").write_record(make_trial())
    add = Outbox.add

    def later(self: Outbox, key: Hashable, do: Callable[[], None], *, after_s: float = 0.0) -> None:
        add(self, key, do, after_s=after_s + 3_600.0)

    monkeypatch.setattr(Outbox, "add", later)
    return made


def opened(
    sweep: Sweep, tmp_path: Path, trial_id: str = "t0000", engine: FakeEngine | None = None, **task: Any
) -> TrialLoop:
    chosen = dataclasses.replace(make_task(tmp_path, **task), sweep_place=sweep.place, trial_id=trial_id)
    loop = TrialLoop(chosen, engine or FakeEngine(), cast("Evaluator", FakeEvaluator()), FakeClock(step=0.1))
    loop.open()
    return loop


def there(sweep: Sweep) -> tuple[list[int], list[int]]:
    """The checkpoints and the results that another machine sees."""
    trial = open_sweep(sweep.place).trial("t0000")
    return trial.checkpoint_iterations(), [record.iteration for record in trial.read_iterations()]


def test_what_is_saved_because_this_process_ends_is_there_for_the_next(sweep: Sweep, tmp_path: Path) -> None:
    loop = opened(sweep, tmp_path, **ONCE_AN_HOUR)
    loop.advance(-1.0)
    assert there(sweep) == ([], [])
    loop.pause()
    assert there(sweep) == ([1], [1])


def test_a_trial_is_said_to_have_ended_once_all_of_it_is_there(sweep: Sweep, tmp_path: Path) -> None:
    loop = opened(sweep, tmp_path, stop={"num_iterations": 2}, **ONCE_AN_HOUR)
    while (progress := loop.advance(-1.0)).status == "running":
        pass
    assert progress.status == "completed"
    assert there(sweep) == ([2], [1, 2])


def test_a_damaged_copy_is_kept_with_its_folders(tmp_path: Path) -> None:
    harness = ObjectHarness(tmp_path)
    made = harness.storage().sweep("mine")
    made.create()
    other, trial = made.trial("t0001"), made.trial("t0000")
    other.write_checkpoint(make_checkpoint(4, trial_id="t0001"), fill)
    trial.copy_checkpoint(other.checkpoint_folder(4), 7)
    copied = {key for key in harness.keys("mine") if "/copied/" in key}
    assert any(key.endswith("/state/weights") for key in copied)
    assert trial.set_aside(trial.copied_checkpoint(7), prefix="copied-") == "damaged/copied-000007"
    kept = {key.replace("/copied/000007/", "/damaged/copied-000007/") for key in copied}
    assert {key for key in harness.keys("mine") if "/t0000/" in key and "/damaged/" in key} == kept
    assert not trial.copied_checkpoint(7).exists()


def advanced(loop: TrialLoop, iteration: int) -> TrialLoop:
    while loop.iteration < iteration:
        loop.advance(-1.0)
    return loop


def copies(sweep: Sweep, *iterations: int) -> list[bool]:
    """Whether another machine sees the copies of some iterations."""
    trial = open_sweep(sweep.place).trial("t0000")
    return [trial.copied_checkpoint(iteration).exists() for iteration in iterations]


def test_a_trial_that_is_killed_before_its_checkpoint_is_there_goes_on_from_the_copy_again(
    sweep: Sweep, tmp_path: Path
) -> None:
    often: dict[str, Any] = {"evaluation": {"every_iterations": 5}, "checkpoints": {"every_iterations": 5}}
    advanced(opened(sweep, tmp_path, "t0001", **often), 20).pause()
    advanced(opened(sweep, tmp_path, **often), 5).pause()
    copy_latest_checkpoint(sweep.trial("t0001"), sweep.trial("t0000"), 5)
    often["changes"] = (
        ChangeRecord(iteration=5, num_env_steps=500, source_trial_id="t0001", source_iteration=20, before={}, after={},
                     time=0.0),
    )  # fmt: skip
    # Saved at 10, which nobody else sees before it is uploaded.
    killed = advanced(opened(sweep, tmp_path, **often), 10)
    engine = FakeEngine()
    again = opened(sweep, tmp_path, engine=engine, **often)
    assert (again.iteration, engine.iteration) == (5, 20)
    advanced(again, 10).pause()
    assert copies(sweep, 5) == [False]
    assert (opened(sweep, tmp_path, engine=engine, **often).iteration, engine.iteration) == (10, 25)
    with pytest.raises(OwnershipLostError):
        killed.pause()


def test_who_trains_a_trial_removes_the_copies_from_before_its_latest_checkpoint_there(
    sweep: Sweep, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, trial, driver = sweep.trial("t0001"), open_sweep(sweep.place).trial("t0000"), sweep.trial("t0000")
    trial.take()
    other.write_checkpoint(make_checkpoint(20, trial_id="t0001"), fill)
    for iteration in (3, 4, 5, 6):
        driver.copy_checkpoint(other.checkpoint_folder(20), iteration)
    assert trial.copied_checkpoint(4).exists()
    remove, calls = CopyObjects.remove, list[int]()

    def fails_once(self: CopyObjects, *args: Any) -> None:
        calls.append(1)
        if len(calls) == 1:
            raise StorageError("It is away.", passes=True)
        remove(self, *args)

    monkeypatch.setattr(CopyObjects, "remove", fails_once)
    trial.write_checkpoint(make_checkpoint(5), fill)
    trial.remove_copies(keep=[3])
    assert copies(sweep, 3, 4, 5, 6) == [True, True, True, True]
    trial.settle()
    assert copies(sweep, 3, 4, 5, 6) == [True, False, True, True]
    assert not trial.copied_checkpoint(4).exists()
    # What was asked for once is not done with every head.
    trial.write_checkpoint(make_checkpoint(7), fill)
    trial.settle()
    assert (copies(sweep, 6), len(calls)) == ([True], 2)


def test_a_driver_keeps_nothing_of_the_checkpoints_that_it_has_copied(tmp_path: Path) -> None:
    harness = ObjectHarness(tmp_path)
    source, driver = harness.storage().sweep("mine").trial("t0001"), harness.storage().sweep("mine")
    source.take()
    for number in range(1, 4):
        source.write_checkpoint(make_checkpoint(number, trial_id="t0001"), functools.partial(fill, content=str(number)))
        if number > 1:
            source.delete_checkpoint(make_checkpoint(number - 1, trial_id="t0001"))
        source.settle()
        for iteration in (number, number + 10):
            copied = copy_latest_checkpoint(driver.trial("t0001"), driver.trial("t0000"), iteration)
            assert copied.iteration == number
    # What it has asked for otherwise stays, whatever is copied.
    folder = driver.trial("t0001").checkpoint_folder(3)
    copy_latest_checkpoint(driver.trial("t0001"), driver.trial("t0000"), 20)
    trial = harness.storage().sweep("mine").trial("t0000")
    contents = [(trial.copied_checkpoint(n) / "state" / "weights").read_text() for n in (1, 11, 2, 12, 3, 13, 20)]
    assert contents == ["1", "1", "2", "2", "3", "3", "3"]
    assert list(folder.parents[5].rglob("weights")) == [folder / "state" / "weights"]
