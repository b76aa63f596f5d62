"""What may hang in a pack beside its iterations is watched: that a member is closed, and what is saved before."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fake_engine import FakeEngine
from fake_pack import Pack, statuses

from policies.errors import EnvError
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.protocol import TrialTask


class Watched:
    """A pack, and under which time limits its members are saved and closed, and their results written."""

    def __init__(
        self,
        folder: Path,
        monkeypatch: pytest.MonkeyPatch,
        engine: Callable[[str], FakeEngine] = lambda trial_id: FakeEngine(),
    ) -> None:
        self.open_now: list[float] = []
        self.seen: list[tuple[str, str, list[float]]] = []
        # The first checkpoint is the best, so that the second iteration is saved only where a member leaves.
        self.pack = Pack(folder, engine, scores=lambda i: -float(i), watch=self.watch, iteration_timeout_s=7.0)
        save, remove, write = self.pack.engine.save, self.pack.engine.remove, TrialStore.append_iterations

        def note(what: str, trial_id: str) -> None:
            self.seen.append((what, trial_id, list(self.open_now)))

        def note_save(trial_id: str, folder: Path) -> None:
            note("saved", trial_id)
            save(trial_id, folder)

        def note_remove(trial_id: str) -> None:
            note("closed", trial_id)
            remove(trial_id)

        def note_written(store: TrialStore, records: list[object]) -> None:
            note("written", store.trial_id)
            write(store, records)  # type: ignore[arg-type]

        monkeypatch.setattr(self.pack.engine, "save", note_save)
        monkeypatch.setattr(self.pack.engine, "remove", note_remove)
        monkeypatch.setattr(TrialStore, "append_iterations", note_written)

    @contextlib.contextmanager
    def watch(self, seconds: float) -> Iterator[None]:
        # There is one timer.
        assert not self.open_now
        self.open_now.append(seconds)
        try:
            yield
        finally:
            self.open_now.clear()


def test_a_member_that_is_ended_or_opened_again_is_closed_within_its_time_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = Watched(tmp_path, monkeypatch)
    pack = watched.pack.add("t0000", "t0001")
    task = pack.loop._members["t0001"].task
    pack.advance()
    pack.advance()
    watched.seen.clear()
    pack.loop.end("t0000")
    pack.loop.reopen(task)
    acts = {(what, trial_id) for what, trial_id, _ in watched.seen}
    assert acts >= {("saved", "t0000"), ("closed", "t0000"), ("closed", "t0001")}
    assert [limits for _, _, limits in watched.seen] == [[7.0]] * len(watched.seen)
    pack.advance()
    assert statuses(pack)["t0000"] == "stopped"
    assert pack.loop.trial_ids == ("t0001",)


def test_a_member_that_waits_is_closed_within_its_time_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(tmp_path, monkeypatch)
    pack = watched.pack.add("t0000")
    pack.advance()
    pack.loop.hold({"t0000": 100})
    pack.advance()
    watched.seen.clear()
    pack.loop.end("t0000")
    assert ("closed", "t0000", [7.0]) in watched.seen
    assert pack.loop.trial_ids == ()


def test_results_are_written_at_the_end_within_the_longest_time_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = Watched(tmp_path, monkeypatch)
    pack = watched.pack.add("t0000")
    pack.task = {**pack.task, "iteration_timeout_s": 9.0}
    pack.add("t0001").advance()
    assert [seen for seen in watched.seen if seen[0] == "written"][-2:] == [
        ("written", "t0000", [9.0]),
        ("written", "t0001", [9.0]),
    ]


def test_a_member_that_cannot_be_built_is_closed_within_its_time_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken(FakeEngine):
        def build(self, task: TrialTask, checkpoint: Path | None) -> None:
            raise EnvError("It has no screen.")

    watched = Watched(tmp_path, monkeypatch, lambda trial_id: Broken() if trial_id == "t0000" else FakeEngine())
    pack = watched.pack.add("t0000", "t0001")
    pack.advance()
    assert ("written", "t0000", [7.0]) in watched.seen
    assert [report.error is not None for report in pack.of("t0000")] == [True]
    assert pack.loop.trial_ids == ("t0001",)
