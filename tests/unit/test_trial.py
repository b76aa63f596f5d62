"""The life of a trial: when it ends, when it is evaluated, and what is kept."""

import math
from pathlib import Path

import pytest
from fake_engine import FakeClock, FakeEngine, make_task
from trial_runs import Trial

from policies.acting.evaluate import Evaluator
from policies.portable.file import read_policy
from tests.narrowing import present
from tune_jobs.store.progress import Progress
from tune_jobs.training.trial_loop import TrialLoop

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
def test_a_trial_ends_by_the_first_rule_that_holds(
    tmp_path: Path, stop: dict[str, float], iterations: int, reason: str
) -> None:
    progress = Trial(tmp_path, stop=stop).run()
    assert (progress.status, progress.num_iterations, progress.stop_reason) == ("completed", iterations, reason)
    assert progress.num_env_steps == 100 * iterations
    assert present(progress.ended_at) >= present(progress.started_at)


def test_a_trial_ends_after_so_many_seconds(tmp_path: Path) -> None:
    clock = FakeClock(step=1.0)
    progress = Trial(tmp_path, clock=clock, stop={"time_s": 30.0}).run()
    assert present(progress.stop_reason).startswith("time_s ")
    assert present(progress.stop_reason).endswith(" >= 30")
    assert 30 <= progress.time_s < 40


def test_a_trial_whose_evaluation_takes_it_to_its_seconds_ends_with_a_checkpoint_of_its_end(tmp_path: Path) -> None:
    clock = FakeClock()

    def scores(iteration: int) -> float:
        clock.now += 16.0
        return -float(iteration)

    checkpoints = {"every_iterations": 10, "keep": 2}
    trial = Trial(tmp_path, clock=clock, scores=scores, stop={"time_s": 50.0}, checkpoints=checkpoints)
    progress = trial.run()
    assert (progress.num_iterations, progress.time_s, progress.stop_reason) == (4, 64.0, "time_s 64 >= 50")
    assert trial.kept == [1, 4]


def test_the_hard_caps_hold_where_nothing_else_is_set(tmp_path: Path) -> None:
    """No rule given: the defaults end it all the same."""
    progress = Trial(tmp_path, engine=FakeEngine(steps=50_000), stop={}, evaluation={"every_iterations": 1_000}).run()
    assert progress.stop_reason == "num_env_steps 200000 >= 200000"


def test_training_return_counts_100_whole_episodes_and_no_fewer(tmp_path: Path) -> None:
    """One episode an iteration, from the first with the wanted return: only after 100 of them is it a mean."""
    stop = {"training_return": 195.0, "num_iterations": 300}
    trial = Trial(tmp_path, engine=FakeEngine(lambda _: (195.0,)), stop=stop, evaluation={"every_iterations": 999})
    progress = trial.run()
    assert (progress.num_iterations, progress.stop_reason) == (100, "training_return 195 >= 195")
    assert progress.num_episodes == 100


def test_training_return_is_of_the_last_100_episodes(tmp_path: Path) -> None:
    """Three episodes an iteration. The first 20 iterations are bad; they leave the window one by one."""
    engine = FakeEngine(lambda iteration: (0.0,) * 3 if iteration <= 20 else (200.0,) * 3)
    stop = {"training_return": 200.0, "num_iterations": 300}
    trial = Trial(tmp_path, engine=engine, stop=stop, evaluation={"every_iterations": 999})
    progress = trial.run()
    # 100 episodes of 200 are there after 34 more iterations.
    assert progress.num_iterations == 54
    assert progress.training_return == 200.0
    returns = [value for record in trial.results for value in record.episode_returns]
    for record in trial.results:
        window = returns[max(0, record.num_episodes - 100) : record.num_episodes]
        assert record.training_return == pytest.approx(sum(window) / len(window))


def test_more_than_100_episodes_in_an_iteration(tmp_path: Path) -> None:
    engine = FakeEngine(lambda _: (0.0,) * 50 + (10.0,) * 100)
    progress = Trial(tmp_path, engine=engine, stop={"training_return": 10.0}).run()
    assert (progress.num_iterations, progress.num_episodes, progress.training_return) == (1, 150, 10.0)


def test_iterations_without_an_ended_episode(tmp_path: Path) -> None:
    trial = Trial(tmp_path, engine=FakeEngine(lambda i: (5.0,) if i == 3 else ()), stop={"num_iterations": 4})
    progress = trial.run()
    assert [record.training_return for record in trial.results] == [None, None, 5.0, 5.0]
    assert progress.num_episodes == 1


@pytest.mark.parametrize("target", [0.0, -3.0])
def test_scores_of_zero_and_below_stop_a_trial_too(tmp_path: Path, target: float) -> None:

    def rising(iteration: int) -> float:
        return -10.0 + iteration

    progress = Trial(tmp_path / "a", scores=rising, stop={"evaluation_return": target}).run()
    assert progress.num_iterations == 10 + target
    engine = FakeEngine(lambda iteration: (rising(iteration),) * 100)
    progress = Trial(tmp_path / "b", engine=engine, scores=rising, stop={"training_return": target}).run()
    assert progress.num_iterations == 10 + target


# -- evaluation


def test_evaluations_come_at_multiples_and_at_the_end(tmp_path: Path) -> None:
    trial = Trial(tmp_path, evaluation={"every_iterations": 4}, stop={"num_iterations": 10})
    trial.run()
    assert trial.evaluator.evaluated == [4, 8, 10]
    scores = {record.iteration: record.evaluation_return for record in trial.results}
    assert scores == {i: (float(i) if i in (4, 8, 10) else None) for i in range(1, 11)}


def test_each_evaluation_is_reported_at_once(tmp_path: Path) -> None:
    """Schedulers compare at it: a report must be of that very iteration."""
    trial = Trial(tmp_path, evaluation={"every_iterations": 4}, stop={"num_iterations": 10})
    reports = [trial.loop.advance(math.inf) for _ in range(3)]
    assert [(report.num_iterations, report.evaluated, report.evaluation_return) for report in reports] == [
        (4, True, 4.0),
        (8, True, 8.0),
        (10, True, 10.0),
    ]


def test_reports_between_evaluations_come_after_so_many_seconds(tmp_path: Path) -> None:
    clock = FakeClock(step=0.25)
    trial = Trial(tmp_path, clock=clock, evaluation={"every_iterations": 50})
    report = trial.loop.advance(3.0)
    assert (report.status, report.evaluated, report.evaluation_return) == ("running", False, None)
    assert 1 < report.num_iterations < 50
    # What is reported is on disk.
    assert trial.results[-1].iteration == report.num_iterations
    trial.run_to(50)
    report = trial.loop.advance(1.0)
    # The newest score, of an earlier iteration.
    assert (report.evaluated, report.evaluation_return) == (False, 50.0)


def test_an_iteration_longer_than_the_interval_is_reported_alone(tmp_path: Path) -> None:
    trial = Trial(tmp_path, clock=FakeClock(step=100.0), evaluation={"every_iterations": 50}, stop={"time_s": 1e6})
    assert [trial.loop.advance(1.0).num_iterations for _ in range(3)] == [1, 2, 3]


def test_the_evaluation_is_the_mean_of_greedy_episodes_of_the_very_policy(tmp_path: Path) -> None:
    """With the real evaluator: the checkpoint's own policy file gives the score that is in its manifest."""
    task = make_task(tmp_path, stop={"num_iterations": 2})
    with Evaluator("CartPole-v1", {}, (1, 2)) as evaluator:
        loop = TrialLoop(task, FakeEngine(), evaluator)
        loop.open()
        loop.advance(0.0)
        progress = loop.advance(0.0)
        assert progress.status == "completed"
        from policies.acting.policy import NetworkPolicy

        for record in progress.checkpoints:
            episodes = evaluator.run(NetworkPolicy(read_policy(tmp_path / record.path)))
            assert record.evaluation_return == pytest.approx(episodes.mean_return)


def test_a_score_that_is_no_number_is_none_and_never_the_best(tmp_path: Path) -> None:
    scores = {1: -5.0, 2: math.nan, 3: math.inf, 4: -7.0}
    checkpoints = {"every_iterations": 1, "keep": 9}
    trial = Trial(tmp_path, scores=scores.__getitem__, stop={"num_iterations": 4}, checkpoints=checkpoints)
    progress = trial.run()
    assert [record.evaluation_return for record in progress.checkpoints] == [-5.0, None, None, -7.0]
    assert (progress.best_iteration, progress.best_evaluation_return) == (1, -5.0)


def test_the_end_is_reported_with_the_iteration_that_reached_it(tmp_path: Path) -> None:
    trial = Trial(tmp_path, stop={"evaluation_return": 3.0})
    reports = [trial.loop.advance(math.inf) for _ in range(3)]
    assert [(report.status, report.num_iterations) for report in reports] == [
        ("running", 1),
        ("running", 2),
        ("completed", 3),
    ]


def test_the_time_of_a_trial_is_that_of_its_evaluations_too(tmp_path: Path) -> None:
    clock = FakeClock()

    def slow_score(iteration: int) -> float:
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
def test_the_best_and_the_latest_are_kept_and_so_many_of_the_newest(tmp_path: Path, keep: int, kept: list[int]) -> None:
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
def test_a_better_score_is_a_better_score_below_zero_too(tmp_path: Path, offset: float) -> None:
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


def test_the_earliest_of_equal_scores_is_the_best(tmp_path: Path) -> None:
    trial = Trial(
        tmp_path, scores=lambda _: 0.0, stop={"num_iterations": 6}, checkpoints={"every_iterations": 2, "keep": 1}
    )
    progress = trial.run()
    assert progress.best_iteration == 1
    assert trial.kept == [1, 6]


def test_a_checkpoint_between_evaluations_has_no_score(tmp_path: Path) -> None:
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


def test_every_iteration_is_told_once_without_its_episodes(tmp_path: Path) -> None:
    trial = Trial(tmp_path, stop={"num_iterations": 8}, evaluation={"every_iterations": 3})
    told = [trial.loop.advance(math.inf) for _ in range(3)]
    assert [[item.iteration for item in progress.iterations] for progress in told] == [[1, 2, 3], [4, 5, 6], [7, 8]]
    without = {"episode_returns": (), "episode_lengths": ()}
    lean = [item.model_copy(update=without) for item in trial.results]
    assert [item for progress in told for item in progress.iterations] == lean
    assert trial.results[0].episode_returns
    assert trial.loop.leave().iterations == ()


def test_iterations_reach_the_driver_as_they_are(tmp_path: Path) -> None:
    """A trial's process sends them as plain data, with numbers that JSON lacks."""
    trial = Trial(tmp_path, engine=FakeEngine(lambda iteration: (math.nan,)), stop={"num_iterations": 2})
    sent = trial.run()
    received = Progress.model_validate(sent.model_dump())
    assert [item.learner for item in received.iterations] == [item.learner for item in sent.iterations]
    assert received.iterations[0].training_return is None
