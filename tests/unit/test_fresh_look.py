"""A request to stop that came from another machine is seen soon, also on NFS, which believes that there is none."""

import math
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tune_jobs.store import fresh_look
from tune_jobs.store.fresh_look import FreshLook
from tune_jobs.store.sweep_store import SweepStore


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The folders that were opened."""
    seen: list[Path] = []
    real = os.open

    def call(path: str | Path, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        if flags & os.O_DIRECTORY:
            seen.append(Path(path))
        return real(path, flags, mode, dir_fd=dir_fd)

    monkeypatch.setattr(os, "open", call)
    return seen


def test_a_folder_is_looked_at_anew_once_a_second(tmp_path: Path, opened: list[Path]) -> None:
    now = 0.0
    look = FreshLook(tmp_path, lambda: now)
    for now in (0.0, 0.1, 0.99, 1.0, 1.5, 2.0):  # noqa: B007 (the clock's)
        look.take()
    assert opened == [tmp_path] * 3
    # On another machine, where it was carried to, which began later.
    now = 0.5
    look.take()
    assert opened == [tmp_path] * 4
    FreshLook(tmp_path / "gone").take()


def test_a_stop_that_another_machine_asked_for_is_seen_within_a_second(
    tmp_path: Path, opened: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    real: Callable[[Path], bool] = Path.exists
    store = SweepStore(tmp_path / "mine")
    store.create()
    assert not store.stop_requested()
    SweepStore(store.folder).request_stop()
    opened.clear()
    monkeypatch.setattr(fresh_look, "_EVERY_S", math.inf)
    # What a client of NFS answers until the folder is opened.
    monkeypatch.setattr(Path, "exists", lambda path: bool(opened) and real(path))
    assert not store.stop_requested()
    monkeypatch.setattr(fresh_look, "_EVERY_S", 0.0)
    assert store.stop_requested()
