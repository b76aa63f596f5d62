"""What asks a store often, holds its lock or keeps files of it nearby, while the store or the machine fails."""

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from s3_faults import Faults
from store_parts import fill, make_checkpoint, make_sweep

from policies.errors import CannotRunError, SpecError
from tune_jobs.store.objects import asked, lease, scratch
from tune_jobs.store.objects.bucket import Bucket, StorageError
from tune_jobs.store.objects.lease import is_leased, leased
from tune_jobs.store.objects.object_sweep import ObjectSweep
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.urls import join_place, name_of_place, outer_place

WORDS = ("It is held.", "Wait.")


@pytest.fixture
def bucket(url: ObjectUrl, monkeypatch: pytest.MonkeyPatch) -> Bucket:
    monkeypatch.setattr(lease, "_BEAT_S", 0.1)
    monkeypatch.setattr(lease, "LEASE_S", 3.0)
    return Bucket(url)


def soon(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_who_asks_for_a_stop_before_each_step_does_not_wait_for_the_store(faults: Faults, url: ObjectUrl) -> None:
    sweep = ObjectSweep(url)
    assert not sweep.stop_requested()
    faults.away()
    began = time.monotonic()
    for _ in range(20):
        assert not sweep.stop_requested()
        sweep.trial("t0000").write_log("a step")
    # Forty calls that waited for the store would take eighty seconds.
    assert time.monotonic() - began < 20
    faults.back()
    ObjectSweep(url).request_stop()
    soon(sweep.stop_requested)
    soon(lambda: "a step" in ObjectSweep(url).trial("t0000").log_tail())
    sweep.clear_stop_request()
    assert not sweep.stop_requested()


def test_who_asks_often_for_a_stop_does_not_wait_for_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(asked, "_EVERY_S", 0.01)
    monkeypatch.setattr(asked, "_BELIEVED", 1e9)
    monkeypatch.setattr(asked, "_WAIT_S", 30.0)
    answers, went_on = itertools.chain([False], itertools.repeat(True)), threading.Event()
    went_on.set()

    def ask() -> bool:
        went_on.wait(30)
        return next(answers)

    question = asked.Asked(ask)
    assert not question.answer()
    went_on.clear()
    time.sleep(0.02)
    began = time.monotonic()
    assert not question.answer()
    assert time.monotonic() - began < 15
    went_on.set()
    soon(question.answer)


def test_whether_a_stop_was_asked_for_is_an_error_if_the_store_never_said(faults: Faults, url: ObjectUrl) -> None:
    sweep = ObjectSweep(url)
    faults.rule("status", status=403, body="<Error><Code>AccessDenied</Code></Error>", times=1)
    with pytest.raises(StorageError, match="stop cannot be read: status code: 403"):
        sweep.stop_requested()
    assert not sweep.stop_requested()


def test_a_copy_that_could_not_be_fetched_whole_is_fetched_again(
    faults: Faults, url: ObjectUrl, tmp_path: Path
) -> None:
    sweep = ObjectSweep(url)
    donor, taker = sweep.trial("t0001"), sweep.trial("t0000")
    donor.write_checkpoint(make_checkpoint(3, trial_id="t0001"), fill)
    taker.copy_checkpoint(donor.checkpoint_folder(3), 3)
    other = ObjectSweep(url).trial("t0000")
    rule = faults.rule("status", kinds="GET", keys="/weights$", times=10_000)
    with pytest.raises(StorageError):
        other.copied_checkpoint(3)
    faults.rules.remove(rule)
    assert (other.copied_checkpoint(3) / "state" / "weights").read_text() == "abc"


def test_whether_a_report_is_current_is_found_out_without_the_trials_objects(faults: Faults, url: ObjectUrl) -> None:
    sweep = ObjectSweep(url)
    sweep.write_record(make_sweep())
    with sweep.writing_report() as folder:
        (folder / "index.html").write_bytes(b"page")
    faults.clear()
    assert sweep.current_report() is not None
    assert {request.key.rstrip("/").rpartition("/")[2] for request in faults.requests if request.is_list} == {
        "best", "report",
    }  # fmt: skip


def test_a_holder_whose_beats_answers_are_lost_keeps_the_lock(faults: Faults, bucket: Bucket) -> None:
    with leased(bucket, "lock", *WORDS) as beating:
        before = len(faults.requests)
        faults.rule("after", kinds="PUT", times=4)
        soon(lambda: not faults.rules[0].times and len(faults.requests) > before + 12)
        assert beating.is_ours()
        with pytest.raises(CannotRunError, match="It is held"), leased(Bucket(bucket.url), "lock", *WORDS):
            pass
    assert not is_leased(bucket, "lock")


def test_a_holder_elsewhere_is_watched_once(bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    """A service asks at each look, of each sweep."""
    monkeypatch.setattr(lease, "_is_here", lambda holder: None)

    def took(expected: bool, **how: float) -> float:
        began = time.monotonic()
        assert is_leased(bucket, "lock", 1.0, **how) is expected
        return time.monotonic() - began

    tag = bucket.put("lock", lease._sign("another", 0), is_new=True)
    assert took(expected=False) >= 1.0
    assert took(expected=False) < 0.5
    bucket.put("lock", lease._sign("another", 1), over=tag)
    assert took(expected=True) < 0.5
    # Who wants the lock makes sure; and a sign of life is believed for some time only.
    assert took(expected=False, believed_s=0.0) >= 0.5
    assert took(expected=False, believed_s=0.5) < 0.5


@pytest.mark.parametrize("is_elsewhere", [False, True])
def test_a_holder_that_was_killed_is_replaced(
    bucket: Bucket, monkeypatch: pytest.MonkeyPatch, is_elsewhere: bool
) -> None:
    if is_elsewhere:
        monkeypatch.setattr(lease, "_is_here", lambda holder: None)
    code = (
        "import time\nfrom tune_jobs.store.objects.bucket import Bucket\nfrom tune_jobs.store.objects import lease\n"
        f"from tune_jobs.store.objects.url import ObjectUrl\nlease._BEAT_S = 0.1\n"
        f"with lease.leased(Bucket(ObjectUrl.parse({str(bucket.url)!r})), 'lock', 'a', 'b'):\n"
        "    print('held', flush=True)\n    time.sleep(60)"
    )
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == "held\n"
        with pytest.raises(CannotRunError, match="It is held"), leased(bucket, "lock", *WORDS):
            pass
        assert is_leased(bucket, "lock", watch_s=3.0)
    finally:
        child.send_signal(signal.SIGKILL)
        child.communicate()
    began = time.monotonic()
    with leased(bucket, "lock", *WORDS):
        waited = time.monotonic() - began
    assert waited >= 3.0 if is_elsewhere else waited < 3.0


def test_of_two_that_take_a_lock_at_once_one_has_it(bucket: Bucket) -> None:
    together = threading.Barrier(4)
    taken: list[int] = []
    refused: list[int] = []

    def take() -> None:
        together.wait()
        try:
            with leased(Bucket(bucket.url), "lock", *WORDS):
                taken.append(1)
                # Until all have tried.
                soon(lambda: len(refused) == 3)
        except CannotRunError:
            refused.append(1)

    threads = [threading.Thread(target=take) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(taken), len(refused)) == (1, 3)


def test_a_scratch_folder_that_cannot_be_used_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url = ObjectUrl("s3", "sweeps", "mine")
    (tmp_path / "file").touch()
    others = tmp_path / "others"
    others.mkdir()
    for place, message in ((tmp_path / "file", "cannot be made|is no folder"), (others, "is no folder of this user")):
        monkeypatch.setenv(scratch.VARIABLE, str(place))
        if place == others:
            monkeypatch.setattr(os, "getuid", lambda: 12345)
        with pytest.raises(CannotRunError, match=message) as raised:
            scratch.shared_folder(url)
        assert scratch.VARIABLE in raised.value.hint


@pytest.mark.parametrize("name", ["a b", "50%", "ü", "a~b", "a+b", "a&b=c", "q?z", "x#y", "a%2Fb", "[1]", "a\\b", "'"])
def test_places_of_odd_names_are_the_same_for_texts_and_for_objects(name: str) -> None:
    storage = "s3://bucket/some%20where/?endpoint=http://host:9000&region=r"
    place = join_place(storage, name)
    url = ObjectUrl.parse(place)
    assert url == ObjectUrl.parse(storage).child(name)
    assert ObjectUrl.parse(str(url)) == url
    assert name_of_place(place) == url.name == name
    assert ObjectUrl.parse(outer_place(place)) == url.parent == ObjectUrl.parse(storage)


@pytest.mark.parametrize(
    "text", ["s3://[x/a", "s3://", "s3:///a", "s3://a/b//c", "s3://a/../b", "s3://a/b#c", "s3://a/b%2Fc"]
)
def test_what_is_no_place_is_an_error_with_a_hint(text: str) -> None:
    with pytest.raises(SpecError) as raised:
        ObjectUrl.parse(text)
    assert raised.value.hint


def test_the_folder_of_a_sweep_is_removed_with_what_opened_it() -> None:
    """At once, and not when garbage is collected: a service opens a sweep at each look."""
    sweep = ObjectSweep(ObjectUrl.parse("s3://bucket/sweeps/mine"))
    trial = sweep.trial("t0000")
    own = sweep._parts.own()
    (own / "made").mkdir()
    del sweep
    assert own.is_dir()
    del trial
    assert not own.exists()
