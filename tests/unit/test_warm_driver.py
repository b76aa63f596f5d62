"""A driver process that is kept for the next sweep has what a sweep needs before there is one."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import pytest

from policies.guard.guard import guarding
from tune_jobs.service.driver import warm_up


def _settings(folder: Path, *, warm: bool) -> dict[str, Any]:
    return {"modules": (), "working_folder": str(folder), "warm_ray": warm}


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tune_jobs.ray_tune.warm.warm_ray", lambda _: contextlib.nullcontext())
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


def test_it_is_warm_only_when_all_is_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def import_slowly() -> None:
        time.sleep(0.5)
        done.append("all")

    monkeypatch.setattr("tune_jobs.service.driver._import_all", import_slowly)
    with contextlib.ExitStack() as stack:
        warm_up(stack, _settings(tmp_path, warm=True))
        assert done == ["all"]


def test_a_driver_that_is_not_kept_starts_no_process(tmp_path: Path) -> None:
    others = _children()
    with contextlib.ExitStack() as stack:
        warm_up(stack, _settings(tmp_path, warm=False))
        assert not _children() - others


def _children() -> set[str]:
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())
