"""How a trial goes on from what is on disk, and how it ends when something goes wrong."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from fake_engine import FakeClock, FakeEngine
from trial_runs import Trial

from policies.envs.tallies import tally_of
from policies.errors import NonFiniteWeightsError
from tests.narrowing import present
from tune_jobs.store.ownership import Owner, OwnershipLostError
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.training.protocol import IterationStats

# -- going on


def test_a_trial_goes_on_from_its_latest_checkpoint(tmp_path: Path) -> None:
    """Opened by another process: results after the checkpoint are done again and stand there once."""
    first = Trial(tmp_path, scores=lambda i: -float(i), checkpoints={"every_iterations": 4, "keep": 1})
    first.run_to(6)
    assert [record.iteration for record in first.results] == [1, 2, 3, 4, 5, 6]
    assert first.kept == [1, 4]

    second = Trial(
        tmp_path, scores=lambda i: -float(i), stop={"num_iterations": 9}, checkpoints={"every_iterations": 4, "keep": 1}
    )
    assert second.engine.builds == ["000004"]
    assert second.loop.iteration == 4
    assert [record.iteration for record in second.results] == [1, 2, 3, 4]
    progress = second.run()
    assert (progress.num_iterations, progress.num_env_steps, progress.num_episodes) == (9, 900, 9)
    assert [record.iteration for record in second.results] == list(range(1, 10))
    # The best of before still is.
    assert (progress.best_iteration, progress.best_evaluation_return) == (1, -1.0)
    assert second.kept == [1, 9]


def test_results_are_written_before_the_checkpoint_that_counts_on_them(tmp_path: Path) -> None:
    """Killed right after it is saved, a trial goes on from it: results that were not written would leave a hole."""
    trial = Trial(tmp_path, evaluation={"every_iterations": 50})
    known = []
    trial.engine.save = lambda folder: known.append([record.iteration for record in trial.results])  # type: ignore[method-assign]
    trial.loop.advance(math.inf)
    assert known == [list(range(1, number + 1)) for number in (10, 20, 30, 40, 50)]


def test_a_trial_without_a_checkpoint_begins_again(tmp_path: Path) -> None:
    first = Trial(tmp_path, evaluation={"every_iterations": 50})
    first.loop.advance(-1.0)
    assert first.results
    second = Trial(tmp_path, evaluation={"every_iterations": 50})
    assert second.engine.builds == [None]
    assert (second.results, second.loop.iteration) == ([], 0)


def test_time_goes_on_where_it_was(tmp_path: Path) -> None:
    clock = FakeClock()
    first = Trial(tmp_path, clock=clock, checkpoints={"every_iterations": 1, "keep": 1})
    clock.now += 40.0
    assert first.loop.advance(math.inf).time_s == 40.0
    clock.now += 1_000.0  # nobody ran it
    second = Trial(tmp_path, clock=clock, stop={"time_s": 100.0}, checkpoints={"every_iterations": 1, "keep": 1})
    clock.now += 59.0
    progress = second.loop.advance(math.inf)
    assert (progress.time_s, progress.status) == (99.0, "running")
    clock.now += 1.0
    assert second.loop.advance(math.inf).status == "completed"


def test_the_window_of_100_episodes_goes_on_too(tmp_path: Path) -> None:
    task: dict[str, Any] = {
        "stop": {"training_return": 20.0, "num_iterations": 300}, "evaluation": {"every_iterations": 999},
        "checkpoints": {"every_iterations": 60, "keep": 1},
    }  # fmt: skip
    first = Trial(tmp_path, **task)
    for _ in range(70):
        first.loop.advance(-1.0)
    second = Trial(tmp_path, **task)
    assert second.loop.iteration == 60
    assert second.run().num_iterations == 100


def test_the_newest_score_goes_on_too(tmp_path: Path) -> None:
    task: dict[str, Any] = {"evaluation": {"every_iterations": 4}, "checkpoints": {"every_iterations": 3, "keep": 1}}
    first = Trial(tmp_path, **task)
    while first.loop.iteration < 6:
        first.loop.advance(-1.0)
    report = Trial(tmp_path, **task).loop.advance(-1.0)
    assert (report.num_iterations, report.evaluated, report.evaluation_return) == (7, False, 4.0)
    assert report.best_iteration == 4


def test_a_torn_last_line_is_dropped(tmp_path: Path) -> None:
    first = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 1})
    first.run_to(4)
    whole = first.store.results_path.read_text()
    with first.store.results_path.open("a") as file:
        file.write('{"iteration": 5, "num_env')
    assert [record.iteration for record in first.results] == [1, 2, 3, 4]
    second = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 1})
    assert second.store.results_path.read_text() == whole
    assert (second.store.folder / "results.damaged").read_text() == '{"iteration": 5, "num_env\n'
    assert "results.jsonl ended within a line" in second.store.log_path.read_text()
    second.run_to(6)
    assert [record.iteration for record in second.results] == [1, 2, 3, 4, 5, 6]


def test_half_written_checkpoints_are_removed_and_never_used(tmp_path: Path) -> None:
    first = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 1})
    first.run_to(2)
    half = first.store.checkpoints_folder / ".000004.123"
    shutil.copytree(first.store.checkpoints_folder / "000002", half)
    second = Trial(tmp_path)
    assert second.engine.builds == ["000002"]
    assert not half.exists()


# -- who trains it


def test_who_lost_the_trial_writes_nothing_any_more(tmp_path: Path) -> None:
    task: dict[str, Any] = {"checkpoints": {"every_iterations": 2, "keep": 9}, "stop": {"num_iterations": 9}}
    old = Trial(tmp_path, **task)
    old.run_to(3)
    new = Trial(tmp_path, **task)

    def everything() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    before = everything()
    with pytest.raises(OwnershipLostError, match="taken over by another process"):
        old.loop.advance(math.inf)
    with pytest.raises(OwnershipLostError):
        old.loop.pause()
    with pytest.raises(OwnershipLostError):
        old.store.take(Owner(tmp_path / ".owner", "of a run that is over"))
    assert everything() == before
    assert new.run().status == "completed"
    assert [record.iteration for record in new.results] == list(range(1, 10))


def test_a_trial_that_is_taken_while_a_checkpoint_is_written_keeps_none_of_it(tmp_path: Path) -> None:
    old = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 9})
    old.run_to(3)
    save, others = old.engine.save, []

    def taken_meanwhile(folder: Path) -> None:
        others.append(Trial(tmp_path, stop={"num_iterations": 6}))
        folder.mkdir(exist_ok=True)
        save(folder)

    old.engine.save = taken_meanwhile  # type: ignore[method-assign]
    with pytest.raises(OwnershipLostError):
        old.loop.advance(math.inf)
    (new,) = others
    assert new.engine.builds == ["000003"]
    assert sorted(path.name for path in new.store.checkpoints_folder.iterdir()) == ["000001", "000002", "000003"]
    assert new.run().status == "completed"


def test_a_trial_that_had_reached_its_end_is_done_at_once(tmp_path: Path) -> None:
    """Killed after its last checkpoint, before anybody was told."""
    Trial(tmp_path, stop={"num_iterations": 5}).run()
    again = Trial(tmp_path, stop={"num_iterations": 5})
    progress = again.loop.advance(math.inf)
    assert (progress.status, progress.stop_reason) == ("completed", "num_iterations 5 >= 5")
    assert (progress.num_iterations, progress.evaluation_return, progress.best_iteration) == (5, 5.0, 5)
    assert again.engine.iteration == 5
    assert len(again.results) == 5


def test_a_process_runs_one_trial_after_another(tmp_path: Path) -> None:
    engine = FakeEngine()
    for name in ("a", "b"):
        trial = Trial(tmp_path / name, engine=engine, stop={"num_iterations": 3})
        assert trial.run().num_iterations == 3
        assert len(trial.results) == 3
    assert engine.builds == [None, None]


# -- the end that nobody wants


def test_nan_weights_end_a_trial_as_failed(tmp_path: Path) -> None:
    trial = Trial(tmp_path, engine=FakeEngine(nan_from=5), checkpoints={"every_iterations": 2, "keep": 2})
    progress = trial.run()
    assert (progress.status, progress.num_iterations, progress.stop_reason) == ("failed", 5, None)
    assert "NaN" in present(progress.error)
    assert "iteration 5" in present(progress.error)
    assert progress.ended_at is not None
    # What was good before is there, and nothing of iteration 5 was saved.
    assert progress.best_iteration == 4
    assert trial.kept == [3, 4]
    assert [(r.iteration, r.evaluation_return) for r in trial.results][-2:] == [(4, 4.0), (5, None)]


def test_training_that_finds_nan_as_soon_as_it_goes_on_ends_where_it_was(tmp_path: Path) -> None:
    class Engine(FakeEngine):
        def train_iteration(self) -> IterationStats:
            raise NonFiniteWeightsError("The gradients of an update are NaN or infinite.", "Lower lr.")

    Trial(tmp_path, checkpoints={"every_iterations": 1, "keep": 1}).run_to(5)
    progress = Trial(tmp_path, engine=Engine()).run()
    assert (progress.status, progress.num_iterations, progress.num_env_steps) == ("failed", 5, 500)
    assert progress.training_return == 20.0


def test_training_that_finds_nan_itself_ends_a_trial_as_failed(tmp_path: Path) -> None:
    class Engine(FakeEngine):
        def train_iteration(self) -> IterationStats:
            if self.iteration == 3:
                present(tally_of("t0000")).add(40, 2)
                raise NonFiniteWeightsError("The gradients of an update are NaN or infinite.", "Lower lr.")
            return super().train_iteration()

    trial = Trial(tmp_path, engine=Engine(), evaluation={"every_iterations": 50}, hyperparams={"lr": 0.5, "gamma": 0.9})
    progress = trial.run()
    assert (progress.status, progress.num_iterations, progress.num_env_steps, progress.num_episodes) == (
        "failed",
        3,
        340,
        5,
    )
    assert progress.error == "The gradients of an update are NaN or infinite.\nLower lr. (iteration 4, lr 0.5)"
    trial.loop.flush()
    assert [record.iteration for record in trial.results] == [1, 2, 3]


def test_what_an_engine_raises_is_raised_and_what_was_done_is_written(tmp_path: Path) -> None:
    trial = Trial(tmp_path, engine=FakeEngine(raise_at=4), evaluation={"every_iterations": 50})
    with pytest.raises(ZeroDivisionError, match="the cart left the track"):
        trial.run()
    assert [record.iteration for record in trial.results] == [1, 2, 3]


def test_a_stop_request_pauses_with_a_checkpoint_of_this_very_iteration(tmp_path: Path) -> None:
    trial = Trial(tmp_path, evaluation={"every_iterations": 3})
    trial.run_to(3)
    trial.loop.advance(-1.0)
    SweepStore(tmp_path).request_stop()
    progress = trial.loop.advance(math.inf)
    assert (progress.status, progress.num_iterations, progress.stop_reason) == ("paused", 4, None)
    assert trial.kept == [3, 4]
    assert trial.store.checkpoints()[-1].evaluation_return is None
    assert progress.ended_at is not None
    SweepStore(tmp_path).clear_stop_request()
    again = Trial(tmp_path, evaluation={"every_iterations": 3})
    assert again.engine.builds == ["000004"]
    assert again.run_to(6).num_env_steps == 600


def test_a_stop_request_right_after_a_checkpoint_writes_no_other(tmp_path: Path) -> None:
    trial = Trial(tmp_path)
    trial.run_to(3)
    before = {path: path.stat().st_mtime_ns for path in trial.store.checkpoints_folder.rglob("*")}
    SweepStore(tmp_path).request_stop()
    assert trial.loop.advance(math.inf).status == "paused"
    assert {path: path.stat().st_mtime_ns for path in trial.store.checkpoints_folder.rglob("*")} == before


def test_a_stop_request_before_the_first_iteration_saves_nothing(tmp_path: Path) -> None:
    trial = Trial(tmp_path)
    SweepStore(tmp_path).request_stop()
    progress = trial.loop.advance(math.inf)
    assert (progress.status, progress.num_iterations, progress.checkpoints) == ("paused", 0, ())
    assert trial.kept == []


def test_results_tell_all_that_an_iteration_gave(tmp_path: Path) -> None:
    clock = FakeClock(step=0.5)
    engine = FakeEngine(lambda iteration: (float(iteration), -2.0))
    trial = Trial(tmp_path, engine=engine, clock=clock, stop={"num_iterations": 3}, evaluation={"every_iterations": 2})
    trial.run()
    lines = [json.loads(line) for line in trial.store.results_path.read_text().splitlines()]
    assert [line["num_episodes"] for line in lines] == [2, 4, 6]
    assert [line["episode_returns"] for line in lines] == [[1.0, -2.0], [2.0, -2.0], [3.0, -2.0]]
    assert lines[0]["episode_lengths"] == [7, 7]
    assert lines[1]["learner"] == {"total_loss": 0.5}
    assert [line["evaluation_return"] for line in lines] == [None, 2.0, 3.0]
    times = [line["time_s"] for line in lines]
    assert times == sorted(times)
    assert times[0] > 0
