"""What every store promises of a sweep that was removed or replaced: who worked on it writes nothing there any more."""

import contextlib
import errno
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from policy_factory import make_portable
from store_parts import ON_DISK, Reopen, make_best, make_iteration, make_sweep
from stores import Harness

from policies.errors import CannotRunError, NotFoundError
from tune_jobs.store import ownership
from tune_jobs.store.contract import Sweep, Trial
from tune_jobs.store.ownership import Owner, OwnershipLostError


def test_the_run_of_a_sweep_that_was_removed_writes_nothing_of_the_next_of_its_name(
    sweep: Sweep, another: Reopen
) -> None:
    first = sweep.take()
    with first.held():
        pass
    another().discard()
    another().create()
    second = another().take()
    with pytest.raises(OwnershipLostError), first.held():
        pytest.fail("it may write")
    with second.held():
        pass


@ON_DISK
def test_nothing_is_written_of_a_sweep_that_was_removed(sweep: Sweep, trial: Trial, another: Reopen) -> None:
    run = sweep.take()
    trial.take(run)
    another().discard()
    writes: list[Callable[[], object]] = [
        lambda: trial.append_iterations([make_iteration(1)]),
        run.held().__enter__,
        lambda: another().trial("t0001").take(run),
    ]
    for write in writes:
        with pytest.raises(OwnershipLostError):
            write()
    assert not Path(sweep.place).exists()


@ON_DISK
def test_an_owner_file_that_was_replaced_says_who_the_owner_is(sweep: Sweep) -> None:
    """Programs that synchronise folders between machines do so."""
    run, path = sweep.take(), Path(sweep.place, ".owner")
    for line, is_lost in ((path.read_text(), False), ("7 0123456789abcdef 4242 elsewhere\n", True)):
        incoming = path.with_name("incoming")
        incoming.write_text(line)
        incoming.replace(path)
        with contextlib.ExitStack() as stack:
            if is_lost:
                stack.enter_context(pytest.raises(OwnershipLostError, match=r"by another process \(4242 elsewhere\)"))
            stack.enter_context(run.held())
            assert not is_lost


def test_of_a_sweep_that_is_removed_meanwhile_nothing_is_written(
    harness: Harness, sweep: Sweep, another: Reopen
) -> None:
    """It would hold the name, and be no sweep."""
    policy = make_portable("CartPole-v1")
    for record in (None, make_sweep()):
        if record is not None:
            sweep.create()
            sweep.write_record(record)
        sweep.write_best(make_best(), policy)
        with contextlib.ExitStack() as stack:
            stack.enter_context(pytest.raises(NotFoundError, match="mine was removed meanwhile"))
            films = stack.enter_context(sweep.writing_films())
            folder = stack.enter_context(sweep.writing_report())
            another().discard()
            for path in (*films.values(), folder / "figures" / "a.svg"):
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(b"late")
        with pytest.raises(NotFoundError, match="mine was removed meanwhile"):
            sweep.write_best(make_best(), policy)
        assert not harness.storage().is_taken("mine")


def test_a_folder_that_is_away_for_a_moment_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, away = tmp_path / "mine", tmp_path / "away"
    owner = Owner.take(folder / ".owner")
    folder.rename(away)
    monkeypatch.setattr(time, "sleep", lambda _: away.rename(folder) if away.exists() else None)
    with owner.held():
        pass
    folder.rename(tmp_path / "elsewhere")
    monkeypatch.setattr(ownership, "_AWAY_S", 0.1)
    for _ in range(2):
        with pytest.raises(OwnershipLostError, match="mine is gone, or has been taken over"), owner.held():
            pass
        monkeypatch.setattr(time, "sleep", pytest.fail)  # it is not waited for again


def test_a_file_that_cannot_be_looked_at_is_not_left_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    owner = Owner.take(tmp_path / ".owner")

    def fails(path: Path) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(os, "lstat", fails)
        with pytest.raises(CannotRunError, match="Input/output error"), owner.held():
            pass
    monkeypatch.setattr(ownership, "_PATIENCE_S", 0.0)
    Owner.take(tmp_path / ".owner")
