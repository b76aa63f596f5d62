"""What a sweep's writers and readers keep to while the store fails or is away: nothing lost, doubled or half."""

import functools
import os
import secrets
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from s3_faults import Faults
from store_parts import fill, make_checkpoint, make_iteration, make_trial

from policies.errors import CheckpointError, TuneJobsError
from tune_jobs.store.objects import outbox as of_outbox
from tune_jobs.store.objects.bucket import Bucket, StorageError
from tune_jobs.store.objects.head import read_head
from tune_jobs.store.objects.object_sweep import ObjectSweep
from tune_jobs.store.objects.outbox import Outbox
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.ownership import OwnershipLostError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def url(faults: Faults) -> ObjectUrl:
    return ObjectUrl("s3", "sweeps", f"{secrets.token_hex(4)}/mine", {"endpoint": faults.endpoint})


@pytest.fixture
def opened(url: ObjectUrl) -> Callable[[], ObjectSweep]:
    """The sweep as another process opens it."""
    return lambda: ObjectSweep(url)


Opened = Callable[[], ObjectSweep]


def iterations(opened: Opened) -> list[int]:
    return [record.iteration for record in opened().trial("t0000").read_iterations()]


@pytest.mark.parametrize("act", ["before", "after", "torn", 503])
def test_results_and_checkpoints_arrive_once_whatever_request_fails(
    faults: Faults, opened: Opened, act: str | int
) -> None:
    trial = opened().trial("t0000")
    trial.take()
    for number in range(1, 7):
        # Each request of an upload in its turn, at least twice in a row: what obstore repeats is not all.
        settings: dict[str, Any] = {"status": act} if isinstance(act, int) else {}
        rule = faults.rule("status" if isinstance(act, int) else act, skip=number - 1, times=2, **settings)
        trial.append_iterations([make_iteration(number)])
        trial.write_checkpoint(make_checkpoint(number), functools.partial(fill, content=str(number)))
        trial.settle()
        faults.rules.remove(rule)
    other = opened().trial("t0000")
    assert iterations(opened) == [1, 2, 3, 4, 5, 6]
    assert other.checkpoint_iterations() == [1, 2, 3, 4, 5, 6]
    for number in range(1, 7):
        other.verify_checkpoint(number)
        assert (other.checkpoint_folder(number) / "state" / "weights").read_text() == str(number)


def test_training_goes_on_while_the_store_is_away_and_all_arrives_when_it_is_back(
    faults: Faults, opened: Opened
) -> None:
    trial = opened().trial("t0000")
    trial.take()
    faults.away()
    began = time.monotonic()
    for number in range(1, 21):
        trial.append_iterations([make_iteration(number)])
        trial.write_checkpoint(make_checkpoint(number), fill)
        if number > 2:
            trial.delete_checkpoint(make_checkpoint(number - 2))
    # Each of 58 calls that waited for the store would take two seconds.
    assert time.monotonic() - began < 20.0
    faults.back()
    trial.settle()
    assert iterations(opened) == list(range(1, 21))
    assert opened().trial("t0000").checkpoint_iterations() == [19, 20]
    opened().trial("t0000").verify_checkpoint(20)


def test_what_cannot_be_kept_is_said_with_where_and_why(
    faults: Faults, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(of_outbox, "PATIENCE_S", 0.1)
    trial = opened().trial("t0000")
    trial.take()
    faults.away()
    trial.append_iterations([make_iteration(1)])
    with pytest.raises(StorageError, match=r"mine/trials/t0000/results/.* the connection was refused"):
        trial.settle()
    # Who goes on hears of it too.
    with pytest.raises(StorageError, match="refused"):
        trial.append_iterations([make_iteration(2)])
    faults.back()
    trial.take()
    trial.append_iterations([make_iteration(1)])
    trial.settle()
    assert iterations(opened) == [1]


def test_uploads_that_do_not_end_in_time_say_why() -> None:
    box = Outbox()

    def fails() -> None:
        raise StorageError("s3://x/y cannot be written: it is away.", "Look.", passes=True)

    box.add("y", fails)
    with pytest.raises(TuneJobsError, match=r"1 uploads have not ended within 0 s\. s3://x/y cannot") as raised:
        box.settle(timeout_s=0.2)
    assert raised.value.hint == "Look."


def test_a_trial_whose_results_could_not_be_fetched_is_not_written_without_them(faults: Faults, opened: Opened) -> None:
    first = opened().trial("t0000")
    first.take()
    first.append_iterations([make_iteration(1)])
    first.settle()
    for takes in (True, False):
        trial = opened().trial("t0000")
        rule = faults.rule("status", kinds="GET", keys="/results/", times=10_000)
        with pytest.raises(StorageError):
            trial.take() if takes else trial.append_iterations([make_iteration(9)])
        faults.rules.remove(rule)
        trial.append_iterations([make_iteration(len(iterations(opened)) + 1)])
        trial.settle()
    assert iterations(opened) == [1, 2, 3]


def test_results_that_are_gone_are_an_error_and_not_none(faults: Faults, opened: Opened, url: ObjectUrl) -> None:
    trial = opened().trial("t0000")
    trial.take()
    trial.append_iterations([make_iteration(1)])
    trial.settle()
    bucket = Bucket(url)
    bucket.delete([item.key for item in bucket.listed("trials/t0000/results/")])
    for use in (opened().trial("t0000").take, opened().trial("t0000").read_results):
        with pytest.raises(CheckpointError, match="names results that do not exist"):
            use()


def test_what_is_not_uploaded_when_a_process_ends_is_brought_before_its_files_are_removed(
    faults: Faults, opened: Opened, url: ObjectUrl
) -> None:
    run(
        f"""
        trial = ObjectSweep(ObjectUrl.parse({str(url)!r})).trial("t0000")
        trial.take()
        trial.append_iterations([make_iteration(1), make_iteration(2)])
        trial.write_checkpoint(make_checkpoint(2), fill)
        """
    )
    assert iterations(opened) == [1, 2]
    opened().trial("t0000").verify_checkpoint(2)


def test_a_process_that_ends_without_the_store_says_what_is_lost(faults: Faults, url: ObjectUrl) -> None:
    said = run(
        f"""
        import socket
        from tune_jobs.store.objects import outbox, bucket
        outbox._AT_EXIT_S, bucket._PATIENCE_S = 0.3, 0.1
        url = ObjectUrl.parse({str(url)!r})
        trial = ObjectSweep(url).trial("t0000")
        trial.take()
        trial._state._bucket = bucket.Bucket(ObjectUrl("s3", "sweeps", "x", {{"endpoint": "http://127.0.0.1:9"}}))
        trial.append_iterations([make_iteration(1)])
        """
    )
    assert "not all that it wrote is in the store" in said


@pytest.mark.parametrize("after", range(1, 6))
def test_a_writer_killed_at_any_request_of_a_checkpoint_leaves_the_one_before_or_the_whole(
    faults: Faults, opened: Opened, url: ObjectUrl, after: int
) -> None:
    first = opened().trial("t0000")
    first.take()
    first.append_iterations([make_iteration(1)])
    first.write_checkpoint(make_checkpoint(1), fill)
    first.settle()
    faults.clear()
    reached, go_on = threading.Event(), threading.Event()

    def stop() -> None:
        reached.set()
        go_on.wait(30)

    # The first request that writes takes the trial.
    faults.rule("before" if after % 2 else "after", kinds="PUT", skip=after, then=stop)
    child = started(
        f"""
        trial = ObjectSweep(ObjectUrl.parse({str(url)!r})).trial("t0000")
        trial.take()
        trial.append_iterations([make_iteration(2)])
        trial.write_checkpoint(make_checkpoint(2), lambda folder: fill(folder, "two"))
        trial.settle()
        """
    )
    try:
        assert reached.wait(30)
    finally:
        child.kill()
        child.communicate()
        go_on.set()
    faults.rules.clear()
    seen = opened().trial("t0000")
    assert seen.checkpoint_iterations() in ([1], [1, 2])
    for iteration in seen.checkpoint_iterations():
        seen.verify_checkpoint(iteration)
    assert iterations(opened) in ([1], [1, 2])
    heir = opened().trial("t0000")
    heir.take()
    heir.remove_leftovers()
    bucket = Bucket(url)
    head, _ = read_head(bucket, "trials/t0000/head.json")
    named = {stored.key for stored in head.checkpoints.values()} | {chunk.key for chunk in head.results}
    for item in bucket.listed("trials/t0000/"):
        assert item.key.endswith("head.json") or any(key in item.key for key in named)


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
    faults: Faults, opened: Opened
) -> None:
    trial = opened().trial("t0000")
    trial.take()
    weights = trial.checkpoint_folder(1) / "state" / "weights"
    missing, seen = weights.with_suffix(".away"), threading.Event()

    def back() -> None:
        missing.rename(weights)
        seen.set()

    def move() -> None:
        weights.rename(missing)
        threading.Timer(0.3, back).start()

    faults.rule("slow", kinds="PUT", keys="/policy.safetensors$", then=move)
    trial.write_checkpoint(make_checkpoint(1), fill)
    trial.settle()
    assert seen.is_set()
    opened().trial("t0000").verify_checkpoint(1)


def test_readers_that_look_at_once_see_each_result_once(
    faults: Faults, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_bytes = Path.read_bytes

    def slowly(path: Path) -> bytes:
        content = read_bytes(path)
        time.sleep(0.02 if path.name == "results.jsonl" else 0)
        return content

    monkeypatch.setattr(Path, "read_bytes", slowly)
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
    trial = opened().trial("t0000")
    trial.take()
    denied = "<Error><Code>AccessDenied</Code><Message>No.</Message></Error>"
    faults.rule("status", kinds="POST", status=403, body=denied, times=10_000)
    for number in (1, 2, 3):
        trial.append_iterations([make_iteration(number)])
        trial.settle()
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
    # Three files, the results, the head, and the log; of the next one the results that were joined are removed.
    assert counted(lambda: checkpoint(1)) == {"PUT": 5}
    assert counted(lambda: checkpoint(2)) == {"POST": 1, "PUT": 5}
    # Whether there is one, and whose the run is; after that, none is asked for.
    assert counted(record) == {"GET": 2, "PUT": 1}
    assert counted(lambda: record(status="running")) == {"PUT": 1}
    reader = opened()
    assert counted(reader.read_trials) == {"GET": 1, "LIST": 1}
    assert counted(reader.trial("t0000").read_iterations) == {"GET": 2}
    assert counted(reader.trial("t0000").read_iterations) == {"GET": 1}
    assert counted(reader.trial("t0000").checkpoints) == {"GET": 3}


def started(code: str) -> subprocess.Popen[str]:
    before = "from store_parts import fill, make_checkpoint, make_iteration\n"
    before += "from tune_jobs.store.objects.object_sweep import ObjectSweep\n"
    before += "from tune_jobs.store.objects.url import ObjectUrl\n"
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests/unit"), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-c", before + textwrap.dedent(code)],
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def run(code: str) -> str:
    child = started(code)
    said, _ = child.communicate(timeout=60)
    assert child.returncode == 0, said
    return said
