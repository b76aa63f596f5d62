"""What is made of whole sweeps is kept within a number of bytes, and keeps no sweep's trials."""

import gc
import gzip
import json
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from policy_factory import make_portable
from store_parts import make_best
from sweep_folders import chosen, make_sweep_folder

from tests.narrowing import present
from tune_jobs.service import derived as module
from tune_jobs.service.busy import BusyError, without_waiting
from tune_jobs.service.derived import Derived
from tune_jobs.service.statuses import Statuses
from tune_jobs.store.opening import open_storage

NAMES = ("a", "b", "c")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("sweeps")
    for name in NAMES:
        make_sweep_folder(made / name)
    return made


@pytest.fixture
def statuses(folder: Path) -> Statuses:
    return Statuses(open_storage(folder))


@pytest.fixture
def derived(folder: Path, statuses: Statuses) -> Derived:
    return Derived(open_storage(folder), statuses)


def test_what_nobody_has_asked_for_the_longest_goes_where_bytes_are_short(
    derived: Derived, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = {name: len(derived.sweep_file(name)) for name in NAMES}
    assert derived.num_bytes == sum(sizes.values())
    kept = derived.sweep_file("a"), derived.sweep_file("c")
    monkeypatch.setattr(module, "_MOST_BYTES", sum(sizes.values()))
    text = derived.trials_csv("b")
    # The file of b has gone, whose turn was the longest ago.
    assert derived.num_bytes == sizes["a"] + sizes["c"] + len(text)
    assert derived.sweep_file("a") is kept[0]
    assert derived.sweep_file("c") is kept[1]


def test_the_last_is_kept_however_large_it_is(derived: Derived, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MOST_BYTES", 10)
    first = derived.sweep_file("a")
    assert derived.sweep_file("a") is first
    derived.sweep_file("b")
    assert derived.num_bytes == len(derived.sweep_file("b"))


def test_objects_count_by_what_they_hold(derived: Derived) -> None:
    derived.importance("a")
    small = derived.num_bytes
    derived.comparison(["a", "b"])
    assert 100 < small < derived.num_bytes < 10**6


def test_what_is_kept_is_told_while_something_else_is_made(derived: Derived, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, began, may_end = derived.trials_csv("a"), threading.Event(), threading.Event()

    def slow(_: Any) -> str:
        began.set()
        assert may_end.wait(60)
        return "made"

    monkeypatch.setattr("tune_jobs.sweeps.exports.trials_csv", slow)
    with ThreadPoolExecutor(3) as pool:
        try:
            made = pool.submit(derived.trials_csv, "b")
            assert began.wait(30)
            assert pool.submit(derived.trials_csv, "a").result(10) is kept
            # Whoever does not want to wait is told that there is something to wait for.
            with without_waiting(), pytest.raises(BusyError):
                derived.trials_csv("c")
            also_made = pool.submit(derived.trials_csv, "b")
        finally:
            may_end.set()
        assert made.result(30) == "made"
        assert also_made.result(30) is made.result()


def test_trials_of_a_sweep_that_is_gone_are_not_kept(derived: Derived, statuses: Statuses) -> None:
    derived.trials_csv("a")
    trials = weakref.ref(statuses.see("a").trials)
    assert trials() is not None
    statuses.forget("a")
    gc.collect()
    assert trials() is None


def test_a_winner_that_is_chosen_after_the_sweep_is_over_is_told_soon(tmp_path: Path) -> None:
    store, storage, now = make_sweep_folder(tmp_path / "mine"), open_storage(tmp_path), [100.0]
    statuses = Statuses(storage, lambda: now[0])
    derived = Derived(storage, statuses)

    def told() -> tuple[float, bool]:
        has_best = json.loads(gzip.decompress(derived.sweep_file("mine")))["best"] is not None
        return present(statuses.see("mine").status.best).score, has_best

    score, has_best = told()
    assert not has_best
    # As `tune-jobs best` does, which changes no record.
    store.write_best(make_best(selection_score=7.5, **chosen(store)), make_portable("CartPole-v1"))
    now[0] += 5.0
    assert told() == (7.5, True) != (score, has_best)
    seen = statuses.see("mine")
    now[0] += 5.0
    # Nothing is made anew where nothing has changed.
    assert statuses.see("mine").status is seen.status
    store.write_best(make_best(selection_score=8.5, **chosen(store)))
    now[0] += 5.0
    assert told() == (8.5, True)
