"""A new sweep in an object store: who has made it and has its lock knows what is there, and asks for nothing."""

from collections.abc import Iterator

import pytest
from s3_faults import Faults, Opened
from store_parts import fill, make_best, make_checkpoint, make_iteration, make_sweep, make_trial

from policies.errors import CannotRunError, SpecError
from tune_jobs.store import names
from tune_jobs.store.contract import Assignment
from tune_jobs.store.objects.object_sweep import ObjectSweep
from tune_jobs.store.opening import others_write
from tune_jobs.store.record_files import dump


@pytest.fixture
def made(opened: Opened) -> ObjectSweep:
    sweep = opened()
    sweep.create()
    return sweep


@pytest.fixture
def driver(made: ObjectSweep, faults: Faults) -> Iterator[ObjectSweep]:
    """A new sweep that this process drives."""
    faults.clear()
    with made.lock():
        yield made


def test_it_is_driven_from_its_beginning_to_its_end_without_a_question(faults: Faults, driver: ObjectSweep) -> None:
    for index in range(2):
        driver.trial(f"t{index:04d}").write_record(make_trial(index), soon=True)
    driver.write_record(make_sweep())
    run = driver.take()
    driver.pack("p00").write(Assignment(("t0000",)))
    with run.held():
        assert len(driver.read_trials()) == 2
        assert driver.exists()
        assert not driver.has_best()
    # A second stage.
    driver.take()
    driver.pack("p00").write(Assignment(("t0001",)))
    driver.write_best(make_best())
    assert driver.read_best() == make_best()
    assert (driver.best_folder / names.BEST_RECORD).is_file()
    with driver.writing_films() as paths:
        for path in paths.values():
            path.write_bytes(b"film")
    assert len(driver.current_films()) == len(names.FILMS)
    with driver.writing_report() as folder:
        (folder / names.REPORT_PAGE).write_text("page")
    assert set(driver.report_files()) == {names.REPORT_PAGE}
    # The question who owns the run may be on its way, which nobody waits for.
    assert {one.key.rpartition("/")[2] for one in faults.requests if one.kind != "PUT"} <= {"run.json"}


def test_its_lock_is_taken_and_let_go_by_one_request_each(faults: Faults, made: ObjectSweep) -> None:
    faults.clear()
    with made.lock():
        assert faults.counts() == {"PUT": 1}
        faults.clear()
    assert faults.counts() == {"PUT": 1}


def test_what_others_have_is_there_too(driver: ObjectSweep, opened: Opened) -> None:
    driver.trial("t0000").write_record(make_trial())
    driver.write_record(make_sweep())
    driver.write_best(make_best())
    other = opened()
    assert [record.trial_id for record in other.read_trials()] == ["t0000"]
    assert other.read_record() == make_sweep()
    assert other.read_best() == make_best()


def test_another_process_that_was_first_to_drive_it_is_seen(made: ObjectSweep, opened: Opened) -> None:
    other = opened()
    with other.lock():
        with pytest.raises(CannotRunError, match="run by another process"), made.lock():
            pass
        other.write_record(make_sweep(state="completed"))
        other.trial("t0000").write_record(make_trial())
    with made.lock():
        assert made.read_record().state == "completed"
        assert len(made.read_trials()) == 1
        made.trial("t0000").write_record(make_trial(status="failed"))
    assert opened().trial("t0000").read_record().status == "failed"


def test_what_others_write_for_it_is_asked_for(driver: ObjectSweep) -> None:
    assert driver.read_trials() == []
    others_write(driver.place)
    # Not by a call of this process, which would know of it.
    driver._bucket.put("records/t0000.json", dump(make_trial()).encode())
    assert len(driver.read_trials()) == 1


def test_a_name_with_the_remains_of_another_sweep_is_taken_and_left_as_it_is(opened: Opened) -> None:
    sweep = opened()
    sweep._bucket.put("trials/t0000/log.txt", b"remains")
    with pytest.raises(SpecError, match="already in"):
        sweep.create()
    assert [item.key for item in sweep._bucket.listed()] == ["trials/t0000/log.txt"]


def test_the_heads_of_completed_trials_are_asked_for_once(faults: Faults, driver: ObjectSweep, opened: Opened) -> None:
    driver.write_record(make_sweep())
    for index, status in enumerate(("completed", "running", "failed")):
        driver.trial(f"t{index:04d}").write_record(make_trial(index, status=status))
        writer = opened().trial(f"t{index:04d}")
        writer.take()
        writer.append_iterations([make_iteration(1)])
        writer.settle()

    def asked() -> set[str]:
        faults.requests.clear()
        with driver.reading():
            assert [driver.trial(f"t{index:04d}").has_results() for index in range(3)] == [True] * 3
        return {one.key.split("/")[-2] for one in faults.requests if one.key.endswith("head.json")}

    assert asked() == {"t0000", "t0001", "t0002"}
    # Of one that runs or has failed, its process may have more to say.
    assert asked() == {"t0001", "t0002"}
    others_write(driver.place)
    assert asked() == {"t0000", "t0001", "t0002"}


def test_leftovers_of_all_trials_are_found_by_one_listing(faults: Faults, driver: ObjectSweep, opened: Opened) -> None:
    driver.write_record(make_sweep())
    for index in range(2):
        writer = opened().trial(f"t{index:04d}")
        writer.take()
        writer.append_iterations([make_iteration(1)])
        writer.write_checkpoint(make_checkpoint(1, trial_id=writer.trial_id), fill)
        writer.settle()
        driver.trial(writer.trial_id).write_record(make_trial(index, status="completed"))
    there = {item.key for item in driver._bucket.listed()}
    left = [
        "trials/t0000/results/0123456789abcdef.jsonl",
        "trials/t0001/checkpoints/000001-0123456789abcdef/policy.json",
    ]
    for key in [*left, "probe/a"]:
        driver._bucket.put(key, b"left")
    faults.clear()
    driver.remove_leftovers()
    assert faults.counts() == {"GET": 2, "LIST": 2, "POST": 1}
    assert {item.key for item in driver._bucket.listed()} == there
