"""The life of a trial: when it ends, when it is evaluated, what is kept, and how it goes on."""

import json
import math
import shutil

import pytest
from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task

from policies.errors import CheckpointError
from policies.evaluate import Evaluator
from policies.portable import read_policy
from tune_jobs.store import SweepStore, TrialStore
from tune_jobs.trial import TrialLoop


class Trial:
    """A loop and its fakes; `open` is called."""

    def __init__(self, folder, *, engine=None, scores=float, clock=None, **task):
        self.engine = engine or FakeEngine()
        self.evaluator = FakeEvaluator(scores)
        self.store = TrialStore(folder, "t0000")
        self.loop = TrialLoop(make_task(folder, **task), self.engine, self.evaluator, clock or FakeClock())
        self.loop.open()

    def run(self, max_reports=1_000):
        """To the end; returns the last report."""
        for _ in range(max_reports):
            progress = self.loop.advance(math.inf)
            if progress.status != "running":
                break
        return progress

    def run_to(self, iteration):
        """Until so many iterations are done, evaluated each."""
        while self.loop.iteration < iteration:
            progress = self.loop.advance(math.inf)
        return progress

    @property
    def kept(self):
        return [record.iteration for record in self.store.checkpoints()]

    @property
    def results(self):
        return self.store.read_iterations()


# -- stop rules


@pytest.mark.parametrize(
    ("stop", "iterations", "reason"),
    [
        ({"num_iterations": 7}, 7, "num_iterations 7 >= 7"),
        ({"num_env_steps": 450}, 5, "num_env_steps 500 >= 450"),
        ({"num_env_steps": 500}, 5, "num_env_steps 500 >= 500"),
        ({"evaluation_return": 6.0}, 6, "evaluation_return 6 >= 6"),
        ({"evaluation_return": 5.5}, 6, "evaluation_return 6 >= 5.5"),
        # Whichever comes first.
        ({"evaluation_return": 9.0, "num_env_steps": 300, "num_iterations": 5}, 3, "num_env_steps 300 >= 300"),
    ],
)
def test_a_trial_ends_by_the_first_rule_that_holds(tmp_path, stop, iterations, reason):
    progress = Trial(tmp_path, stop=stop).run()
    assert (progress.status, progress.iteration, progress.stop_reason) == ("completed", iterations, reason)
    assert progress.num_env_steps == 100 * iterations
    assert progress.ended_at >= progress.started_at


def test_a_trial_ends_after_so_many_seconds(tmp_path):
    clock = FakeClock(step=1.0)
    progress = Trial(tmp_path, clock=clock, stop={"time_s": 30.0}).run()
    assert progress.stop_reason.startswith("time_s ")
    assert progress.stop_reason.endswith(" >= 30")
    assert 30 <= progress.time_s < 40


def test_the_hard_caps_hold_where_nothing_else_is_set(tmp_path):
    """No rule given: the defaults end it all the same."""
    progress = Trial(tmp_path, engine=FakeEngine(steps=50_000), stop={}, evaluation={"every_iterations": 1_000}).run()
    assert progress.stop_reason == "num_env_steps 200000 >= 200000"


def test_training_return_counts_100_whole_episodes_and_no_fewer(tmp_path):
    """One episode an iteration, from the first with the wanted return: only after 100 of them is it a mean."""
    stop = {"training_return": 195.0, "num_iterations": 300}
    trial = Trial(tmp_path, engine=FakeEngine(lambda _: (195.0,)), stop=stop, evaluation={"every_iterations": 999})
    progress = trial.run()
    assert (progress.iteration, progress.stop_reason) == (100, "training_return 195 >= 195")
    assert progress.num_episodes == 100


def test_training_return_is_of_the_last_100_episodes(tmp_path):
    """Three episodes an iteration. The first 20 iterations are bad; they leave the window one by one."""
    engine = FakeEngine(lambda iteration: (0.0,) * 3 if iteration <= 20 else (200.0,) * 3)
    stop = {"training_return": 200.0, "num_iterations": 300}
    trial = Trial(tmp_path, engine=engine, stop=stop, evaluation={"every_iterations": 999})
    progress = trial.run()
    # 100 episodes of 200 are there after 34 more iterations.
    assert progress.iteration == 54
    assert progress.training_return == 200.0
    returns = [value for record in trial.results for value in record.episode_returns]
    for record in trial.results:
        window = returns[max(0, record.num_episodes - 100) : record.num_episodes]
        assert record.training_return == pytest.approx(sum(window) / len(window))


def test_more_than_100_episodes_in_an_iteration(tmp_path):
    engine = FakeEngine(lambda _: (0.0,) * 50 + (10.0,) * 100)
    progress = Trial(tmp_path, engine=engine, stop={"training_return": 10.0}).run()
    assert (progress.iteration, progress.num_episodes, progress.training_return) == (1, 150, 10.0)


def test_iterations_without_an_ended_episode(tmp_path):
    trial = Trial(tmp_path, engine=FakeEngine(lambda i: (5.0,) if i == 3 else ()), stop={"num_iterations": 4})
    progress = trial.run()
    assert [record.training_return for record in trial.results] == [None, None, 5.0, 5.0]
    assert progress.num_episodes == 1


@pytest.mark.parametrize("target", [0.0, -3.0])
def test_scores_of_zero_and_below_stop_a_trial_too(tmp_path, target):
    rising = lambda iteration: -10.0 + iteration  # noqa: E731
    progress = Trial(tmp_path / "a", scores=rising, stop={"evaluation_return": target}).run()
    assert progress.iteration == 10 + target
    engine = FakeEngine(lambda iteration: (rising(iteration),) * 100)
    progress = Trial(tmp_path / "b", engine=engine, scores=rising, stop={"training_return": target}).run()
    assert progress.iteration == 10 + target


# -- evaluation


def test_evaluations_come_at_multiples_and_at_the_end(tmp_path):
    trial = Trial(tmp_path, evaluation={"every_iterations": 4}, stop={"num_iterations": 10})
    trial.run()
    assert trial.evaluator.evaluated == [4, 8, 10]
    scores = {record.iteration: record.evaluation_return for record in trial.results}
    assert scores == {i: (float(i) if i in (4, 8, 10) else None) for i in range(1, 11)}


def test_each_evaluation_is_reported_at_once(tmp_path):
    """Schedulers compare at it: a report must be of that very iteration."""
    trial = Trial(tmp_path, evaluation={"every_iterations": 4}, stop={"num_iterations": 10})
    reports = [trial.loop.advance(math.inf) for _ in range(3)]
    assert [(report.iteration, report.evaluated, report.evaluation_return) for report in reports] == [
        (4, True, 4.0),
        (8, True, 8.0),
        (10, True, 10.0),
    ]


def test_reports_between_evaluations_come_after_so_many_seconds(tmp_path):
    clock = FakeClock(step=0.25)
    trial = Trial(tmp_path, clock=clock, evaluation={"every_iterations": 50})
    report = trial.loop.advance(3.0)
    assert (report.status, report.evaluated, report.evaluation_return) == ("running", False, None)
    assert 1 < report.iteration < 50
    # What is reported is on disk.
    assert trial.results[-1].iteration == report.iteration
    trial.run_to(50)
    report = trial.loop.advance(1.0)
    # The newest score, of an earlier iteration.
    assert (report.evaluated, report.evaluation_return) == (False, 50.0)


def test_an_iteration_longer_than_the_interval_is_reported_alone(tmp_path):
    trial = Trial(tmp_path, clock=FakeClock(step=100.0), evaluation={"every_iterations": 50}, stop={"time_s": 1e6})
    assert [trial.loop.advance(1.0).iteration for _ in range(3)] == [1, 2, 3]


def test_the_evaluation_is_the_mean_of_greedy_episodes_of_the_very_policy(tmp_path):
    """With the real evaluator: the checkpoint's own policy file gives the score that is in its manifest."""
    task = make_task(tmp_path, stop={"num_iterations": 2})
    with Evaluator("CartPole-v1", {}, (1, 2)) as evaluator:
        loop = TrialLoop(task, FakeEngine(), evaluator)
        loop.open()
        loop.advance(0.0)
        progress = loop.advance(0.0)
        assert progress.status == "completed"
        from policies.policy import NetworkPolicy

        for record in progress.checkpoints:
            episodes = evaluator.run(NetworkPolicy(read_policy(tmp_path / record.path)))
            assert record.evaluation_return == pytest.approx(episodes.mean_return)


def test_a_score_that_is_no_number_is_none_and_never_the_best(tmp_path):
    scores = {1: -5.0, 2: math.nan, 3: math.inf, 4: -7.0}
    checkpoints = {"every_iterations": 1, "keep": 9}
    trial = Trial(tmp_path, scores=scores.get, stop={"num_iterations": 4}, checkpoints=checkpoints)
    progress = trial.run()
    assert [record.evaluation_return for record in progress.checkpoints] == [-5.0, None, None, -7.0]
    assert (progress.best_iteration, progress.best_evaluation_return) == (1, -5.0)


def test_the_end_is_reported_with_the_iteration_that_reached_it(tmp_path):
    trial = Trial(tmp_path, stop={"evaluation_return": 3.0})
    reports = [trial.loop.advance(math.inf) for _ in range(3)]
    assert [(report.status, report.iteration) for report in reports] == [
        ("running", 1),
        ("running", 2),
        ("completed", 3),
    ]


def test_the_time_of_a_trial_is_that_of_its_evaluations_too(tmp_path):
    clock = FakeClock()

    def slow_score(iteration):
        clock.now += 5.0
        return float(iteration)

    progress = Trial(tmp_path, clock=clock, scores=slow_score, stop={"num_iterations": 3}).run()
    assert progress.time_s == 15.0


# -- checkpoints


@pytest.mark.parametrize(
    ("keep", "kept"),
    [
        # Best at 3; saved at every second iteration and, 7 being the last, at the end.
        (0, [3, 7]),
        (1, [3, 7]),
        (2, [3, 6, 7]),
        (3, [3, 4, 6, 7]),
        (9, [1, 2, 3, 4, 6, 7]),
    ],
)
def test_the_best_and_the_latest_are_kept_and_so_many_of_the_newest(tmp_path, keep, kept):
    scores = {1: 1.0, 2: 2.0, 3: 9.0}
    trial = Trial(
        tmp_path,
        scores=lambda i: scores.get(i, 0.0),
        stop={"num_iterations": 7},
        checkpoints={"every_iterations": 2, "keep": keep},
    )
    progress = trial.run()
    # Iterations 1 and 3 are saved because they are better than all before.
    assert trial.kept == kept
    assert [record.iteration for record in progress.checkpoints] == kept
    assert (progress.best_iteration, progress.best_evaluation_return) == (3, 9.0)
    assert sorted(path.name for path in trial.store.checkpoints_folder.iterdir()) == [f"{i:06d}" for i in kept]


@pytest.mark.parametrize("offset", [0.0, -100.0])
def test_a_better_score_is_a_better_score_below_zero_too(tmp_path, offset):
    """Trap: `if best:` takes a best of 0.0 for none."""
    scores = {1: 0.0, 2: -1.0, 3: 0.0, 4: 0.5, 5: -2.0}
    trial = Trial(
        tmp_path,
        scores=lambda i: scores[i] + offset,
        stop={"num_iterations": 5},
        checkpoints={"every_iterations": 100, "keep": 9},
    )
    progress = trial.run()
    # 3 is no better than 1; 5 is the end.
    assert trial.kept == [1, 4, 5]
    assert (progress.best_iteration, progress.best_evaluation_return) == (4, 0.5 + offset)


def test_the_earliest_of_equal_scores_is_the_best(tmp_path):
    trial = Trial(
        tmp_path, scores=lambda _: 0.0, stop={"num_iterations": 6}, checkpoints={"every_iterations": 2, "keep": 1}
    )
    progress = trial.run()
    assert progress.best_iteration == 1
    assert trial.kept == [1, 6]


def test_a_checkpoint_between_evaluations_has_no_score(tmp_path):
    trial = Trial(
        tmp_path,
        stop={"num_iterations": 6},
        evaluation={"every_iterations": 4},
        checkpoints={"every_iterations": 3, "keep": 9},
    )
    trial.run()
    assert [(r.iteration, r.evaluation_return) for r in trial.store.checkpoints()] == [(3, None), (4, 4.0), (6, 6.0)]
    record = trial.store.checkpoints()[0]
    assert (record.trial_id, record.num_env_steps, record.training_return) == ("t0000", 300, 20.0)
    assert record.path == "trials/t0000/checkpoints/000003"


# -- going on


def test_a_trial_goes_on_from_its_latest_checkpoint(tmp_path):
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
    assert (progress.iteration, progress.num_env_steps, progress.num_episodes) == (9, 900, 9)
    assert [record.iteration for record in second.results] == list(range(1, 10))
    # The best of before still is.
    assert (progress.best_iteration, progress.best_evaluation_return) == (1, -1.0)
    assert second.kept == [1, 9]


def test_results_are_written_before_the_checkpoint_that_counts_on_them(tmp_path):
    """Killed right after it is saved, a trial goes on from it: results that were not written would leave a hole."""
    trial = Trial(tmp_path, evaluation={"every_iterations": 50})
    known = []
    trial.engine.save = lambda folder: known.append([record.iteration for record in trial.results])
    trial.loop.advance(math.inf)
    assert known == [list(range(1, number + 1)) for number in (10, 20, 30, 40, 50)]


def test_a_trial_without_a_checkpoint_begins_again(tmp_path):
    first = Trial(tmp_path, evaluation={"every_iterations": 50})
    first.loop.advance(-1.0)
    assert first.results
    second = Trial(tmp_path, evaluation={"every_iterations": 50})
    assert second.engine.builds == [None]
    assert (second.results, second.loop.iteration) == ([], 0)


def test_time_goes_on_where_it_was(tmp_path):
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


def test_the_window_of_100_episodes_goes_on_too(tmp_path):
    task = {"stop": {"training_return": 20.0, "num_iterations": 300}, "evaluation": {"every_iterations": 999},
            "checkpoints": {"every_iterations": 60, "keep": 1}}  # fmt: skip
    first = Trial(tmp_path, **task)
    for _ in range(70):
        first.loop.advance(-1.0)
    second = Trial(tmp_path, **task)
    assert second.loop.iteration == 60
    assert second.run().iteration == 100


def test_the_newest_score_goes_on_too(tmp_path):
    task = {"evaluation": {"every_iterations": 4}, "checkpoints": {"every_iterations": 3, "keep": 1}}
    first = Trial(tmp_path, **task)
    while first.loop.iteration < 6:
        first.loop.advance(-1.0)
    report = Trial(tmp_path, **task).loop.advance(-1.0)
    assert (report.iteration, report.evaluated, report.evaluation_return) == (7, False, 4.0)
    assert report.best_iteration == 4


def test_a_torn_last_line_is_dropped(tmp_path):
    first = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 1})
    first.run_to(4)
    whole = first.store.results_path.read_text()
    with first.store.results_path.open("a") as file:
        file.write('{"iteration": 5, "num_env')
    assert [record.iteration for record in first.results] == [1, 2, 3, 4]
    second = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 1})
    assert second.store.results_path.read_text() == whole
    second.run_to(6)
    assert [record.iteration for record in second.results] == [1, 2, 3, 4, 5, 6]


def test_half_written_checkpoints_are_removed_and_never_used(tmp_path):
    first = Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 1})
    first.run_to(2)
    half = first.store.checkpoints_folder / ".000004.123"
    shutil.copytree(first.store.checkpoints_folder / "000002", half)
    second = Trial(tmp_path)
    assert second.engine.builds == ["000002"]
    assert not half.exists()


def test_a_damaged_latest_checkpoint_is_an_error_and_no_fresh_start(tmp_path):
    Trial(tmp_path, checkpoints={"every_iterations": 2, "keep": 1}).run_to(2)
    store = TrialStore(tmp_path, "t0000")
    (store.checkpoints_folder / "000002" / "engine.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"engine\.json"):
        Trial(tmp_path)
    # Nothing was lost by looking.
    assert [record.iteration for record in store.read_iterations()] == [1, 2]


def test_a_trial_that_had_reached_its_end_is_done_at_once(tmp_path):
    """Killed after its last checkpoint, before anybody was told."""
    Trial(tmp_path, stop={"num_iterations": 5}).run()
    again = Trial(tmp_path, stop={"num_iterations": 5})
    progress = again.loop.advance(math.inf)
    assert (progress.status, progress.stop_reason) == ("completed", "num_iterations 5 >= 5")
    assert (progress.iteration, progress.evaluation_return, progress.best_iteration) == (5, 5.0, 5)
    assert again.engine.iteration == 5
    assert len(again.results) == 5


def test_a_process_runs_one_trial_after_another(tmp_path):
    engine = FakeEngine()
    for name in ("a", "b"):
        trial = Trial(tmp_path / name, engine=engine, stop={"num_iterations": 3})
        assert trial.run().iteration == 3
        assert len(trial.results) == 3
    assert engine.builds == [None, None]


# -- the end that nobody wants


def test_nan_weights_end_a_trial_as_failed(tmp_path):
    trial = Trial(tmp_path, engine=FakeEngine(nan_from=5), checkpoints={"every_iterations": 2, "keep": 2})
    progress = trial.run()
    assert (progress.status, progress.iteration, progress.stop_reason) == ("failed", 5, None)
    assert "NaN" in progress.error
    assert "iteration 5" in progress.error
    assert progress.ended_at is not None
    # What was good before is there, and nothing of iteration 5 was saved.
    assert progress.best_iteration == 4
    assert trial.kept == [3, 4]
    assert [(r.iteration, r.evaluation_return) for r in trial.results][-2:] == [(4, 4.0), (5, None)]


def test_what_an_engine_raises_is_raised_and_what_was_done_is_written(tmp_path):
    trial = Trial(tmp_path, engine=FakeEngine(raise_at=4), evaluation={"every_iterations": 50})
    with pytest.raises(ZeroDivisionError, match="the cart left the track"):
        trial.run()
    assert [record.iteration for record in trial.results] == [1, 2, 3]


def test_a_stop_request_pauses_with_a_checkpoint_of_this_very_iteration(tmp_path):
    trial = Trial(tmp_path, evaluation={"every_iterations": 3})
    trial.run_to(3)
    trial.loop.advance(-1.0)
    SweepStore(tmp_path).request_stop()
    progress = trial.loop.advance(math.inf)
    assert (progress.status, progress.iteration, progress.stop_reason) == ("paused", 4, None)
    assert trial.kept == [3, 4]
    assert trial.store.checkpoints()[-1].evaluation_return is None
    assert progress.ended_at is not None
    SweepStore(tmp_path).clear_stop_request()
    again = Trial(tmp_path, evaluation={"every_iterations": 3})
    assert again.engine.builds == ["000004"]
    assert again.run_to(6).num_env_steps == 600


def test_a_stop_request_right_after_a_checkpoint_writes_no_other(tmp_path):
    trial = Trial(tmp_path)
    trial.run_to(3)
    before = {path: path.stat().st_mtime_ns for path in trial.store.checkpoints_folder.rglob("*")}
    SweepStore(tmp_path).request_stop()
    assert trial.loop.advance(math.inf).status == "paused"
    assert {path: path.stat().st_mtime_ns for path in trial.store.checkpoints_folder.rglob("*")} == before


def test_a_stop_request_before_the_first_iteration_saves_nothing(tmp_path):
    trial = Trial(tmp_path)
    SweepStore(tmp_path).request_stop()
    progress = trial.loop.advance(math.inf)
    assert (progress.status, progress.iteration, progress.checkpoints) == ("paused", 0, ())
    assert trial.kept == []


def test_results_tell_all_that_an_iteration_gave(tmp_path):
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
