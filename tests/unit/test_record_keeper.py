"""The records of a run: told at once, on disk at once where it matters, and not more often than the disk allows."""

from pathlib import Path
from typing import Any

import pytest
from fake_engine import FakeClock
from store_parts import make_iteration

from analysis.records import CheckpointRecord, TrialRecord
from tune_jobs.store.ownership import Owner, OwnershipLostError
from tune_jobs.store.progress import Progress
from tune_jobs.store.record_keeper import RecordKeeper
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.transitions import with_point


@pytest.fixture
def kept(tmp_path: Path) -> tuple[SweepStore, RecordKeeper, FakeClock, list[Any]]:
    """(store, keeper, its clock, everything the listener was told) of 50 trials; the last was done before this run."""
    store, clock = SweepStore(tmp_path / "mine"), FakeClock()
    told: list[Any] = []
    store.create()
    for index in range(50):
        record = TrialRecord(trial_id=f"t{index:04d}", index=index, point_index=index, seed=index, point={})
        store.trial(record.trial_id).write_record(record)
    names = [record.trial_id for record in store.read_trials()][:49]
    return store, RecordKeeper(store, names, told.append, clock), clock, told


def progress(iteration: int = 1, *, evaluated: bool = True, status: str = "running", **changes: Any) -> Progress:
    values = {
        "num_env_steps": 100 * iteration, "num_episodes": iteration, "time_s": 1.0, "training_return": 5.0,
        "evaluation_return": 7.0, "best_evaluation_return": 7.0, "best_iteration": 1,
    } | changes  # fmt: skip
    return Progress(num_iterations=iteration, evaluated=evaluated, status=status, **values)


def on_disk(store: SweepStore, trial_id: str) -> TrialRecord:
    return store.trial(trial_id).read_record()


def test_what_a_trial_tells_is_in_its_record(kept: tuple[SweepStore, RecordKeeper, FakeClock, list[Any]]) -> None:
    store, keeper, _, told = kept
    checkpoint = CheckpointRecord(trial_id="t0003", iteration=4, num_env_steps=400)
    keeper.started("t0003")
    assert told[-1].status == "running"
    keeper.progressed(
        "t0003", progress(4, checkpoints=(checkpoint,), iterations=(make_iteration(4),)), node="here", pid=12
    )
    keeper.flush()
    record = on_disk(store, "t0003")
    assert record == keeper.record("t0003") == told[-1]
    assert (record.num_iterations, record.num_env_steps, record.checkpoints) == (4, 400, (checkpoint,))
    assert (record.node, record.pid, record.evaluation_return) == ("here", 12, 7.0)
    assert [one.trial_id for one in keeper.all_records()] == [f"t{index:04d}" for index in range(50)]
    assert list((store.trial("t0003").folder / "tensorboard").iterdir())


def test_running_trials_are_written_as_often_as_there_is_time_for_and_the_others_at_once(
    kept: tuple[SweepStore, RecordKeeper, FakeClock, list[Any]],
) -> None:
    store, keeper, clock, _ = kept
    names = [f"t{index:04d}" for index in range(49)]
    for name in names:
        keeper.started(name)
        keeper.progressed(name, progress(1), node="here", pid=1)
    keeper.progressed("t0048", progress(1, status="completed"), node="here", pid=1)
    keeper.flush()

    def written(iteration: int) -> list[str]:
        return [name for name in names if on_disk(store, name).num_iterations == iteration]

    # Twenty a second, and the one that has ended.
    assert written(1) == [*names[:20], "t0048"]
    clock.now += 0.5
    keeper.flush()
    keeper.flush()
    assert written(1) == [*names[:30], "t0048"]
    for name in names[:48]:
        keeper.progressed(name, progress(2), node="here", pid=1)
    clock.now += 1.0
    keeper.flush()
    # First those that were never written, then what was written longest ago.
    assert sorted(written(1)) == [*names[2:30], "t0048"]
    assert written(2) == [*names[:2], *names[30:48]]
    for name in names[:48]:
        keeper.progressed(name, progress(3), node="here", pid=1)
    clock.now += 100.0
    keeper.flush()
    # No more at once after a while without any.
    assert len(written(3)) == 20
    keeper.close()
    assert written(3) == names[:48]


def test_what_a_process_reads_is_on_disk_at_once(kept: tuple[SweepStore, RecordKeeper, FakeClock, list[Any]]) -> None:
    store, keeper, _, told = kept
    for index in range(40):
        keeper.change(f"t{index:04d}", lambda record: with_point(record, {"lr": 0.1}, {}))
        assert on_disk(store, f"t{index:04d}").point == {"lr": 0.1}
    assert len(told) == 40


@pytest.mark.parametrize(
    "error", ["\udcff in an env's error", "a terminal's \x1b[2J", "x" * 3_000_000], ids=["text", "control", "long"]
)
def test_whatever_made_a_trial_fail_can_be_written(
    kept: tuple[SweepStore, RecordKeeper, FakeClock, list[Any]], error: str
) -> None:
    store, keeper, _, told = kept
    keeper.started("t0001")
    keeper.failed("t0001", error, retried=False)
    keeper.flush()
    assert on_disk(store, "t0001") == told[-1]
    assert len(told[-1].error) < 21_000


def test_how_trials_end(kept: tuple[SweepStore, RecordKeeper, FakeClock, list[Any]]) -> None:
    store, keeper, _, _ = kept
    for index in range(5):
        keeper.started(f"t000{index}")
    assert keeper.running == {f"t000{index}" for index in range(5)}
    keeper.progressed("t0000", progress(3, status="completed", stop_reason="time_s 3 >= 3"), node="here", pid=1)
    keeper.ended("t0000")
    keeper.failed("t0001", "it broke", retried=True)
    keeper.failed("t0002", "it broke", retried=False)
    keeper.progressed("t0003", progress(3), node="here", pid=1)
    keeper.ended("t0003")
    store.request_stop()
    keeper.ended("t0004")
    assert keeper.running == set()
    keeper.flush()
    told = [(one.status, one.stop_reason, one.error, one.num_failures) for one in store.read_trials()[:5]]
    assert told == [
        ("completed", "time_s 3 >= 3", None, 0),
        ("pending", None, "it broke", 1),
        ("failed", None, "it broke", 1),
        ("stopped", "scheduler, at 300 env steps", None, 0),
        ("paused", None, None, 0),
    ]
    keeper.started("t0001")
    assert (keeper.record("t0001").error, keeper.record("t0001").num_failures) == (None, 1)


def test_who_lost_the_run_writes_no_record(tmp_path: Path) -> None:
    """A driver that was stopped for so long that another one took the sweep up."""
    store = SweepStore(tmp_path / "mine")
    store.create()
    record = TrialRecord(trial_id="t0000", index=0, point_index=0, seed=1, point={})
    store.trial("t0000").write_record(record)
    run = Owner.take(store.folder / ".owner")
    keeper = RecordKeeper(store, ["t0000"], lambda record: None, run=run)
    keeper.started("t0000")
    keeper.flush()
    assert on_disk(store, "t0000").status == "running"
    Owner.take(store.folder / ".owner")
    keeper.progressed("t0000", progress(status="failed", error="it is not for it to say"), node="here", pid=1)
    for write in (
        keeper.flush,
        keeper.close,
        lambda: keeper.change("t0000", lambda record: with_point(record, {"lr": 1.0}, {})),
    ):
        with pytest.raises(OwnershipLostError):
            write()
    assert on_disk(store, "t0000").status == "running"
    assert on_disk(store, "t0000").point == {}
    assert not (store.trial("t0000").folder / "tensorboard").exists()


def test_a_trial_that_another_process_has_is_paused_and_has_not_failed(
    kept: tuple[SweepStore, RecordKeeper, FakeClock, list[Any]],
) -> None:
    store, keeper, _, _ = kept
    keeper.started("t0003")
    keeper.lost("t0003")
    keeper.flush()
    record = on_disk(store, "t0003")
    assert (record.status, record.num_failures, record.error) == ("paused", 0, None)
    assert keeper.running == set()


def test_what_was_damaged_stays_in_the_record(kept: tuple[SweepStore, RecordKeeper, FakeClock, list[Any]]) -> None:
    store, keeper, _, _ = kept
    keeper.progressed("t0003", progress(1, notes=("a", "b")), node="here", pid=1)
    keeper.progressed("t0003", progress(2, notes=("b", "c"), status="completed"), node="here", pid=1)
    keeper.flush()
    assert on_disk(store, "t0003").notes == ("a", "b", "c")
