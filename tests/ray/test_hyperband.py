"""HyperBand decides as Ray Tune's does wherever that comes to an end, and no trial waits for ever."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from former_schedulers import former_hyperband
from hyperband_sweeps import Controller, FakedTrial, decided
from ray import tune
from ray.tune.experiment import Trial
from scripted_packs import make_sweep

from analysis.records import TrialRecord
from tune_jobs.ray_tune import run_trials
from tune_jobs.ray_tune.early_stopping import build_tune_scheduler
from tune_jobs.ray_tune.hyperband import HyperBand, HyperBandScheduler
from tune_jobs.ray_tune.meetings import compared_with
from tune_jobs.ray_tune.processes import RayWatch
from tune_jobs.ray_tune.scheduling import WORST_SCORE, Decision, NobodyWaits, Standing

pytestmark = pytest.mark.ray

REPORTS = [(100,), (100, 200, 300), (400,)]


def reach(rule: HyperBand, number: int, steps: int, score: float) -> Decision:
    return rule.reached(Standing(f"t{number:04d}", steps, score, evaluated=True), NobodyWaits())


def made(num_trials: int, max_env_steps: int = 800) -> HyperBand:
    """Of a grace period of 100 env steps; half of the trials go on at each milestone."""
    rule = HyperBand(100, max_env_steps, 2.0)
    for number in range(num_trials):
        rule.begins(f"t{number:04d}")
    return rule


@pytest.mark.parametrize("every", REPORTS)
def test_decisions_and_their_order_are_those_of_rays_own(every: Sequence[int]) -> None:
    num_ended, words = 0, set()
    for seed in range(40):
        expected, is_over = decided(seed, former_hyperband, every=every)
        if is_over:
            num_ended += 1
            found, _ = decided(seed, build_tune_scheduler, every=every)
            assert found == expected, seed
            words |= {one[0] for one in found}
    assert num_ended > 10
    assert words == {"runs", "CONTINUE", "PAUSE", "STOP", "failed", "tried again"}


@pytest.mark.parametrize("every", REPORTS)
def test_every_sweep_comes_to_its_end_which_with_rays_own_it_does_not(every: Sequence[int]) -> None:
    assert all(decided(seed, build_tune_scheduler, every=every)[1] for seed in range(40))
    assert not all(decided(seed, former_hyperband, every=every)[1] for seed in range(40))


def test_evaluations_that_are_further_apart_than_milestones_keep_nobody_waiting() -> None:
    rule = made(8)
    assert [reach(rule, number, 400, number) for number in range(7)] == [Decision.WAIT] * 7
    # The first milestones were 100, 200 and 400 env steps: one of eight goes on.
    assert reach(rule, 7, 400, 7.0) is Decision.GO_ON
    assert rule.take_ended() == [f"t{number:04d}" for number in range(7)]
    assert list(rule.in_turn()) == ["t0007"]


@pytest.mark.parametrize("factor", [1.2, 1.5, 1.9])
def test_each_halving_comes_later_than_the_one_before_also_if_few_are_ended(factor: float) -> None:
    rule = HyperBand(100, 2_000, factor)
    rule.begins("t0000")
    milestones = []
    while (milestone := rule.next_milestone("t0000")) is not None:
        milestones.append(milestone)
        reach(rule, 0, milestone, 1.0)
    assert len(milestones) > 3
    assert milestones == sorted(set(milestones))


def test_those_that_wait_do_not_wait_for_one_that_ended_by_itself() -> None:
    rule = made(8)
    for number in range(8):
        reach(rule, number, 100, number)
    assert rule.take_ended() == ["t0000", "t0001", "t0002", "t0003"]
    assert [reach(rule, number, 200, number) for number in (4, 5, 6)] == [Decision.WAIT] * 3
    assert [rule.waits(f"t{number:04d}") for number in (4, 5, 6, 7)] == [True, True, True, False]
    rule.gone("t0007")
    assert rule.take_ended() == ["t0004"]
    assert not any(map(rule.waits, rule.in_turn()))


def test_a_trial_without_a_score_is_ended_and_one_without_an_evaluation_goes_on() -> None:
    rule = made(2)
    assert rule.reached(Standing("t0000", 700, 1.0, evaluated=False), NobodyWaits()) is Decision.GO_ON
    assert reach(rule, 0, 100, WORST_SCORE) is Decision.STOP
    assert reach(rule, 0, 100, float("nan")) is Decision.STOP


def test_a_trial_that_is_tried_again_stays_in_its_bracket_as_in_packs() -> None:
    """Tune tells of each retry as of an error and of a new trial."""
    scheduler = HyperBandScheduler(made(0))
    trials = [FakedTrial(number) for number in range(8)]
    controller: Any = Controller(trials, scheduler, 100)

    def report(trial: Any, steps: int, score: float) -> str:
        trial.status, trial.num_env_steps = Trial.RUNNING, steps
        result = {"num_env_steps": steps, "score": score, "evaluated": True}
        return str(scheduler.on_trial_result(controller, trial, result))

    for trial in trials:
        scheduler.on_trial_add(controller, trial)
    for number, trial in enumerate(trials[:7]):
        assert report(trial, 100, number) == "PAUSE"
        trial.status = Trial.PAUSED
    last: Any = trials[7]
    last.status = Trial.ERROR
    scheduler.on_trial_error(controller, last)
    last.status = Trial.PENDING
    scheduler.on_trial_add(controller, last)
    assert controller.take_stopped() == []
    # The worst of all, when it comes there.
    assert report(last, 100, -1.0) == "STOP"
    assert sorted(controller.take_stopped()) == ["t0000", "t0001", "t0002"]
    # One that fails for good is waited for no longer.
    assert report(trials[3], 200, 3) == "PAUSE"
    trials[3].status = Trial.PAUSED
    for number in (4, 5):
        assert report(trials[number], 200, number) == "PAUSE"
        trials[number].status = Trial.PAUSED
    trials[6].status = Trial.RUNNING
    scheduler.on_trial_error(controller, trials[6])
    assert controller.take_stopped() == ["t0003"]


def record(number: int, **given: Any) -> TrialRecord:
    return TrialRecord(trial_id=f"t{number:04d}", index=number, point_index=number, seed=number, point={}, **given)


def test_trials_of_a_resumed_sweep_have_the_places_that_they_had_among_all() -> None:
    """Of the eight places of a bracket five are of trials that have ended; at a milestone as many go on as would."""
    records = [
        record(number, status="stopped" if number < 4 else "failed" if number == 4 else "paused")
        for number in range(12)
    ]
    todo = {one.trial_id for one in records[5:]}
    scheduler = HyperBandScheduler(rule := made(0))
    scheduler.begin(records, todo)
    trials = [FakedTrial(number) for number in range(5, 12)]
    controller: Any = Controller(trials, scheduler, 100)
    for trial in trials:
        scheduler.on_trial_add(controller, trial)
    assert list(rule.in_turn()) == sorted(todo)
    assert [rule.next_milestone(one.trial_id) for one in trials] == [100] * 3 + [200] * 4
    # The three that are left of the first bracket were among the four better ones at 100 env steps.
    assert [reach(rule, number, 200, number) for number in (5, 6, 7)] == [Decision.WAIT] * 2 + [Decision.GO_ON]
    assert rule.take_ended() == ["t0005"]


def test_who_had_places_beside_trials_of_a_run_are_those_of_their_engine_that_were_compared() -> None:
    records = [
        record(0, status="stopped", engine="packed"), record(1, status="stopped", engine="rllib"),
        record(2, status="paused", engine="packed"), record(3, status="pending", engine="packed"),
        record(4, status="completed", engine="packed", seed_index=1), record(5, status="failed", engine="packed"),
    ]  # fmt: skip
    found = compared_with({"t0002"}, records, seeds_per_point=1)
    assert [one.trial_id for one in found] == ["t0000", "t0002", "t0005"]


def test_a_run_of_single_trials_gives_them_the_places_that_they_had_among_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = dict[str, Any]()

    class Tuner:
        def __init__(self, *_: Any, tune_config: Any, **__: Any) -> None:
            given["scheduler"] = tune_config.scheduler

        def fit(self) -> None:
            pass

    monkeypatch.setattr(tune, "Tuner", Tuner)
    settings = {"type": "hyperband", "grace_env_steps": 100, "reduction_factor": 2.0}
    store = make_sweep(tmp_path / "mine", 12, scheduler=settings, stop={"num_env_steps": 800})
    for one in store.read_trials()[:5]:
        store.trial(one.trial_id).write_record(one.model_copy(update={"status": "stopped"}))
    todo = tuple(f"t{number:04d}" for number in range(5, 12))
    job = run_trials.RunJob(store.place, todo, cpus_per_trial=1, gpus_per_trial=0, max_concurrent=1)
    run = run_trials._Run(job, store, lambda _: None, store.take(), RayWatch({}, grace_s=1.0))
    run.all_trials()
    run.keeper.close()
    rule = given["scheduler"].scheduler
    assert [rule.next_milestone(name) for name in todo] == [100] * 3 + [200] * 4
