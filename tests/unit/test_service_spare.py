"""A driver process is started and given a job over a socket, as each system has one."""

import errno
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from synthetic_sweep import make_sweep_record

from policies.errors import CannotRunError
from tests.narrowing import present
from tune_jobs.service.job_files import JobFiles
from tune_jobs.service.spare import Driver
from tune_jobs.store.sweep_store import SweepStore

PATIENCE_S = 60.0


def wait(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def make_sweep(folder: Path) -> SweepStore:
    store = SweepStore(folder / "mine")
    store.create()
    record = make_sweep_record("mine", "ppo", "CartPole-v1", [], 1)
    store.write_record(record.model_copy(update={"state": "created", "spec": record.spec | {"hyperparams": {}}}))
    return store


# More than what a socket holds; a driver that has just been started has read nothing.
@pytest.mark.parametrize("point", [{"lr": 0.1}, {"lr": "9" * 500_000}], ids=["short", "long"])
def test_a_driver_is_given_its_job_whole_where_a_socket_keeps_no_messages_apart(
    point: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = socket.socketpair

    def as_on_macos(family: int, kind: int) -> tuple[socket.socket, socket.socket]:
        if kind == socket.SOCK_SEQPACKET:
            raise OSError(errno.EPROTONOSUPPORT, "Protocol not supported")
        return made(family, kind)

    monkeypatch.setattr(socket, "socketpair", as_on_macos)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    sweep, files = make_sweep(tmp_path), JobFiles(tmp_path / ".service", "uid")
    lock = present(files.take())
    driver = Driver({"modules": [], "working_folder": str(tmp_path), "warm_ray": False}, module="fake_driver")
    request = {
        "service": str(tmp_path / ".service"), "job": "uid", "number": 1, "attempt": 1, "sweep": sweep.place,
        "verb": "inject", "arguments": {"point": point},
    }  # fmt: skip
    driver.give(request, lock, files.log)
    os.close(lock)
    wait(lambda: driver.poll() is not None, "it lives on")
    assert present(files.read_ended(1)).outcome == "completed", files.last_lines()
    assert not files.is_run()


def test_that_there_is_no_room_for_another_socket_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: int) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(socket, "socketpair", none)
    with pytest.raises(CannotRunError, match=r"No process can be started to run a sweep in .*Too many open files"):
        Driver({}, module="fake_driver")
