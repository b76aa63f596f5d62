"""Reading much of a sweep in an object store: fetched at once, asked for once, and anew the next time."""

import pytest
from store_parts import fill, make_checkpoint, make_iteration, make_sweep, make_trial
from stores import ObjectHarness, object_harness  # noqa: F401 (a fixture)

from tune_jobs.store.candidates import read_results, read_trials
from tune_jobs.store.contract import Sweep
from tune_jobs.store.objects.bucket import Bucket, Found

NUM_TRIALS = 3


@pytest.fixture
def sweep(harness: ObjectHarness) -> Sweep:
    """Trials with results and a checkpoint each, opened anew by a reader."""
    made = harness.storage().sweep("mine")
    made.create()
    made.write_record(make_sweep(num_trials=NUM_TRIALS, spec={"seeds_per_point": 1}))
    for index in range(NUM_TRIALS):
        trial = made.trial(f"t{index:04d}")
        trial.write_record(make_trial(index))
        trial.append_iterations([make_iteration(1, evaluation_return=2.0)])
        trial.write_checkpoint(make_checkpoint(1, trial_id=trial.trial_id, evaluation_return=2.0), fill)
    return harness.storage().sweep("mine")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The keys that are asked for."""
    keys: list[str] = []
    get = Bucket.get

    def noting(bucket: Bucket, key: str) -> Found | None:
        keys.append(key)
        return get(bucket, key)

    monkeypatch.setattr(Bucket, "get", noting)
    return keys


def test_what_is_read_in_a_block_is_asked_for_once(sweep: Sweep, asked: list[str]) -> None:
    with sweep.reading():
        for _ in range(2):
            trials, results = read_trials(sweep), read_results(sweep)
    assert [len(trial.checkpoints) for trial in trials] == [1] * NUM_TRIALS
    assert [len(found) for found in results.values()] == [1] * NUM_TRIALS
    assert sorted(set(asked)) == sorted(asked)


def test_records_alone_are_fetched_alone(sweep: Sweep, asked: list[str]) -> None:
    with sweep.reading(results=False):
        pass
    assert sorted(asked) == [f"records/t{index:04d}.json" for index in range(NUM_TRIALS)]


def test_the_next_block_sees_what_was_written_since(harness: ObjectHarness, sweep: Sweep) -> None:
    with sweep.reading():
        assert [len(found) for found in read_results(sweep).values()] == [1] * NUM_TRIALS
    writer = harness.storage().sweep("mine").trial("t0001")
    writer.append_iterations([make_iteration(2)])
    writer.settle()
    writer.write_record(make_trial(1, status="failed"))
    assert [len(found) for found in read_results(sweep).values()] == [1, 2, 1]
    assert read_trials(sweep)[1].status == "failed"


def test_what_this_process_writes_in_a_block_is_what_it_reads(sweep: Sweep) -> None:
    with sweep.reading():
        trial = sweep.trial("t0002")
        trial.write_record(make_trial(2, status="completed"))
        trial.append_iterations([make_iteration(2)])
        assert trial.read_record().status == "completed"
        assert len(trial.read_iterations()) == 2
