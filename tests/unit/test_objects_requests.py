"""How many requests a sweep in an object store takes, and which of them wait for each other."""

import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import cast

import pytest
from fake_pack import Pack, statuses
from s3_faults import Faults, Opened, iterations
from store_parts import fill, make_checkpoint, make_iteration, make_sweep, make_trial

from analysis.records import CheckpointRecord
from tune_jobs.service.statuses import Statuses
from tune_jobs.store import names
from tune_jobs.store.objects import clients, lease, owners, result_chunks
from tune_jobs.store.objects.bucket import Found
from tune_jobs.store.objects.head import read_head
from tune_jobs.store.objects.held import Held
from tune_jobs.store.objects.object_storage import ObjectStorage
from tune_jobs.store.objects.object_sweep import ObjectSweep
from tune_jobs.store.objects.object_trial import ObjectTrial
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.opening import others_write
from tune_jobs.sweeps.attach import _Look
from tune_jobs.sweeps.status import list_sweeps

NUM_TRIALS = 3


@pytest.fixture
def sweep(opened: Opened, faults: Faults) -> ObjectSweep:
    """Trials with a checkpoint each, opened by a reader."""
    made = opened()
    for index in range(NUM_TRIALS):
        trial = made.trial(f"t{index:04d}")
        trial.write_record(make_trial(index))
        trial.take()
        trial.append_iterations([make_iteration(1)])
        trial.write_checkpoint(make_checkpoint(1, trial_id=trial.trial_id), fill)
        trial.settle()
    faults.clear()
    return opened()


def _checkpoints() -> list[CheckpointRecord]:
    return [make_checkpoint(1, trial_id=f"t{index:04d}") for index in range(NUM_TRIALS)]


def test_records_that_have_not_changed_are_not_fetched_again(
    faults: Faults, opened: Opened, sweep: ObjectSweep
) -> None:
    assert len(sweep.read_trials()) == NUM_TRIALS
    assert faults.counts() == {"GET": NUM_TRIALS, "LIST": 1}
    faults.clear()
    assert len(sweep.read_trials()) == NUM_TRIALS
    assert faults.counts() == {"LIST": 1}
    opened().trial("t0001").write_record(make_trial(1, status="failed"))
    faults.clear()
    assert [record.status for record in sweep.read_trials()] == ["pending", "failed", "pending"]
    assert faults.counts() == {"GET": 1, "LIST": 1}


def test_all_sweeps_of_a_bucket_share_their_connections(url: ObjectUrl, monkeypatch: pytest.MonkeyPatch) -> None:
    made, open_one = list[bool](), clients._open

    def counted(place: ObjectUrl, *, now: bool) -> object:
        made.append(now)
        return open_one(place, now=now)

    monkeypatch.setattr(clients, "_open", counted)
    for number in (*range(2 * clients._MAX_CLIENTS), 0):
        assert not ObjectSweep(url.child(str(number))).exists()
    assert made == [False]


def test_a_service_looks_at_all_sweeps_of_a_list_side_by_side(faults: Faults, url: ObjectUrl) -> None:
    storage, wanted = ObjectStorage(url), [f"s{index}" for index in range(NUM_TRIALS)]
    for name in wanted:
        storage.sweep(name).write_record(make_sweep(name=name, state="completed"))
    statuses = Statuses(storage)
    for _ in range(2):
        # At first, and when each is known.
        all_came = threading.Barrier(NUM_TRIALS, timeout=30)
        faults.rule("slow", kinds="GET", keys="/driver-lock.json$", times=NUM_TRIALS, then=all_came.wait)
        assert [seen.name for seen in statuses.all()] == wanted
        assert not all_came.broken


def test_sweeps_are_listed_side_by_side(faults: Faults, url: ObjectUrl, caplog: pytest.LogCaptureFixture) -> None:
    storage, wanted = ObjectStorage(url), [f"s{index}" for index in range(NUM_TRIALS)]
    for name in wanted:
        storage.sweep(name).write_record(make_sweep(name=name, state="completed"))
    all_came = threading.Barrier(NUM_TRIALS, timeout=30)
    faults.rule("slow", kinds="GET", keys="/driver-lock.json$", times=NUM_TRIALS, then=all_came.wait)
    assert [seen.sweep.name for seen in list_sweeps(storage.place)] == wanted
    assert not all_came.broken
    # One that is damaged is told, and the others are listed.
    storage.sweep("s1")._bucket.put(names.SWEEP_RECORD, b"half a record")
    assert [seen.sweep.name for seen in list_sweeps(storage.place)] == ["s0", "s2"]
    assert "Left out: " in caplog.text


def test_records_that_were_written_since_are_read_side_by_side(
    faults: Faults, opened: Opened, url: ObjectUrl, sweep: ObjectSweep
) -> None:
    writer, all_came = opened(), threading.Barrier(NUM_TRIALS, timeout=30)
    writer.write_record(make_sweep(state="interrupted"))
    statuses, look = Statuses(ObjectStorage(url.parent)), _Look(sweep)

    def wait_for_all() -> None:
        faults.rule("slow", kinds="GET", keys="/records/", times=NUM_TRIALS, then=all_came.wait)

    wait_for_all()
    assert statuses.see(url.name).status.counts == {"pending": NUM_TRIALS}
    for index in range(NUM_TRIALS):
        writer.trial(f"t{index:04d}").write_record(make_trial(index, status="completed"))
    writer._bucket.put("records/t0001.json", b"half a record")
    # Of a sweep whose own record is as it was, the status of a moment ago would do.
    writer.write_record(make_sweep(state="completed"))
    wait_for_all()
    assert statuses.see(url.name).status.counts == {"completed": NUM_TRIALS - 1}
    # Whoever attaches to it, too, has the others of one that is damaged.
    wait_for_all()
    look.update()
    assert look.monitor.counts() == {"completed": NUM_TRIALS - 1, "pending": 1}
    assert not all_came.broken


def test_records_that_this_process_has_written_are_not_fetched(faults: Faults, sweep: ObjectSweep) -> None:
    for index in range(NUM_TRIALS):
        sweep.trial(f"t{index:04d}").write_record(make_trial(index, status="completed"))
    faults.clear()
    assert {record.status for record in sweep.read_trials()} == {"completed"}
    assert faults.counts() == {"LIST": 1}


@pytest.fixture
def long_results(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> tuple[ObjectTrial, ObjectTrial]:
    """A trial with results in several objects, as its owner and a reader of all of them have it."""
    monkeypatch.setattr(result_chunks, "_SMALL_BYTES", 1)
    trial, reader = opened().trial("t0000"), opened().trial("t0000")
    trial.take()
    for number in (1, 2, 3):
        append(trial, number)
    assert numbers(reader) == [1, 2, 3]
    return trial, reader


def append(trial: ObjectTrial, number: int) -> None:
    trial.append_iterations([make_iteration(number)])
    trial.settle()


def numbers(trial: ObjectTrial) -> list[int]:
    return [record.iteration for record in trial.read_results().records]


def test_a_reader_of_long_results_reads_what_is_new_alone(
    faults: Faults, long_results: tuple[ObjectTrial, ObjectTrial]
) -> None:
    trial, reader = long_results
    append(trial, 4)
    shutil.rmtree(reader._state.folder() / "chunks")
    faults.clear()
    assert numbers(reader) == [1, 2, 3, 4]
    # The head, and the newest of the objects that it names.
    assert faults.counts() == {"GET": 2}
    # Where its file is gone, it is made again.
    shutil.rmtree(reader._state.folder())
    assert numbers(reader) == [1, 2, 3, 4]


def test_long_results_are_not_looked_through_to_upload_their_end(
    opened: Opened, long_results: tuple[ObjectTrial, ObjectTrial]
) -> None:
    trial, reader = long_results
    shutil.rmtree(trial._state.folder() / "chunks")
    append(trial, 4)
    head, _ = read_head(opened()._bucket, "trials/t0000/head.json")
    assert len(head.results) == 4
    assert numbers(reader) == iterations(opened) == [1, 2, 3, 4]


def test_checkpoints_that_are_read_are_fetched_once_and_all_at_once(faults: Faults, sweep: ObjectSweep) -> None:
    # Each of these requests is answered when all of them have come.
    all_came = threading.Barrier(NUM_TRIALS, timeout=30)
    faults.rule("slow", kinds="LIST", keys="/checkpoints/", times=NUM_TRIALS, then=all_came.wait)
    with sweep.reading(results=False, checkpoints=_checkpoints()):
        faults.requests.clear()
        for record in _checkpoints():
            sweep.trial(record.trial_id).verify_checkpoint(1)
            assert sweep.checkpoint_folder(record).is_dir()
    assert faults.counts() == {}
    assert not all_came.broken


def test_files_of_one_checkpoint_are_uploaded_side_by_side(faults: Faults, opened: Opened) -> None:
    trial = opened().trial("t0000")
    trial.take()
    both_came = threading.Barrier(2, timeout=30)
    faults.rule("slow", kinds="PUT", keys="/(weights|policy.safetensors)$", times=2, then=both_came.wait)
    trial.write_checkpoint(make_checkpoint(1), fill)
    trial.settle()
    assert not both_came.broken


def test_members_of_a_pack_are_opened_side_by_side(faults: Faults, opened: Opened) -> None:
    all_came = threading.Barrier(NUM_TRIALS, timeout=30)
    faults.rule("slow", kinds="GET", keys="/head.json$", times=NUM_TRIALS, then=all_came.wait)
    pack = Pack(cast("Path", opened().place), stop={"num_iterations": 1}).add("t0000", "t0001", "t0002").run()
    assert not all_came.broken
    assert pack.engine.builds == [("t0000", None), ("t0001", None), ("t0002", None)]
    assert set(statuses(pack).values()) == {"completed"}
    assert [len(opened().trial(name).read_iterations()) for name in ("t0000", "t0001", "t0002")] == [1, 1, 1]


def test_who_checks_side_by_side_waits_for_one_answer(faults: Faults, opened: Opened) -> None:
    run = opened().take()
    all_came = threading.Barrier(NUM_TRIALS, timeout=30)
    faults.rule("slow", kinds="GET", keys="/run.json$", times=NUM_TRIALS, then=all_came.wait)
    with ThreadPoolExecutor(NUM_TRIALS) as pool:
        list(pool.map(lambda _: run.check(), range(NUM_TRIALS)))
    assert not all_came.broken


def test_a_report_is_uploaded_side_by_side_and_not_fetched_where_it_was_made(faults: Faults, opened: Opened) -> None:
    sweep = opened()
    sweep.create()
    figures = ["figures/a.svg", "figures/b.svg", "figures/c.svg"]
    all_came = threading.Barrier(len(figures), timeout=30)
    faults.rule("slow", kinds="PUT", keys="/figures/", times=len(figures), then=all_came.wait)
    with sweep.writing_report() as folder:
        for name in [*figures, names.REPORT_PAGE]:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(name)
    assert not all_came.broken
    assert faults.requests[-1].key.endswith(names.REPORT_PAGE)
    faults.clear()
    assert {name: path.read_text() for name, path in sweep.report_files().items()} == {
        name: name for name in [*figures, names.REPORT_PAGE]
    }
    assert faults.counts() == {"LIST": 1}


def test_who_writes_often_does_not_wait_for_the_question_who_owns_it(
    faults: Faults, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, answered = opened().take(), threading.Event()
    monkeypatch.setattr(owners, "_LOOK_EVERY_S", 1e-9)
    monkeypatch.setattr(owners, "_BELIEVED", 1e12)
    with run.held():
        pass
    other = opened()
    faults.rule("slow", kinds="GET", keys="run.json$", then=lambda: answered.wait(30))
    with run.held():
        # The answer is on its way.
        answered.set()
    other.take()
    for _ in range(1000):
        if not run.is_current():
            return
        threading.Event().wait(0.01)
    pytest.fail("The run does not learn that another one has taken over.")


def test_who_holds_the_lock_asks_for_nothing_that_it_has_read_or_written(faults: Faults, opened: Opened) -> None:
    driver = opened()
    with driver.lock():
        driver.write_record(make_sweep(state="interrupted"))
        # The same process opens it again for its trials.
        again, run = opened(), driver.take()
        owner = again.owner(run.token)
        assert [record.trial_id for record in again.read_trials()] == []
        faults.clear()
        for index in range(2):
            again.trial(f"t{index:04d}").write_record(make_trial(index), soon=True)
        again.settle()
        driver.write_record(driver.read_record().model_copy(update={"state": "running"}))
        for sweep in (driver, again):
            assert sweep.read_record().state == "running"
            assert [record.trial_id for record in sweep.read_trials()] == ["t0000", "t0001"]
            assert set(sweep.trial_stamps()) == {"t0000", "t0001"}
        # What was not there before is looked for, and so is whether the run is still this process's.
        asked = [one.key.rpartition("/")[2] for one in faults.requests if one.kind != "PUT"]
        assert sorted(name for name in asked if name != "run.json") == ["t0000.json", "t0001.json"]
        assert faults.counts()["PUT"] == 3
        faults.clear()
        with owner.held():
            pass
        assert again.read_record() == driver.read_record()
        assert "LIST" not in faults.counts()
        assert {one.key.rpartition("/")[2] for one in faults.requests} <= {"run.json"}
    faults.clear()
    driver.read_record()
    assert len(driver.read_trials()) == 2
    assert faults.counts()["GET"] >= 1
    assert faults.counts()["LIST"] == 1


def test_who_holds_the_lock_asks_again_when_another_process_writes_for_it(faults: Faults, opened: Opened) -> None:
    driver = opened()
    with driver.lock():
        driver.write_record(make_sweep())
        assert driver.read_trials() == []
        others_write(driver.place)
        faults.clear()
        assert driver.read_record().num_trials == 2
        assert driver.read_trials() == []
        assert faults.counts() == {"GET": 1, "LIST": 1}


def test_who_is_not_sure_of_the_lock_asks(faults: Faults, opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = opened()
    monkeypatch.setattr(lease, "_BEAT_S", 1000.0)
    with driver.lock():
        driver.write_record(make_sweep())
        run = driver.take()
        with run.held():
            pass
        # Its latest sign of life is old, so that another process may have the lock by now.
        now = lease._now()
        monkeypatch.setattr(lease, "_now", lambda: now + lease.LEASE_S / 2)
        monkeypatch.setattr(owners, "_LOOK_EVERY_S", 1e-9)
        faults.clear()
        driver.read_record()
        with run.held():
            pass
        assert {one.key.rpartition("/")[2] for one in faults.requests} == {"sweep.json", "run.json"}


def test_who_holds_the_lock_does_not_wait_for_the_question_who_owns_the_run(faults: Faults, opened: Opened) -> None:
    driver, went_on = opened(), threading.Event()
    with driver.lock():
        run = driver.take()
        faults.rule("slow", kinds="GET", keys="run.json$", then=lambda: went_on.wait(5))
        begun = time.monotonic()
        with run.held():
            assert time.monotonic() < begun + 4
        went_on.set()
        # Whoever takes the run without the lock is seen all the same, a moment later.
        opened().take()
        while run.is_current():
            assert time.monotonic() < begun + 10
            time.sleep(0.01)


def test_what_was_on_its_way_while_it_was_written_is_not_believed() -> None:
    known = Held(lambda: True)
    mark = known.mark()
    write = known.begin("records/t0000.json")
    assert known.mark() is None
    known.end(write, b"new", ("new", None))
    known.note("records/t0000.json", Found(b"old", ("old", None)), mark)
    known.note_listed("records/", {}, mark)
    assert known.found("records/t0000.json") == Found(b"new", ("new", None))
    assert known.listed("records/") is None
    known.note_listed("records/", {}, known.mark())
    # Of two writes at once, the store alone knows which came last.
    first, second = known.begin("records/t0000.json"), known.begin("records/t0000.json")
    known.end(second, b"two", ("two", None))
    known.end(first, b"one", ("one", None))
    assert known.listed("records/") is None
    known.end(known.begin("sweep.json"), b"text", None)
    assert known.found("sweep.json") is None
