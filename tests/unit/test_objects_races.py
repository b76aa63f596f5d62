"""What processes that write and read one trial in an object store at once do to each other: nothing."""

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import pytest
from s3_faults import Faults, Opened, iterations
from store_parts import fill, make_checkpoint, make_iteration, make_trial

from policies.errors import CheckpointError
from tune_jobs.store.objects import result_chunks
from tune_jobs.store.objects.bucket import Bucket, Tag
from tune_jobs.store.objects.outbox import outbox
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.pack_contract import Assignment


def test_an_owner_before_writes_nothing_with_its_upload_in_flight(faults: Faults, opened: Opened) -> None:
    trial, heir = opened().trial("t0000"), opened().trial("t0000")
    trial.take()
    # Its files are there; when it is about to write the head, another one takes the trial.
    faults.rule("slow", kinds="PUT", keys="/weights$", then=heir.take)
    trial.append_iterations([make_iteration(1)])
    trial.write_checkpoint(make_checkpoint(1), fill)
    with pytest.raises(OwnershipLostError, match="t0000 has been taken over"):
        trial.settle()
    heir.append_iterations([make_iteration(5)])
    heir.settle()
    assert iterations(opened) == [5]
    assert opened().trial("t0000").checkpoint_iterations() == []
    with pytest.raises(OwnershipLostError):
        trial.append_iterations([make_iteration(2)])


def test_a_checkpoint_that_is_replaced_while_it_is_uploaded_is_never_half_of_each(
    faults: Faults, opened: Opened
) -> None:
    trial = opened().trial("t0000")
    trial.take()
    seen: list[str] = []
    wrong: list[CheckpointError] = []

    def replace() -> None:
        trial.write_checkpoint(make_checkpoint(1), lambda folder: fill(folder, "second"))

    def look() -> None:
        other = opened().trial("t0000")
        for iteration in other.checkpoint_iterations():
            try:
                other.verify_checkpoint(iteration)
            except CheckpointError as error:
                wrong.append(error)
            seen.append((other.checkpoint_folder(iteration) / "state" / "weights").read_text())

    faults.rule("slow", kinds="PUT", keys="/policy.json$", then=replace)
    faults.rule("slow", kinds="PUT", keys="/head.json$", times=2, then=look)
    trial.write_checkpoint(make_checkpoint(1), lambda folder: fill(folder, "first"))
    trial.settle()
    look()
    assert wrong == []
    assert seen[-1] == "second"


def test_a_checkpoint_whose_files_are_missing_while_it_is_replaced_is_uploaded_afterwards(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial = opened().trial("t0000")
    trial.take()
    weights = trial.checkpoint_folder(1) / "state" / "weights"
    missing, seen = weights.with_suffix(".away"), threading.Event()

    def back() -> None:
        missing.rename(weights)
        seen.set()

    put_all = Bucket.put_all

    def begun(bucket: Bucket, files: Mapping[str, Path]) -> dict[str, Tag]:
        monkeypatch.undo()
        weights.rename(missing)
        threading.Timer(0.3, back).start()
        return put_all(bucket, files)

    monkeypatch.setattr(Bucket, "put_all", begun)
    trial.write_checkpoint(make_checkpoint(1), fill)
    trial.settle()
    assert seen.is_set()
    opened().trial("t0000").verify_checkpoint(1)


def test_copies_that_are_to_go_while_an_older_checkpoint_is_uploaded_go_with_the_newer_one(
    faults: Faults, opened: Opened
) -> None:
    trial, other = opened().trial("t0000"), opened().trial("t0001")
    trial.take()
    other.write_checkpoint(make_checkpoint(20, trial_id="t0001"), fill)
    opened().trial("t0000").copy_checkpoint(other.checkpoint_folder(20), 5)
    seen = list[bool]()

    def go_on() -> None:
        trial.write_checkpoint(make_checkpoint(6), fill)
        trial.remove_copies()

    def look() -> None:
        reader = opened().trial("t0000")  # its files go with it
        seen.append(reader.copied_checkpoint(5).exists())

    faults.rule("slow", kinds="PUT", keys="/t0000/head.json$", then=go_on)
    faults.rule("slow", kinds="PUT", keys="/t0000/head.json$", then=look)
    trial.write_checkpoint(make_checkpoint(4), fill)
    trial.remove_copies()
    trial.settle()
    look()
    assert seen == [True, False]


def test_results_that_are_replaced_while_they_are_uploaded_are_those_that_others_see(
    faults: Faults, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(result_chunks, "_SMALL_BYTES", 1)
    trial, reader = opened().trial("t0000"), opened().trial("t0000")
    trial.take()
    for number in (1, 2):
        trial.append_iterations([make_iteration(number)])
        trial.settle()
    assert [record.iteration for record in reader.read_results().records] == [1, 2]

    def go_back() -> None:
        # It continues from its first checkpoint, and comes farther than before.
        trial.keep_iterations([make_iteration(1)])
        trial.append_iterations([make_iteration(number) for number in (4, 5, 6, 7)])

    faults.rule("slow", kinds="PUT", keys="/results/", then=go_back)
    trial.append_iterations([make_iteration(3)])
    trial.settle()
    assert iterations(opened) == [1, 4, 5, 6, 7]
    assert [record.iteration for record in reader.read_results().records] == [1, 4, 5, 6, 7]


def test_readers_that_look_at_once_see_each_result_once(
    faults: Faults, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_bytes, open_one = Path.read_bytes, Path.open

    def slowly(path: Path) -> bytes:
        content = read_bytes(path)
        time.sleep(0.02 if path.name == "results.jsonl" else 0)
        return content

    def to_append(path: Path, mode: str = "r", *given: Any, **more: Any) -> IO[Any]:
        time.sleep(0.02 if mode == "ab" else 0)
        return open_one(path, mode, *given, **more)

    monkeypatch.setattr(Path, "read_bytes", slowly)
    monkeypatch.setattr(Path, "open", to_append)
    trial, reader = opened().trial("t0000"), opened().trial("t0000")
    trial.take()
    for number in range(1, 3):
        trial.append_iterations([make_iteration(number)])
        trial.settle()
        found: list[list[int]] = []
        together = threading.Barrier(3)

        def look(together: threading.Barrier = together, found: list[list[int]] = found) -> None:
            together.wait()
            found.append([record.iteration for record in reader.read_results().records])

        threads = [threading.Thread(target=look) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert found == [list(range(1, number + 1))] * 3
        # Twice the same lines would be read as once.
        local = reader._state.folder() / "results.jsonl"
        assert len(local.read_text().splitlines()) == number


def test_a_run_before_writes_no_record_over_that_of_the_next_even_if_it_has_read_it(opened: Opened) -> None:
    before, now = opened(), opened()
    before.take()
    now.take()
    for index in (0, 1):
        now.trial(f"t000{index}").write_record(make_trial(index, status="running"))
    before.trial("t0001").read_record()
    for index in (0, 1):
        with pytest.raises(OwnershipLostError):
            before.trial(f"t000{index}").write_record(make_trial(index))
        assert opened().trial(f"t000{index}").read_record().status == "running"


def test_removing_what_no_head_names_may_fail(faults: Faults, opened: Opened) -> None:
    sweep = opened()
    trial = sweep.trial("t0000")
    trial.take()
    denied = "<Error><Code>AccessDenied</Code><Message>No.</Message></Error>"
    faults.rule("status", kinds="POST", status=403, body=denied, times=10_000)
    for number in (1, 2, 3):
        trial.append_iterations([make_iteration(number)])
        trial.settle()
        outbox().settle(sweep._parts.jobs)
    assert faults.counts()["POST"] == 2
    assert iterations(opened) == [1, 2, 3]


def test_requests_have_bounds(faults: Faults, opened: Opened) -> None:
    """So that a change which costs requests is seen: they are what an object store is paid for."""
    sweep = opened()
    run_of_it = sweep.take()
    trial = sweep.trial("t0000")

    def counted(act: Callable[[], object]) -> dict[str, int]:
        faults.clear()
        act()
        return faults.counts()

    def checkpoint(number: int) -> None:
        trial.append_iterations([make_iteration(number)])
        trial.write_checkpoint(make_checkpoint(number), fill)
        trial.settle()

    def record(**changes: Any) -> None:
        trial.write_record(make_trial(**changes), soon=True)
        sweep.settle()

    # The trial's head, and the run's owner.
    assert counted(lambda: trial.take(run_of_it)) == {"GET": 2, "PUT": 1}
    # Three files, the results, the head, and the log; of the next one the results that were joined are removed
    # later, which nobody waits for.
    assert counted(lambda: checkpoint(1)) == {"PUT": 5}
    assert counted(lambda: checkpoint(2)) == {"PUT": 5}
    assert counted(lambda: checkpoint(3)) == {"PUT": 5}
    assert counted(lambda: outbox().settle(sweep._parts.jobs)) == {"POST": 1}
    # What lies there that nobody names: there is none where no process wrote before.
    assert counted(trial.remove_leftovers) == {}
    assert counted(lambda: opened().trial("t0000").remove_leftovers()) == {"GET": 1, "LIST": 2}
    # Whom a pack trains is written where it has changed: whether there is one, and whose the run is, at first.
    pack = sweep.pack("p00")
    assert counted(lambda: pack.write(Assignment(("t0000",)))) == {"GET": 2, "PUT": 1}
    assert counted(lambda: pack.write(Assignment(("t0000",)))) == {}
    assert counted(lambda: pack.write(Assignment(()))) == {"PUT": 1}
    # Whether there is one, and whose the run is; after that, none is asked for.
    assert counted(record) == {"GET": 2, "PUT": 1}
    assert counted(lambda: record(status="running")) == {"PUT": 1}
    reader = opened()
    assert counted(reader.read_trials) == {"GET": 1, "LIST": 1}
    assert counted(reader.trial("t0000").read_iterations) == {"GET": 2}
    assert counted(reader.trial("t0000").read_iterations) == {"GET": 1}
    assert counted(reader.trial("t0000").checkpoints) == {"GET": 4}
