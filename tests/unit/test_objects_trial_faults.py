"""What a sweep's writers and readers keep to while the store fails or is away: nothing lost, doubled or half."""

import functools
import os
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from s3_faults import Faults, Opened, iterations
from store_parts import fill, make_checkpoint, make_iteration

from policies.errors import CheckpointError, TuneJobsError
from tune_jobs.store.objects import outbox as of_outbox
from tune_jobs.store.objects.bucket import Bucket, StorageError
from tune_jobs.store.objects.head import read_head
from tune_jobs.store.objects.outbox import Outbox
from tune_jobs.store.objects.url import ObjectUrl

ROOT = Path(__file__).parents[2]


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
        from tune_jobs.store.objects import bucket, clients, outbox
        outbox._AT_EXIT_S, clients.PATIENCE_S = 0.3, 0.1
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
