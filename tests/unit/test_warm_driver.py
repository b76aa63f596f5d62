"""A driver process that is kept for the next sweep has what a sweep needs before there is one."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import pytest

from policies.errors import CannotRunError
from policies.guard.guard import guarding
from tune_jobs.service.driver import warm_up


def _settings(folder: Path, *, warm: bool) -> dict[str, Any]:
    return {"modules": (), "working_folder": str(folder), "warm_ray": warm}


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tune_jobs.ray_tune.warm.warm_ray", lambda *_: contextlib.nullcontext())
    # The tests share one process for environments; a driver has its own.
    monkeypatch.setattr("policies.guard.guard._current", ContextVar("guard", default=None))
    monkeypatch.chdir(tmp_path)


def test_a_sweeps_environments_find_their_process_there_and_it_ends_with_the_driver(tmp_path: Path) -> None:
    others = _children()
    with contextlib.ExitStack() as stack:
        warm_up(stack, _settings(tmp_path, warm=True))
        kept = _children() - others
        assert len(kept) == 1
        with guarding() as guard:
            assert guard.run("measure_step", "CartPole-v1", env_args={})
            assert _children() - others == kept
    assert not _children() - others
    assert "tune_jobs.ray_tune.run_trials" in sys.modules


@pytest.mark.parametrize("starts", [True, False])
def test_all_is_imported_while_ray_starts_and_where_it_does_not(
    starts: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    @contextlib.contextmanager
    def ray(_: object, meanwhile: Callable[[], object]) -> Iterator[None]:
        if not starts:
            raise CannotRunError("There is no room.", "Make some.")
        done.append("starting")
        meanwhile()
        done.append("started")
        yield

    # In a thread of its own it would see modules of Ray half done.
    monkeypatch.setattr(
        "tune_jobs.service.driver._import_all", lambda: done.append(f"all in {threading.current_thread().name}")
    )
    monkeypatch.setattr("tune_jobs.ray_tune.warm.warm_ray", ray)
    with contextlib.ExitStack() as stack:
        warm_up(stack, _settings(tmp_path, warm=True))
        # Of what is imported already nothing is imported again.
        assert done == (["starting", "all in MainThread", "started"] if starts else []) + ["all in MainThread"]


def test_a_driver_that_is_not_kept_starts_no_process(tmp_path: Path) -> None:
    others = _children()
    with contextlib.ExitStack() as stack:
        warm_up(stack, _settings(tmp_path, warm=False))
        assert not _children() - others


def _children() -> set[str]:
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())
