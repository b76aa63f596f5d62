"""Our scheduler protocol decides as Ray Tune's schedulers did before it, on random scores."""

import math
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
import pytest
from former_schedulers import FakedController, FakedTrial, former

from tune_jobs.ray_tune.early_stopping import build_scheduler, build_tune_scheduler
from tune_jobs.ray_tune.scheduling import WORST_SCORE, CopyFrom, Decision, NobodyWaits, Scheduler, Standing
from tune_jobs.ray_tune.tune_scheduler import TuneScheduler
from tune_jobs.spec.scheduler import SchedulerSpec, SchedulerType

pytestmark = [
    pytest.mark.ray,
    # Ray's percentile of nothing but NaN, which some of the sequences have.
    pytest.mark.filterwarnings("ignore:All-NaN slice"),
]

MAX_ENV_STEPS = 1_600
NAMES = {"CONTINUE": Decision.GO_ON, "STOP": Decision.STOP, "PAUSE": Decision.GIVE_WAY}
Tell = Callable[[str, dict[str, Any], bool, bool], Decision | CopyFrom]
"""A trial, what it reports, whether that ends it and whether it is new -> what becomes of it."""


def reports(rng: np.random.Generator) -> Generator[tuple[int, dict[str, Any], bool], Decision | CopyFrom | None, None]:
    """What the trials of one sweep tell, in the order in which they are told.

    Yields:
        Number of the trial, its report as Tune has it, and whether it has ended by itself.
    """
    num_trials = int(rng.integers(2, 14))
    waiting = list(range(num_trials))
    running: dict[int, int] = {}
    slots = int(rng.integers(1, 6))
    while waiting or running:
        while waiting and len(running) < slots:
            running[waiting.pop(0)] = 0
        number = int(rng.choice(list(running)))
        running[number] += int(rng.choice([100, 200, 300]))
        # Few values, so that there are ties; a trial that gets better or worse; and no numbers.
        score = float(rng.choice([WORST_SCORE, math.nan], p=[0.5, 0.5])) if rng.random() < 0.1 else float(
            rng.integers(0, 6) + (rng.random() < 0.3) * number
        )  # fmt: skip
        over = running[number] >= MAX_ENV_STEPS
        evaluated = bool(over or rng.random() < 0.7)
        told = {"num_env_steps": running[number], "score": score, "evaluated": evaluated, "done": over}
        if (yield number, told, over) is Decision.STOP or over:
            del running[number]


def settings(rng: np.random.Generator, kind: SchedulerType) -> SchedulerSpec:
    grace = int(rng.choice([1, 100, 200, 400, 1000]))
    return SchedulerSpec(type=kind, grace_env_steps=grace, reduction_factor=int(rng.integers(2, 5)))


def played(seed: int, kind: SchedulerType, teller: Callable[[SchedulerSpec], Tell]) -> list[Decision | CopyFrom]:
    """Every decision that is made in a random sweep."""
    rng = np.random.default_rng(seed)
    spec = settings(rng, kind)
    tell = teller(spec)
    found, known, answer = [], set(), None
    sweep = reports(rng)
    try:
        while True:
            number, told, over = sweep.send(answer)
            is_new = number not in known
            known.add(number)
            answer = tell(f"t{number:04d}", told, over, is_new)
            found.append(answer)
    except StopIteration:
        return found


def by_tune(judge: Any, *, seed: int = 0) -> Tell:
    """Tune's calls of its scheduler; now and then others wait for a place."""
    rng = np.random.default_rng(seed)
    waits = {
        0: FakedController((FakedTrial("a"), FakedTrial("b", "TERMINATED"))),
        1: FakedController((FakedTrial("a"), FakedTrial("b", "PENDING"))),
        2: FakedController((FakedTrial("b", "PAUSED"),)),
    }

    def tell(name: str, told: dict[str, Any], over: bool, is_new: bool) -> Decision | CopyFrom:
        controller = waits[int(rng.integers(3))]
        if is_new:
            judge.on_trial_add(controller, FakedTrial(name))
        decision = "STOP" if over else judge.on_trial_result(controller, FakedTrial(name), told)
        if decision == "STOP":
            judge.on_trial_complete(controller, FakedTrial(name), told)
        return NAMES[decision]

    return tell


def in_packs_before(spec: SchedulerSpec) -> Tell:
    judge = former(spec, MAX_ENV_STEPS)

    def tell(name: str, told: dict[str, Any], over: bool, is_new: bool) -> Decision | CopyFrom:
        if is_new:
            judge.on_trial_add(FakedController(), FakedTrial(name))
        decision = "STOP" if over else judge.on_trial_result(FakedController(), FakedTrial(name), told)
        if decision == "STOP":
            judge.on_trial_complete(FakedController(), FakedTrial(name), told)
        return NAMES[decision]

    return tell


def in_packs_now(spec: SchedulerSpec) -> Tell:
    judge = build_scheduler(spec, MAX_ENV_STEPS)

    def tell(name: str, told: dict[str, Any], over: bool, is_new: bool) -> Decision | CopyFrom:
        if is_new:
            judge.begins(name)
        standing = Standing(name, told["num_env_steps"], told["score"], told["evaluated"])
        decision = Decision.STOP if over else judge.reached(standing, NobodyWaits())
        if decision is Decision.STOP:
            judge.ended(standing)
        return decision

    return tell


@pytest.mark.parametrize("kind", ["asha", "median"])
def test_members_of_packs_are_judged_as_with_faked_trials(kind: SchedulerType) -> None:
    decisions = []
    for seed in range(40):
        decisions += (now := played(seed, kind, in_packs_now))
        assert now == played(seed, kind, in_packs_before), seed
    assert 0.02 < decisions.count(Decision.STOP) / len(decisions) < 0.5
    assert Decision.GIVE_WAY not in decisions


@pytest.mark.parametrize("kind", ["asha", "median"])
def test_trials_of_tune_are_judged_as_by_its_own_schedulers(kind: SchedulerType) -> None:
    decisions = []
    for seed in range(40):
        now = played(seed, kind, lambda spec: by_tune(build_tune_scheduler(spec, MAX_ENV_STEPS)))
        assert now == played(seed, kind, lambda spec: by_tune(former(spec, MAX_ENV_STEPS))), seed
        decisions += now
    assert 0.02 < decisions.count(Decision.STOP) / len(decisions) < 0.5
    # Median stopping gives way where it has too few to compare with.
    assert (Decision.GIVE_WAY in decisions) == (kind == "median")


def test_without_a_scheduler_everyone_goes_on_to_the_end() -> None:
    judge = build_tune_scheduler(SchedulerSpec(type="none"), MAX_ENV_STEPS)
    assert isinstance(judge, TuneScheduler)
    ends = []
    tell = by_tune(judge)

    def noted(name: str, told: dict[str, Any], over: bool, is_new: bool) -> Decision | CopyFrom:
        ends.append((over, decision := tell(name, told, over, is_new)))
        return decision

    played(0, "asha", lambda spec: noted)
    assert {over for over, _ in ends} == {False, True}
    assert all((decision is Decision.STOP) == over for over, decision in ends)


@pytest.mark.parametrize("kind", ["pbt", "hyperband"])
def test_what_lets_trials_wait_is_made_elsewhere(kind: SchedulerType) -> None:
    with pytest.raises(ValueError, match=f"wait for each other with {kind}"):
        build_scheduler(SchedulerSpec(type=kind), MAX_ENV_STEPS)


def test_a_trial_that_tune_ends_before_its_first_report_is_compared_with_none() -> None:
    for kind in ("asha", "median"):
        judge = build_tune_scheduler(SchedulerSpec(type=kind), MAX_ENV_STEPS)
        judge.on_trial_add(None, FakedTrial("t0000"))
        judge.on_trial_complete(None, FakedTrial("t0000"), {})
        judge.on_trial_add(None, FakedTrial("t0001"))
        told = {"num_env_steps": 1_000, "score": 1.0, "evaluated": True}
        assert judge.on_trial_result(FakedController(), FakedTrial("t0001"), told) == "CONTINUE"


def asha() -> Scheduler:
    """Rungs at 2,500, 7,500 and 22,500 env steps."""
    return build_scheduler(SchedulerSpec(type="asha"), 50_000)


def told(rule: Scheduler, name: str, *evaluations: tuple[int, float]) -> list[Decision | CopyFrom]:
    rule.begins(name)
    return [rule.reached(Standing(name, steps, score, evaluated=True), NobodyWaits()) for steps, score in evaluations]


def test_nobody_is_compared_at_a_rung_with_what_a_trial_that_passed_it_unevaluated_scored_later() -> None:
    rule = asha()
    assert told(rule, "seldom", (20_480, 100.0), (40_960, 300.0)) == [Decision.GO_ON] * 2
    rule.ended(Standing("seldom", 50_000, 450.0, evaluated=True))
    # Better than the other wherever both are known, and evaluated early.
    assert told(rule, "often", (2_560, 60.0), (7_680, 120.0), (23_040, 450.0)) == [Decision.GO_ON] * 3


def test_the_last_score_of_a_trial_that_failed_is_none_where_it_failed() -> None:
    rule = asha()
    for number in range(4):
        told(rule, f"t{number}", *((steps, 450.0) for steps in (2_500, 7_500, 20_000)))
        rule.ended(Standing(f"t{number}", 23_000, 450.0, evaluated=False))
    evaluations = ((2_500, 450.0), (7_500, 450.0), (20_000, 451.0), (23_000, 430.0))
    # The first of all that was evaluated there.
    assert told(rule, "t4", *evaluations) == [Decision.GO_ON] * 4
