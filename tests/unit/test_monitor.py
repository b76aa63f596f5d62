"""The numbers behind the live table, with a clock that stands still until it is told."""

import pytest
from fake_engine import FakeClock
from rich.console import Console

from analysis.records import CheckpointRecord, TrialRecord
from tests.narrowing import present
from tune_jobs.sweeps.forecast import forecast
from tune_jobs.sweeps.live_table import render, summary_line
from tune_jobs.sweeps.monitor import SweepMonitor


def make_trial(
    index: int,
    status: str = "pending",
    *,
    steps: int = 0,
    score: float | None = None,
    time_s: float = 0.0,
    point_index: int | None = None,
) -> TrialRecord:
    """A trial whose best checkpoint has this score."""
    trial_id = f"t{index:04d}"
    checkpoints: tuple[CheckpointRecord, ...] = ()
    if score is not None:
        checkpoints = (CheckpointRecord(trial_id=trial_id, iteration=1, num_env_steps=steps, evaluation_return=score),)
    return TrialRecord(
        trial_id=trial_id,
        index=index,
        point_index=index if point_index is None else point_index,
        seed=index,
        point={"lr": 0.001 * (index + 1)},
        status=status,
        num_env_steps=steps,
        time_s=time_s,
        best_evaluation_return=score,
        checkpoints=checkpoints,
    )


def make_monitor(*records: TrialRecord, clock: FakeClock | None = None, cap: int = 1_000) -> SweepMonitor:
    return SweepMonitor(
        "mine",
        records,
        caps=dict.fromkeys([record.trial_id for record in records], cap),
        clock=clock or FakeClock(),
    )


def test_trials_are_counted_by_status() -> None:
    monitor = make_monitor(*(make_trial(index) for index in range(4)))
    assert monitor.counts() == {"pending": 4}
    monitor.update(make_trial(0, "running"))
    monitor.update(make_trial(1, "failed"))
    monitor.update(make_trial(0, "completed"))
    assert monitor.counts() == {"completed": 1, "failed": 1, "pending": 2}


def test_env_steps_are_of_all_trials_whatever_their_order() -> None:
    monitor = make_monitor(make_trial(0, "completed", steps=1_000), make_trial(1))
    assert monitor.num_env_steps == 1_000
    monitor.update(make_trial(1, "running", steps=300))
    monitor.update(make_trial(1, "running", steps=500))
    assert monitor.num_env_steps == 1_500
    # A retry goes on from an earlier checkpoint.
    monitor.update(make_trial(1, "running", steps=200))
    assert monitor.num_env_steps == 1_200


def test_the_best_so_far_is_chosen_by_the_rule_that_will_choose_the_winner() -> None:
    monitor = make_monitor(make_trial(0), make_trial(1), make_trial(2))
    assert monitor.best() is None
    monitor.update(make_trial(0, "running", steps=100, score=-5.0))
    assert (present(monitor.best()).trial.trial_id, present(monitor.best()).score) == ("t0000", -5.0)
    monitor.update(make_trial(1, "running", steps=100, score=0.0))
    assert present(monitor.best()).trial.trial_id == "t0001"
    # It gets better while it runs.
    monitor.update(make_trial(0, "running", steps=200, score=-0.5))
    assert [point.score for point in present(monitor.best()).ranking] == [0.0, -0.5]
    # A failed trial never wins.
    monitor.update(make_trial(1, "failed", steps=100, score=0.0))
    assert present(monitor.best()).trial.trial_id == "t0000"
    monitor.update(make_trial(0, "failed", steps=200, score=-0.5))
    assert monitor.best() is None


def test_the_rate_is_of_the_last_seconds() -> None:
    clock = FakeClock()
    monitor = make_monitor(make_trial(0), clock=clock, cap=1_000_000)
    assert monitor.env_steps_per_s() is None
    for second in range(1, 11):
        clock.now += 1.0
        monitor.update(make_trial(0, "running", steps=200 * second))
    assert monitor.env_steps_per_s() == pytest.approx(200)
    # Then it gets faster, and half a minute later that is all that counts.
    for second in range(1, 31):
        clock.now += 1.0
        monitor.update(make_trial(0, "running", steps=2_000 + 1_000 * second))
    assert monitor.env_steps_per_s() == pytest.approx(1_000)
    # Nothing more comes: the rate falls.
    clock.now += 60.0
    assert present(monitor.env_steps_per_s()) < 400


def test_the_start_of_ray_is_no_part_of_the_rate() -> None:
    clock = FakeClock()
    monitor = make_monitor(make_trial(0), clock=clock, cap=1_000_000)
    for _ in range(6):
        clock.now += 2.0
        monitor.update(make_trial(0, "running"))
    clock.now += 1.0
    monitor.update(make_trial(0, "running", steps=500))
    assert monitor.env_steps_per_s() == pytest.approx(500)


def test_steps_of_an_earlier_run_are_no_part_of_the_rate() -> None:
    clock = FakeClock()
    monitor = make_monitor(make_trial(0, "paused", steps=50_000), clock=clock, cap=1_000_000)
    clock.now += 1.0
    monitor.update(make_trial(0, "running", steps=50_300))
    assert monitor.env_steps_per_s() == pytest.approx(300)
    assert monitor.num_env_steps == 50_300


def test_the_time_left_is_the_one_that_status_tells() -> None:
    """Of an earlier run the table's own clock knows nothing; the records do."""
    trials = [
        make_trial(0, "completed", steps=400, time_s=40.0),
        make_trial(1, "running", steps=300, time_s=30.0),
        make_trial(2),
    ]
    monitor = make_monitor(*trials)
    seen = forecast(trials, {trial.trial_id: 1_000 for trial in trials})
    assert seen.time_left_s == pytest.approx((100 + 400) / 10)
    assert monitor.progress() == seen
    console = Console(width=120)
    with console.capture() as captured:
        console.print(render(monitor))
    assert "left: about 50 s" in captured.get()
    assert "about 50 s left" in summary_line(monitor)


def test_elapsed_time_is_the_clocks() -> None:
    clock = FakeClock()
    monitor = make_monitor(make_trial(0), clock=clock)
    clock.now += 12.5
    assert monitor.elapsed_s == 12.5


def test_trials_that_wait_for_a_node_are_told_once_none_has_run_for_a_while() -> None:
    clock = FakeClock()
    monitor = make_monitor(make_trial(0), make_trial(1), clock=clock)
    monitor.phase = "starting the trials"
    clock.now += 60
    assert "waiting" not in summary_line(monitor)
    monitor.update(make_trial(0, "running"))
    clock.now += 60
    assert "waiting" not in summary_line(monitor)
    # Its node is lost: it is about to begin on another one, if there is one.
    monitor.update(make_trial(0))
    clock.now += 9
    assert "waiting" not in summary_line(monitor)
    clock.now += 1
    words = "no trial runs: waiting for a node that has room for one"
    assert words in summary_line(monitor)
    console = Console(width=120, record=True)
    console.print(render(monitor, 120))
    assert words in console.export_text()
    for ended in ("completed", "failed"):
        monitor.update(make_trial(0, "running"))
        assert "waiting" not in summary_line(monitor)
        monitor.update(make_trial(0, ended))
        monitor.update(make_trial(1, "stopped"))
        clock.now += 60
        assert "waiting" not in summary_line(monitor)
