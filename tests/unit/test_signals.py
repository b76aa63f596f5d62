"""Signals and threads while a sweep runs: who is asked, what raises, and that one process runs one sweep at a time."""

import contextlib
import ctypes
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from signal import Signals
from typing import Any

import pytest
from sweep_folders import MACHINE, make_sweep_folder

from analysis.records import SweepRecord
from policies.errors import CannotRunError
from tests.narrowing import present
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.process.interruption import can_drive, current, taking_signals
from tune_jobs.spec.file import stored_spec
from tune_jobs.sweeps import drive
from tune_jobs.sweeps.alone import run_alone
from tune_jobs.sweeps.interrupted import SweepInterrupted
from tune_jobs.sweeps.outcome import SweepResult

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def send(number: Signals) -> None:
    # Python runs the handler before os.kill returns.
    os.kill(os.getpid(), number)


def make_result() -> SweepResult:
    sweep = SweepRecord(
        name="mine",
        state="completed",
        spec={},
        evaluation_seeds=(),
        confirmation_seeds=(),
        num_trials=0,
        created_at=0.0,
    )
    return SweepResult("mine", sweep, [])


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """No test may leave a handler behind."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    assert {number: signal.getsignal(number) for number in SIGNALS} == before


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_raises_where_nobody_is_asked(number: Signals) -> None:
    with taking_signals() as interruption:
        with pytest.raises(KeyboardInterrupt):
            send(number)
        assert interruption.came


@pytest.mark.parametrize("comes", [True, False])
def test_ray_that_does_not_start_after_a_signal_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, comes: bool
) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    trial = store.trial("t0001")
    trial.write_record(trial.read_record().model_copy(update={"status": "pending"}))
    plan = make_plan(stored_spec(store.read_record()), MACHINE)

    def connected(*_: Any, **__: Any) -> Any:
        if comes:
            send(signal.SIGTERM)
        raise CannotRunError("Ray cannot be started on this machine: it timed out.", "Look at its logs.")

    monkeypatch.setattr(drive, "connected", connected)
    failure = contextlib.nullcontext() if comes else pytest.raises(CannotRunError, match="it timed out")
    with taking_signals() as interruption, store.lock(), drive.settled(store), failure:
        with drive.Shared() as shared:
            result = drive.run_trials_of(store, plan, shared, address=None, machine=MACHINE, progress="none")
        assert result.interrupted
    assert interruption.came == comes
    assert store.read_record().state == "interrupted"


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_asks_and_the_second_raises(number: Signals) -> None:
    asked = []
    with taking_signals() as interruption, interruption.asking(lambda: asked.append(number)):
        send(number)
        assert (asked, interruption.came) == ([number], True)
        with pytest.raises(KeyboardInterrupt):
            send(signal.SIGTERM if number == signal.SIGHUP else number)
        assert asked == [number]


@pytest.mark.parametrize("number", SIGNALS)
def test_a_hangup_is_never_the_second_signal(number: Signals) -> None:
    """A dropped ssh line sends two, to the job and to its group; who sends SIGTERM may send SIGHUP at once."""
    asked = []
    with taking_signals() as interruption, interruption.asking(lambda: asked.append(1)):
        send(number)
        send(signal.SIGHUP)
        send(signal.SIGHUP)
        assert asked == [1]
        with pytest.raises(KeyboardInterrupt):
            send(signal.SIGINT)


def test_a_second_hangup_does_not_cut_short_what_the_first_one_ended() -> None:
    done = []
    with taking_signals():
        try:
            with pytest.raises(KeyboardInterrupt):
                send(signal.SIGHUP)
        finally:
            send(signal.SIGHUP)
            done.append(1)
    assert done == [1]


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_that_comes_while_one_asks_waits(number: Signals) -> None:
    asked = []

    def ask() -> None:
        send(number)
        asked.append(1)

    with taking_signals() as interruption, interruption.asking(ask):
        send(number)
        assert asked == [1]
        with pytest.raises(KeyboardInterrupt):
            send(signal.SIGTERM)


def test_a_hangup_that_was_only_noted_has_not_ended_anything() -> None:
    with taking_signals() as interruption:
        with interruption.shielded():
            send(signal.SIGHUP)
        with pytest.raises(KeyboardInterrupt):
            send(signal.SIGHUP)


def test_a_hangup_ends_each_of_a_loops_sweeps() -> None:
    for _ in range(2):
        with taking_signals(), pytest.raises(KeyboardInterrupt):
            send(signal.SIGHUP)


def test_signals_wait_for_what_must_not_be_cut_short() -> None:
    asked = []
    with taking_signals() as interruption, interruption.asking(lambda: asked.append(1)):
        with interruption.shielded(), interruption.shielded():
            send(signal.SIGTERM)
            send(signal.SIGTERM)
        assert (asked, interruption.came) == ([], True)
        send(signal.SIGTERM)
        assert asked == [1]


@pytest.mark.parametrize("number", SIGNALS)
def test_nohup_means_it(number: Signals) -> None:
    """A shell that starts a job in the background lets it ignore SIGINT, which `kill -INT` doesn't mean."""
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with taking_signals() as interruption, interruption.shielded():
            send(number)
            assert interruption.came == (number != signal.SIGHUP)
        assert signal.getsignal(number) == signal.SIG_IGN
    finally:
        signal.signal(number, before)


def test_a_signal_is_known_while_the_main_thread_is_in_native_code() -> None:
    """There its handler is called only afterwards; a lock of the C library, unlike most calls, waits on regardless."""
    library = ctypes.CDLL(None)
    lock = ctypes.create_string_buffer(64)
    held, known = threading.Event(), []

    def send_and_look() -> None:
        library.pthread_mutex_lock(lock)
        held.set()
        time.sleep(0.5)
        known.append(interruption.has_arrived())
        send(signal.SIGTERM)
        deadline = time.monotonic() + 60
        while not interruption.has_arrived() and time.monotonic() < deadline:
            time.sleep(0.01)
        known.extend((interruption.has_arrived(), interruption.came))
        library.pthread_mutex_unlock(lock)

    with taking_signals() as interruption:
        thread = threading.Thread(target=send_and_look)
        thread.start()
        held.wait()
        with interruption.asking(lambda: None):
            library.pthread_mutex_lock(lock)
        thread.join()
        assert known == [False, True, False]
        assert interruption.came
    assert interruption.has_arrived()
    assert signal.set_wakeup_fd(-1) == -1


def test_other_signals_are_not_taken_for_one_that_asks_for_the_end() -> None:
    before = signal.signal(signal.SIGWINCH, lambda number, frame: None)
    try:
        with taking_signals() as interruption:
            send(signal.SIGWINCH)
            assert not interruption.has_arrived()
    finally:
        signal.signal(signal.SIGWINCH, before)


def test_signals_of_a_forked_process_are_not_taken_for_this_ones() -> None:
    with taking_signals() as interruption:
        child = os.fork()
        if child == 0:
            signal.signal(signal.SIGTERM, lambda number, frame: os._exit(7))
            os.kill(os.getpid(), signal.SIGTERM)
            os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        assert not interruption.has_arrived()


def test_what_a_process_has_set_for_arriving_signals_stays() -> None:
    """As an event loop that handles signals does; then one is known when its handler is called."""
    reading, writing = os.pipe()
    try:
        for end in (reading, writing):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(writing)
        with taking_signals() as interruption:
            assert not interruption.has_arrived()
            with interruption.asking(lambda: None):
                send(signal.SIGTERM)
            assert interruption.has_arrived()
        assert os.read(reading, 8) == bytes([signal.SIGTERM])
        assert signal.set_wakeup_fd(-1) == writing
    finally:
        signal.set_wakeup_fd(-1)
        os.close(reading)
        os.close(writing)


def test_an_interrupted_run_raises_with_what_there_is() -> None:
    @run_alone
    def run() -> SweepResult:
        with current().shielded():
            send(signal.SIGHUP)
        return make_result()

    with pytest.raises(SweepInterrupted) as caught:
        run()
    assert isinstance(caught.value, KeyboardInterrupt)
    assert present(caught.value.result).interrupted
    assert present(caught.value.result).exit_code == 130


def test_a_run_interrupted_before_it_began_has_no_result() -> None:
    @run_alone
    def run() -> SweepResult:
        send(signal.SIGINT)
        return make_result()

    with pytest.raises(SweepInterrupted) as caught:
        run()
    assert caught.value.result is None


def test_a_run_that_another_process_stopped_raises_nothing() -> None:
    @run_alone
    def run() -> SweepResult:
        return make_result()

    assert run() == make_result()


def test_a_process_runs_one_sweep_at_a_time() -> None:
    """The others get processes of their own: see test_apart.py."""
    assert can_drive()
    with taking_signals():
        assert not can_drive()
        with pytest.raises(RuntimeError), taking_signals():
            raise AssertionError("it must not begin")
    with ThreadPoolExecutor(1) as pool:
        assert not pool.submit(can_drive).result()
    # And the next one may.
    assert run_alone(make_result)() == make_result()


def test_a_run_that_fails_lets_the_next_one_begin() -> None:
    @run_alone
    def fails() -> SweepResult:
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        fails()
    assert run_alone(make_result)() == make_result()
