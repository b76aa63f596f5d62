"""Sweeps that threads run: each in a process of its own, and the calling process stays as it was."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

import tune_jobs
import tune_jobs.sweeps.verbs  # and with it Gymnasium, which sets a variable
from policies.envs.modules import allow_modules, allowed_again, allowed_modules
from policies.errors import CannotRunError, EnvError, SpecError
from tests.integration import apart_runs
from tests.integration.apart_runs import make_result
from tune_jobs.process.interruption import can_drive, taking_signals
from tune_jobs.process.state import given_back
from tune_jobs.process.streams import quiet
from tune_jobs.sweeps import apart
from tune_jobs.sweeps.interrupted import SweepInterrupted
from tune_jobs.sweeps.outcome import SweepResult

ROOT = Path(__file__).parents[2]
LIMIT_S = 120
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


def in_thread(call: Callable[..., Any], *args: str | Path | dict[str, Any], **kwargs: Any) -> SweepResult:
    """What a call in another thread than the main one returns or raises."""
    with ThreadPoolExecutor(1) as pool:
        return cast("SweepResult", pool.submit(call, *args, **kwargs).result(LIMIT_S))


def process_state() -> dict[str, Any]:
    return {
        "descriptors": [os.readlink(f"/proc/self/fd/{number}") for number in range(3)],  # noqa: PTH115
        "environment": dict(os.environ),
        "handlers": [signal.getsignal(number) for number in SIGNALS],
        "loggers": [logging.getLogger().level, logging.getLogger().handlers[:]],
        "modules": allowed_modules(),
        "path": sys.path[:],
    }


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_thread_has_a_sweep_run_by_a_child_and_its_own_process_is_as_before(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A child that joins a Ray of another test's imports it, and that adds to where it looks for modules.
    monkeypatch.setattr(apart, "address_of_users_ray", lambda: None)
    before = process_state()
    with allowed_again():
        allow_modules(["of_the_main_thread"])
    assert in_thread(apart_runs.tells, tmp_path, name="it") == make_result("it")
    assert process_state() == before
    seen = json.loads((tmp_path / "it").read_text())
    assert seen["pid"] != os.getpid()
    assert (seen["parent"], seen["thread is main"]) == (os.getpid(), True)
    assert (seen["argv"], seen["path"]) == (sys.argv[:1], sys.path)
    assert "of_the_main_thread" not in seen["modules"]
    assert caplog.messages == ["one is left out: it"]


def test_beside_a_sweep_of_this_process_another_one_has_what_was_there_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_OF_A_SWEEP", "before")
    errors = os.readlink("/proc/self/fd/2")  # noqa: PTH115
    with taking_signals(), given_back(), quiet(tmp_path / "driver.log"):
        os.environ["RAY_OF_A_SWEEP"] = "of the first sweep"
        assert not can_drive()
        in_thread(apart_runs.tells, tmp_path, name="second")
        apart_runs.tells(tmp_path, name="nested")
    for name in ("second", "nested"):
        seen = json.loads((tmp_path / name).read_text())
        assert (seen["variable"], seen["errors"]) == ("before", errors)


def test_two_threads_run_their_sweeps_at_the_same_time(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        one = pool.submit(apart_runs.meets, tmp_path, name="one", other="two")
        two = pool.submit(apart_runs.meets, tmp_path, name="two", other="one")
        assert [one.result(LIMIT_S), two.result(LIMIT_S)] == [make_result("one"), make_result("two")]


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        ("env", EnvError, "The env is broken.\nMend it."),
        ("own", RuntimeError, "OwnError: nobody knows it"),
        ("interrupted", SweepInterrupted, "The sweep was interrupted."),
        ("ctrl-c", SweepInterrupted, "The sweep was interrupted."),
        ("dies", CannotRunError, "The process that ran the sweep ended with exit code 5."),
        ("is killed", CannotRunError, "The process that ran the sweep was ended by signal 9"),
    ],
)
def test_what_the_child_raises_is_raised_here(kind: str, error: type[BaseException], message: str) -> None:
    with pytest.raises(error) as caught:
        in_thread(apart_runs.fails, kind)
    assert type(caught.value) is error
    assert str(caught.value).startswith(message)
    if error is SweepInterrupted:
        assert cast("Any", caught.value).result == (
            replace(make_result(), interrupted=True) if kind == "interrupted" else None
        )


@pytest.fixture
def script(tmp_path: Path) -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    """Start the script in a group of its own, and wait until its sweeps run."""
    started = []

    def start(how: str) -> subprocess.Popen[str]:
        names = ("one", "two", "main")[: 2 + (how == "drives")]
        command = [sys.executable, "-m", apart_runs.__name__, str(tmp_path), how]
        process = subprocess.Popen(command, cwd=ROOT, start_new_session=True, stderr=subprocess.PIPE, text=True)
        started.append(process)
        wait_until(lambda: all((tmp_path / name).exists() for name in names))
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("to_group", [True, False])
@pytest.mark.parametrize("how", ["waits", "drives"])
def test_ctrl_c_in_the_main_thread_ends_each_sweep_in_order(
    script: Callable[[str], subprocess.Popen[str]], tmp_path: Path, to_group: bool, how: str
) -> None:
    """Once: a terminal sends it to the whole group, which must not be taken for two of them."""
    process = script(how)
    (os.killpg if to_group else os.kill)(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=LIMIT_S)
    assert "KeyboardInterrupt" in said or "SweepInterrupted" in said
    assert {path.name for path in tmp_path.glob("* raised")} == {"one raised", "two raised"}, said
    names = {"one", "two", *(["main"] if how == "drives" else [])}
    assert {path.name for path in tmp_path.glob("* saved")} == {f"{name} saved" for name in names}


@pytest.mark.parametrize("how", ["joins", "ends"])
def test_sweeps_of_threads_that_nobody_waits_for_end_in_order_with_the_process(
    script: Callable[[str], subprocess.Popen[str]], tmp_path: Path, how: str
) -> None:
    """Ctrl-C lets Python forget a thread that is being joined; and threads may be daemons."""
    process = script(how)
    if how == "joins":
        process.send_signal(signal.SIGINT)
    process.communicate(timeout=LIMIT_S)
    assert {path.name for path in tmp_path.glob("* saved")} == {"one saved", "two saved"}


def test_children_end_with_a_parent_that_is_killed(
    script: Callable[[str], subprocess.Popen[str]], tmp_path: Path
) -> None:
    process = script("joins")
    process.kill()
    # The pipe is the children's too: it is closed when all have ended.
    process.communicate(timeout=LIMIT_S / 4)
    assert not list(tmp_path.glob("* saved"))


def test_what_a_thread_allows_is_that_threads(tmp_path: Path) -> None:
    inside, may_end = threading.Event(), threading.Event()

    def other() -> tuple[str, ...]:
        with allowed_again():
            allow_modules(["of_the_other"])
            inside.set()
            assert may_end.wait(LIMIT_S)
            return allowed_modules()

    with ThreadPoolExecutor(1) as pool:
        theirs = pool.submit(other)
        assert inside.wait(LIMIT_S)
        before = allowed_modules()
        with allowed_again():
            allow_modules(["of_this_one"])
            may_end.set()
            assert "of_the_other" in theirs.result(LIMIT_S)
            assert set(allowed_modules()) == {*before, "of_this_one"}
        assert allowed_modules() == before
    assert "of_the_other" not in before


def test_a_thread_may_not_launch_a_class_of_the_main_script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import gymnasium as gym

    walk = type("Walk", (gym.Env,), {"__module__": "__main__"})
    with pytest.raises(SpecError, match="Walk is defined in the main script"):
        in_thread(tune_jobs.launch, {"env": walk, "algorithm": "ppo"}, storage=tmp_path / "sweeps")
    assert not (tmp_path / "sweeps").exists()
