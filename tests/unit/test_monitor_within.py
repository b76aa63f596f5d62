"""While no trial reports, the live table shows how far the trials are within their iterations."""

from pathlib import Path

import pytest
from fake_engine import FakeClock
from rich.console import Console

from analysis.records import TrialRecord
from policies.envs.tallies import Reached, Tally
from policies.errors import CheckpointError
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.sweeps.live_table import render, summary_line
from tune_jobs.sweeps.monitor import SweepMonitor
from tune_jobs.sweeps.reached import reached_of, up_to_now


def make_trial(index: int, status: str = "running", steps: int = 0, time_s: float = 0.0) -> TrialRecord:
    return TrialRecord(
        trial_id=f"t{index:04d}", index=index, point_index=index, seed=index, point={"lr": 0.001}, status=status,
        num_env_steps=steps, time_s=time_s,
    )  # fmt: skip


class Within:
    """Two trials of 1,000 env steps, a clock, and how far the trials really are."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.reached: dict[str, Reached] = {}
        self.asked: list[str] = []
        self.monitor = SweepMonitor(
            "mine", [make_trial(0), make_trial(1, "pending")], caps={"t0000": 1_000, "t0001": 1_000},
            reached=self.ask, clock=self.clock,
        )  # fmt: skip

    def ask(self, trial_id: str) -> Reached | None:
        self.asked.append(trial_id)
        return self.reached.get(trial_id)

    def comes_to(self, steps: int, time_s: float) -> None:
        self.reached["t0000"] = Reached(0, steps, 1, time_s)

    def lines(self) -> list[str]:
        console = Console(width=120)
        with console.capture() as captured:
            console.print(render(self.monitor))
        return captured.get().splitlines()

    def row(self) -> list[str]:
        return next(line for line in self.lines() if " t0000 " in f"{line} ").split()


@pytest.fixture
def within() -> Within:
    return Within()


def test_what_is_trained_since_the_last_report_is_shown(within: Within) -> None:
    within.comes_to(250, 50.0)
    within.clock.now += 6
    assert "12 %, 250 env steps" in summary_line(within.monitor)
    # 250 env steps in 50 s, and 1,750 are left.
    assert "about 5 min 50 s left" in summary_line(within.monitor)
    assert any("250 of at most 2,000" in line for line in within.lines())
    assert within.row()[4:] == ["250", "0.001", "-", "-", "5"]
    # Nothing runs but the first.
    assert set(within.asked) == {"t0000"}


def test_a_report_takes_the_place_of_what_was_looked_up(within: Within) -> None:
    within.comes_to(250, 50.0)
    within.clock.now += 6
    assert "250 env steps" in summary_line(within.monitor)
    within.monitor.update(make_trial(0, steps=300, time_s=60.0))
    assert "300 env steps" in summary_line(within.monitor)
    # A retry goes on from an earlier checkpoint.
    within.comes_to(350, 70.0)
    within.clock.now += 6
    assert "350 env steps" in summary_line(within.monitor)
    within.monitor.update(make_trial(0, steps=100, time_s=20.0))
    assert "100 env steps" in summary_line(within.monitor)


@pytest.mark.parametrize("status", ["completed", "paused", "failed", "stopped"])
def test_a_trial_that_runs_no_more_is_shown_as_its_record_has_it(within: Within, status: str) -> None:
    within.comes_to(250, 50.0)
    within.clock.now += 6
    assert "250 env steps" in summary_line(within.monitor)
    within.monitor.update(make_trial(0, status, steps=200, time_s=40.0))
    assert "200 env steps" in summary_line(within.monitor)


def test_trials_that_report_are_not_looked_at_nor_more_than_once_a_second(within: Within) -> None:
    for _ in range(3):
        within.clock.now += 4
        within.monitor.update(make_trial(0))
        summary_line(within.monitor)
    assert within.asked == []
    within.clock.now += 5
    for _ in range(4):
        within.lines()
    assert len(within.asked) == 1
    within.clock.now += 1
    within.lines()
    assert len(within.asked) == 2


@pytest.mark.parametrize("reached", [None, Reached(0, 0, 0, 0.0), Reached(0, 90, 3, 1.0)])
def test_what_is_not_known_or_older_than_the_report_changes_nothing(within: Within, reached: Reached | None) -> None:
    within.monitor.update(make_trial(0, steps=100, time_s=20.0))
    before = within.lines()
    if reached is not None:
        within.reached["t0000"] = reached
    within.clock.now += 6
    assert "100 env steps" in summary_line(within.monitor)
    assert within.row()[4] == "100"
    assert len(within.lines()) == len(before)


def test_it_is_read_from_what_the_trial_s_process_writes(tmp_path: Path) -> None:
    store = SweepStore(tmp_path / "mine")
    store.trial("t0000").tally_path.parent.mkdir(parents=True)
    read = reached_of(store)
    assert read("t0000") is None
    tally = Tally(store.trial("t0000").tally_path, Reached(2, 100, 4, 20.0))
    tally.add(30, 1)
    found = read("t0000")
    assert found is not None
    assert (found.num_iterations, found.num_env_steps, found.num_episodes) == (2, 130, 5)


def test_who_evaluates_is_told_until_it_reports(within: Within) -> None:
    within.reached["t0000"] = Reached(1, 500, 4, 50.0, evaluates=True)
    assert "1 pending, 1 running" in summary_line(within.monitor)
    within.clock.now += 6
    assert "1 pending, 1 running (1 evaluating)" in summary_line(within.monitor)
    assert "1 running (1 evaluating)  1 pending" in within.lines()[1]
    within.monitor.update(make_trial(0, steps=500, time_s=50.0))
    assert "evaluating" not in summary_line(within.monitor)
    within.reached["t0000"] = Reached(2, 700, 4, 50.0)
    within.clock.now += 6
    assert "700 env steps" in summary_line(within.monitor)
    assert "evaluating" not in summary_line(within.monitor)


def test_a_trial_that_failed_evaluates_no_more(within: Within) -> None:
    within.reached["t0000"] = Reached(1, 500, 4, 50.0, evaluates=True)
    within.clock.now += 6
    assert "evaluating" in summary_line(within.monitor)
    within.monitor.update(make_trial(1))
    within.monitor.update(make_trial(0, "failed", steps=400))
    assert "1 failed, 1 running" in summary_line(within.monitor)
    assert "evaluating" not in summary_line(within.monitor)


def test_a_status_has_what_is_trained_by_now_while_a_process_drives_the_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = SweepStore(tmp_path / "mine")
    trials = [make_trial(0, steps=100), make_trial(1, "paused", steps=100), make_trial(2, steps=100)]
    for trial in trials[:2]:
        path = store.trial(trial.trial_id).tally_path
        path.parent.mkdir(parents=True)
        Tally(path, Reached(2, 130, 4, 20.0))
    assert list(up_to_now(store, trials)) == trials
    monkeypatch.setattr(SweepStore, "is_driven", lambda _: True)
    now = up_to_now(store, trials)
    assert [(trial.num_env_steps, trial.time_s) for trial in now] == [(130, 20.0), (100, 0.0), (100, 0.0)]


def test_a_trial_whose_record_can_no_more_be_read_evaluates_no_more(within: Within) -> None:
    within.reached["t0000"] = Reached(1, 500, 4, 50.0, evaluates=True)
    within.clock.now += 6
    assert "evaluating" in summary_line(within.monitor)
    within.monitor.begin_stage("", [make_trial(1)], {"t0001": 1_000})
    assert "1 running" in summary_line(within.monitor)
    assert "evaluating" not in summary_line(within.monitor)


@pytest.mark.parametrize("error", [CheckpointError("It is a link.", "Remove it."), OSError("no space")], ids=str)
def test_where_a_trial_can_t_be_looked_at_nothing_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def raises(_: TrialStore) -> Path:
        raise error

    monkeypatch.setattr(TrialStore, "tally_path", property(raises))
    assert reached_of(SweepStore(tmp_path / "mine"))("t0000") is None
