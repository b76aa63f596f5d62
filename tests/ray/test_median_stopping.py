"""Median stopping decides as Ray's own rule does, by the same floats, and reads each evaluation once."""

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from former_schedulers import FakedController, FakedTrial
from ray.tune.schedulers import MedianStoppingRule

from tune_jobs.ray_tune import early_stopping
from tune_jobs.ray_tune.early_stopping import build_scheduler
from tune_jobs.ray_tune.scheduling import WORST_SCORE, Decision, NobodyWaits, Standing
from tune_jobs.spec.scheduler import SchedulerSpec

pytestmark = pytest.mark.ray

GRACE = 400
COMMON = MappingProxyType({"metric": "score", "mode": "max", "time_attr": "num_env_steps"})
CONTROLLER = FakedController()


def made(max_env_steps: int = 100_000) -> Any:
    return build_scheduler(SchedulerSpec(type="median", grace_env_steps=GRACE), max_env_steps)


def random_results(rng: np.random.Generator, *, retried: bool) -> Sequence[tuple[str, dict[str, Any]]]:
    """What trials report, in the order in which it is told; one that is retried goes on from fewer env steps."""
    reached = dict.fromkeys([f"t{number:04d}" for number in range(int(rng.integers(4, 12)))], 0)
    found = []
    for _ in range(600):
        name = str(rng.choice(list(reached)))
        step = int(rng.choice([0, 100, 200, 700]))
        reached[name] = max(0, reached[name] - 1_000) if retried and rng.random() < 0.05 else reached[name] + step
        score = int(name[1:]) + rng.normal() if rng.random() < 0.998 else rng.choice([WORST_SCORE, math.nan, math.inf])
        found.append((name, {"num_env_steps": reached[name], "score": float(score)}))
    return found


@pytest.mark.parametrize("retried", [False, True])
def test_it_decides_as_rays_own_by_the_same_floats(retried: bool) -> None:
    stops = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        ours, theirs = made()._rule, MedianStoppingRule(grace_period=GRACE, **COMMON)
        known: dict[str, FakedTrial] = {}
        for name, result in random_results(rng, retried=retried):
            trial = known.setdefault(name, FakedTrial(name))
            told = {rule.on_trial_result(CONTROLLER, trial, dict(result)) for rule in (ours, theirs)}
            assert len(told) == 1, (seed, name, result)
            if told == {"STOP"}:
                stops += 1
                # It is compared with, still.
                for rule in (ours, theirs):
                    rule.on_trial_complete(CONTROLLER, trial, dict(result))
                    rule._stopped_trials.discard(trial)
            time = int(rng.integers(0, 20_000))
            for other in known.values():
                np.testing.assert_array_equal(ours._running_mean(other, time), theirs._running_mean(other, time))
    assert stops > 50


def test_an_evaluation_is_read_no_more_often_the_more_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    num_reads = 0

    class Result(dict[str, Any]):
        def __getitem__(self, name: str) -> Any:
            nonlocal num_reads
            num_reads += name == "num_env_steps"
            return super().__getitem__(name)

    plain = early_stopping._result
    monkeypatch.setattr(early_stopping, "_result", lambda standing: Result(plain(standing)))
    judge = made()
    names = [f"t{number:04d}" for number in range(20)]
    for name in names:
        judge.begins(name)
    for at in range(1, 101):
        num_reads = 0
        for name in names:
            assert judge.reached(Standing(name, 100 * at, 1.0, evaluated=True), NobodyWaits()) is Decision.GO_ON
        # The last of each trial says how far that is: of 20, for each of 20. And each new one is read twice or so.
        assert num_reads < 20 * 20 + 5 * 20
