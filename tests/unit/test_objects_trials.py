"""A trial that trains, in an object store: what is there for others at the moment that they hear of it."""

import dataclasses
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, cast

import pytest
from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task
from store_parts import fill, make_checkpoint, make_sweep, make_trial
from stores import ObjectHarness

from policies.acting.evaluate import Evaluator
from tune_jobs.store.contract import Sweep
from tune_jobs.store.objects.outbox import Outbox
from tune_jobs.store.opening import open_sweep
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


def opened(sweep: Sweep, tmp_path: Path, **task: Any) -> TrialLoop:
    chosen = dataclasses.replace(make_task(tmp_path, **task), sweep_place=sweep.place)
    loop = TrialLoop(chosen, FakeEngine(), cast("Evaluator", FakeEvaluator()), FakeClock(step=0.1))
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
