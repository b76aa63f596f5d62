"""The life of a pack's members: trained and evaluated together, ended, failed and retried each for itself."""

import contextlib
import itertools
import math
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_engine import FakeClock, FakeEngine
from fake_pack import Pack, results, statuses, without_episodes, without_times
from trial_runs import Trial

from policies.errors import CheckpointError, EnvError
from tests.narrowing import present
from tune_jobs.store.ownership import Owner
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.protocol import IterationStats, TrialTask

# -- together


def test_each_member_is_told_of_as_a_trial_of_its_own(tmp_path: Path) -> None:
    """Score, stop rule, checkpoints and results are those of the same trial without a pack."""
    task: dict[str, Any] = {
        "stop": {"evaluation_return": 8.0, "num_iterations": 30},
        "evaluation": {"every_iterations": 4},
    }
    alone = Trial(tmp_path / "alone", **task)
    expected = alone.run()
    pack = Pack(tmp_path / "pack", **task).add("t0000", "t0001", "t0002").run()
    for trial_id in ("t0000", "t0001", "t0002"):
        progress = pack.last(trial_id)
        assert (progress.status, progress.stop_reason) == ("completed", "evaluation_return 8 >= 8")
        assert [record.iteration for record in progress.checkpoints] == alone.kept
        assert without_times(progress.model_copy(update={"checkpoints": (), "iterations": ()})) == without_times(
            expected.model_copy(update={"checkpoints": (), "iterations": ()})
        )
        assert pack.store(trial_id).read_iterations() == alone.results
        told = [item for report in pack.of(trial_id) for item in present(report.progress).iterations]
        assert told == [without_episodes(item) for item in alone.results]
        assert [record.iteration for record in pack.store(trial_id).checkpoints()] == alone.kept
    assert pack.loop.trial_ids == ()
    assert pack.engine.members == {}


def test_members_are_evaluated_together_when_it_is_their_turn(tmp_path: Path) -> None:
    pack = Pack(tmp_path, stop={"num_iterations": 6}, evaluation={"every_iterations": 3}).add("t0000", "t0001")
    pack.advance()
    # It comes later, and so do its evaluations.
    pack.add("t0002").run()
    assert pack.batches == [2, 1, 2, 1]
    assert [statuses(pack)[name] for name in ("t0000", "t0001", "t0002")] == ["completed"] * 3
    assert [results(pack, name) for name in ("t0000", "t0002")] == [list(range(1, 7))] * 2


def test_evaluations_are_reported_each_and_of_the_others_where_they_stand(tmp_path: Path) -> None:
    pack = Pack(tmp_path, evaluation={"every_iterations": 2}, stop={"num_iterations": 9}, clock=FakeClock(step=0.001))
    reports = pack.add("t0000").advance(0.2)
    told = [(present(report.progress).num_iterations, present(report.progress).evaluated) for report in reports]
    iterations = [iteration for iteration, evaluated in told if evaluated]
    assert iterations[:3] == [2, 4, 6]
    assert told == sorted(told)
    # One report of the running iteration at most.
    assert sum(not evaluated for _, evaluated in told) <= 1


def test_a_scheduler_hears_of_an_evaluation_before_the_next_iteration(tmp_path: Path) -> None:
    pack = Pack(tmp_path, evaluation={"every_iterations": 3}).add("t0000", "t0001")
    reports = pack.advance(math.inf, until_evaluated=True)
    assert [(report.trial_id, present(report.progress).num_iterations) for report in reports] == [
        ("t0000", 3),
        ("t0001", 3),
    ]
    assert pack.engine.num_iterations == 3


def test_a_report_comes_after_so_many_seconds_and_is_on_disk(tmp_path: Path) -> None:
    pack = Pack(tmp_path, clock=FakeClock(step=0.1), evaluation={"every_iterations": 99}).add("t0000", "t0001")
    reports = pack.advance(3.0)
    (first, second) = [present(report.progress) for report in reports]
    assert 1 < first.num_iterations == second.num_iterations < 99
    assert not first.evaluated
    assert results(pack, "t0001") == list(range(1, first.num_iterations + 1))


def test_it_returns_when_a_quarter_has_ended_so_that_others_can_have_their_slots(tmp_path: Path) -> None:
    scripts = {f"t000{index}": FakeEngine(steps=100 * (8 - index)) for index in range(8)}
    pack = Pack(tmp_path, scripts.__getitem__, stop={"num_env_steps": 4_000}, evaluation={"every_iterations": 999})
    pack.add(*scripts).advance(math.inf)
    assert pack.loop.trial_ids == tuple(f"t000{index}" for index in range(2, 8))


# -- come and go


def test_members_come_and_go_and_the_others_do_not_notice(tmp_path: Path) -> None:
    pack = Pack(tmp_path, stop={"num_iterations": 10}).add("t0000", "t0001")
    for _ in range(4):
        pack.advance()
    pack.loop.end("t0000")
    pack.add("t0002")
    pack.run()
    assert pack.engine.builds == [("t0000", None), ("t0001", None), ("t0002", None)]
    ended = pack.last("t0000")
    assert (ended.status, ended.num_iterations, ended.stop_reason) == ("stopped", 4, None)
    assert ended.ended_at is not None
    assert ended.checkpoints[-1].iteration == 4
    assert results(pack, "t0000") == [1, 2, 3, 4]
    for trial_id in ("t0001", "t0002"):
        assert results(pack, trial_id) == list(range(1, 11))
        assert pack.last(trial_id).status == "completed"


def test_a_member_that_is_ended_saves_where_it_is_unless_it_has(tmp_path: Path) -> None:
    pack = Pack(tmp_path, evaluation={"every_iterations": 3}).add("t0000", "t0001", "t0002")
    for _ in range(3):
        pack.advance()
    before = {path: path.stat().st_mtime_ns for path in pack.store("t0000").checkpoints_folder.rglob("*")}
    pack.loop.end("t0000")
    assert {path: path.stat().st_mtime_ns for path in pack.store("t0000").checkpoints_folder.rglob("*")} == before
    pack.advance()
    pack.loop.end("t0001")
    assert [record.iteration for record in pack.store("t0001").checkpoints()] == [3, 4]
    # The driver ended it before it was ever built.
    pack.add("t0009")
    pack.loop.end("t0009")
    assert pack.loop.trial_ids == ("t0002",)
    pack.advance()
    assert pack.of("t0009") == []


def test_an_empty_pack_reports_at_once(tmp_path: Path) -> None:
    assert Pack(tmp_path).advance(math.inf) == []


# -- stop requests


def test_a_stop_request_saves_and_pauses_all(tmp_path: Path) -> None:
    pack = Pack(tmp_path, evaluation={"every_iterations": 3}).add("t0000", "t0001")
    for _ in range(4):
        pack.advance()
    pack.add("t0002")
    pack.stop = True
    reports = pack.advance(math.inf)
    assert [(present(report.progress).status, present(report.progress).num_iterations) for report in reports] == [
        ("paused", 4),
        ("paused", 4),
        ("paused", 0),
    ]
    assert [record.iteration for record in pack.store("t0001").checkpoints()] == [3, 4]
    assert pack.engine.num_iterations == 4
    again = Pack(tmp_path, evaluation={"every_iterations": 3}, stop={"num_iterations": 6}).add("t0000", "t0001").run()
    assert again.engine.builds == [("t0000", 4), ("t0001", 4)]
    assert results(again, "t0000") == [1, 2, 3, 4, 5, 6]


def test_a_member_that_cannot_save_when_all_stop_can_still_go_on_later(tmp_path: Path) -> None:
    class Full(FakeEngine):
        def save(self, folder: Path) -> None:
            raise OSError("No space left on device")

    scripts = {"t0000": Full(), "t0001": FakeEngine()}
    pack = Pack(tmp_path, scripts.__getitem__, evaluation={"every_iterations": 99}).add(*scripts)
    pack.advance()
    pack.stop = True
    failed, paused = pack.advance(math.inf)
    assert (failed.trial_id, failed.retried) == ("t0000", True)
    assert "No space left" in present(failed.error)
    assert (paused.trial_id, present(paused.progress).status) == ("t0001", "paused")
    assert pack.loop.trial_ids == ()


# -- failures


def test_a_member_that_always_fails_fails_alone(tmp_path: Path) -> None:
    scripts = {"t0001": lambda: FakeEngine(raise_at=3)}
    pack = Pack(tmp_path, lambda name: scripts.get(name, FakeEngine)(), max_retries=2, stop={"num_iterations": 9})
    pack.add("t0000", "t0001", "t0002").run()
    failures = [report for report in pack.of("t0001") if report.error is not None]
    assert [report.retried for report in failures] == [True, True, False]
    assert present(failures[-1].error).startswith("ZeroDivisionError: the cart left the track")
    # And where, from its own log; a message on purpose comes without the name of its class.
    assert "fake_engine.py" in present(failures[-1].error)
    log = pack.store("t0001").log_path.read_text()
    assert log.count("ZeroDivisionError: the cart left the track") == 3
    assert "built from seed 1024" in log
    assert "built from checkpoint 000002" in log
    # From its checkpoint of iteration 2, each time; the others were built once.
    assert [build for build in pack.engine.builds if build[0] == "t0001"] == [("t0001", None)] + [("t0001", 2)] * 2
    for trial_id in ("t0000", "t0002"):
        assert results(pack, trial_id) == list(range(1, 10))
        assert not any(report.error for report in pack.of(trial_id))
        assert "ZeroDivisionError" not in pack.store(trial_id).log_path.read_text()
    assert pack.engine.num_iterations < 9 + 4


def test_a_members_error_may_hold_what_is_no_text(tmp_path: Path) -> None:
    scripts = {"t0001": lambda: FakeEngine(raise_at=3, says="a \udcff")}
    pack = Pack(tmp_path, lambda name: scripts.get(name, FakeEngine)(), stop={"num_iterations": 5})
    pack.add("t0000", "t0001").run()
    assert present(pack.of("t0001")[-1].error).startswith("ZeroDivisionError: a \\udcff")
    assert "ZeroDivisionError: a \\udcff" in pack.store("t0001").log_path.read_text()
    assert results(pack, "t0000") == list(range(1, 6))


def test_a_member_that_failed_once_ends_as_if_it_had_not(tmp_path: Path) -> None:
    counts = itertools.count()
    scripts = {"t0001": lambda: FakeEngine(raise_at=5 if next(counts) == 0 else None)}
    pack = Pack(
        tmp_path, lambda name: scripts.get(name, FakeEngine)(), max_retries=1, stop={"num_iterations": 9},
        checkpoints={"every_iterations": 2, "keep": 9}, scores=lambda _: 0.0,
    )  # fmt: skip
    pack.add("t0000", "t0001").run()
    assert [report.retried for report in pack.of("t0001") if report.error] == [True]
    assert ("t0001", 4) in pack.engine.builds
    assert (pack.last("t0001").status, results(pack, "t0001")) == ("completed", list(range(1, 10)))
    assert results(pack, "t0000") == list(range(1, 10))


def test_failures_before_the_pack_was_started_again_count(tmp_path: Path) -> None:
    pack = Pack(tmp_path, lambda name: FakeEngine(raise_at=1), max_retries=2).add("t0000", num_failures=2).run()
    assert [report.retried for report in pack.reports] == [False]


def test_a_member_that_cannot_be_built_is_retried_and_given_up(tmp_path: Path) -> None:
    class Refuses(FakeEngine):
        def build(self, task: TrialTask, checkpoint: Path | None) -> None:
            raise CheckpointError("Checkpoint 000003 cannot be restored.", "Use another one.")

    scripts = {"t0000": Refuses(), "t0001": FakeEngine()}
    pack = Pack(tmp_path, scripts.__getitem__, max_retries=1, stop={"num_iterations": 2}).add(*scripts).run()
    first, second = pack.of("t0000")
    assert (first.retried, second.retried) == (True, False)
    assert present(first.error).startswith("Checkpoint 000003 cannot be restored.")
    assert pack.last("t0001").status == "completed"


def test_a_member_whose_latest_checkpoint_is_damaged_goes_on_from_the_one_before(tmp_path: Path) -> None:
    Pack(tmp_path, stop={"num_iterations": 3}).add("t0000", "t0001").run()
    (tmp_path / "trials/t0000/checkpoints/000003/engine.json").write_text("{}")
    pack = Pack(tmp_path, stop={"num_iterations": 5}).add("t0000", "t0001").run()
    assert pack.engine.builds == [("t0000", 2), ("t0001", 3)]
    assert [report.error for report in pack.reports] == [None] * len(pack.reports)
    assert [pack.last(name).status for name in ("t0000", "t0001")] == ["completed", "completed"]
    assert "checkpoint 000003 is damaged" in pack.last("t0000").notes[0]
    assert pack.last("t0001").notes == ()
    assert "goes on from checkpoint 000002" in pack.store("t0000").log_path.read_text()


def test_a_member_that_another_process_took_is_let_go_and_has_not_failed(tmp_path: Path) -> None:
    pack = Pack(tmp_path, stop={"num_iterations": 6}, max_retries=3).add("t0000", "t0001")
    pack.advance()
    before = pack.store("t0000").read_iterations()
    other = Pack(tmp_path, stop={"num_iterations": 6}).add("t0000")
    other.advance()
    pack.run()
    (news,) = [report for report in pack.of("t0000") if report.lost]
    assert (news.progress, news.error) == (None, None)
    assert not [report for report in pack.reports if report.error is not None]
    assert pack.last("t0001").status == "completed"
    assert list(pack.engine.members) == []
    other.run()
    assert other.last("t0000").status == "completed"
    iterations = [record.iteration for record in other.store("t0000").read_iterations()]
    assert iterations == [1, 2, 3, 4, 5, 6]
    assert before[0].iteration == 1


def test_whose_files_went_away_because_another_process_took_it_has_not_failed(tmp_path: Path) -> None:
    """What another owner removes under its hands is no failure of the trial."""

    def script(trial_id: str) -> FakeEngine:
        engine = FakeEngine()
        save, folder = engine.save, tmp_path

        def taken_meanwhile(target: Path) -> None:
            TrialStore(folder, trial_id).take()
            shutil.rmtree(target)
            save(target)

        if trial_id == "t0000":
            engine.save = taken_meanwhile  # type: ignore[method-assign,assignment]
        return engine

    pack = Pack(tmp_path, script, stop={"num_iterations": 2}).add("t0000", "t0001").run()
    assert [report.lost for report in pack.of("t0000")] == [True]
    assert pack.last("t0001").status == "completed"
    assert not list((tmp_path / "trials/t0000/checkpoints").iterdir())


def test_a_pack_that_is_anothers_by_now_takes_nobody_up(tmp_path: Path) -> None:
    old = Owner.take(tmp_path / "packs" / ".p00.owner")
    Owner.take(tmp_path / "packs" / ".p00.owner")
    pack = Pack(tmp_path, under=old, stop={"num_iterations": 2}).add("t0000").run()
    assert [report.lost for report in pack.reports] == [True]
    assert pack.engine.builds == []
    assert not pack.store("t0000").results_path.exists()


def test_an_evaluation_that_fails_is_its_members_failure(tmp_path: Path) -> None:
    def scores(iteration: int) -> float:
        if iteration == 4:
            raise EnvError("CartPole-v1 raised an error in step().", "Mend the env.")
        return float(iteration)

    # The first is evaluated at iteration 4, the second at 3 and 5.
    pack = Pack(tmp_path, scores=scores, stop={"num_iterations": 5}, evaluation={"every_iterations": 4}).add("t0000")
    pack.task = {**pack.task, "evaluation": {"every_iterations": 3}}
    pack.add("t0001").run()
    assert "raised an error in step()" in present(pack.of("t0000")[-1].error)
    assert pack.last("t0001").status == "completed"


def test_nan_weights_end_a_member_as_failed_and_it_is_not_retried(tmp_path: Path) -> None:
    scripts = {"t0001": lambda: FakeEngine(nan_from=4)}
    pack = Pack(tmp_path, lambda name: scripts.get(name, FakeEngine)(), max_retries=5, stop={"num_iterations": 6})
    pack.add("t0000", "t0001").run()
    ended = pack.last("t0001")
    assert (ended.status, ended.num_iterations) == ("failed", 4)
    assert "NaN" in present(ended.error)
    assert ended.best_iteration == 3
    assert pack.engine.builds.count(("t0001", None)) == 1
    assert results(pack, "t0001") == [1, 2, 3, 4]
    assert results(pack, "t0000") == [1, 2, 3, 4, 5, 6]


def test_what_concerns_no_single_member_is_raised_and_what_was_done_is_on_disk(tmp_path: Path) -> None:
    pack = Pack(tmp_path, evaluation={"every_iterations": 99}).add("t0000", "t0001")
    train = pack.engine.train_iteration

    def out_of_memory(held: Collection[str] = ()) -> dict[str, IterationStats | Exception]:
        if pack.engine.num_iterations == 3:
            raise MemoryError("the stack does not fit")
        return train()

    pack.engine.train_iteration = out_of_memory  # type: ignore[method-assign]
    with pytest.raises(MemoryError):
        pack.loop.advance(math.inf, until_evaluated=False)
    assert results(pack, "t0000") == results(pack, "t0001") == [1, 2, 3]


# -- killed


def test_a_killed_pack_goes_on_from_its_members_checkpoints(tmp_path: Path) -> None:
    task: dict[str, Any] = {"stop": {"num_iterations": 9}, "evaluation": {"every_iterations": 99},
            "checkpoints": {"every_iterations": 3, "keep": 1}}  # fmt: skip
    first = Pack(tmp_path, **task).add("t0000", "t0001")
    for _ in range(4):
        first.advance()
    first.add("t0002").advance()
    assert results(first, "t0000") == [1, 2, 3, 4, 5]
    # Nobody told it: the process is gone, and another one opens the same trials.
    second = Pack(tmp_path, **task).add("t0000", "t0001", "t0002").run()
    assert second.engine.builds == [("t0000", 3), ("t0001", 3), ("t0002", None)]
    for trial_id in ("t0000", "t0001", "t0002"):
        assert results(second, trial_id) == list(range(1, 10))
        assert second.last(trial_id).status == "completed"


def test_a_member_that_had_reached_its_end_is_done_at_once(tmp_path: Path) -> None:
    Pack(tmp_path, stop={"num_iterations": 3}).add("t0000").run()
    pack = Pack(tmp_path, stop={"num_iterations": 3}).add("t0000")
    (report,) = pack.advance()
    assert (present(report.progress).status, present(report.progress).num_iterations) == ("completed", 3)
    assert pack.engine.num_iterations == 0


def test_everything_that_may_hang_is_watched_by_the_longest_time_limit(tmp_path: Path) -> None:
    entered: list[float] = []
    open_now: list[float] = []

    @contextlib.contextmanager
    def watch(seconds: float) -> Iterator[None]:
        assert not open_now
        open_now.append(seconds)
        entered.append(seconds)
        yield
        open_now.clear()

    class Watched(FakeEngine):
        def build(self, task: TrialTask, checkpoint: Path | None) -> None:
            assert open_now
            super().build(task, checkpoint)

        def train_iteration(self) -> IterationStats:
            assert open_now
            return super().train_iteration()

    pack = Pack(tmp_path, lambda name: Watched(), watch=watch, stop={"num_iterations": 1}, iteration_timeout_s=7.0)
    pack.add("t0000")
    pack.task = {**pack.task, "iteration_timeout_s": 9.0}
    pack.add("t0001").run()
    # Both are taken together, and built one after the other.
    assert entered == [9.0, 7.0, 9.0, 9.0]
