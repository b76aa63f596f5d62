"""Single trials of a population that is resumed are compared where they would have been, by what they had there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from scripted_packs import make_sweep

from analysis.records import IterationRecord
from tune_jobs.ray_tune.population import Population
from tune_jobs.ray_tune.processes import RayWatch
from tune_jobs.ray_tune.run_trials import RunJob, _Run
from tune_jobs.ray_tune.scheduling import CopyFrom, Decision, Standing

pytestmark = pytest.mark.ray
NAMES = [f"t{index:04d}" for index in range(6)]


class NobodyEnded:
    def wait(self) -> bool:
        return False

    def ended(self) -> tuple[str, ...]:
        return ()


@pytest.fixture
def judge(tmp_path: Path) -> Population:
    """Evaluations are 400 env steps apart and the interval is 250; t0005 has not come to its first comparison."""
    scheduler = {"type": "pbt", "perturb_every_env_steps": 250, "quantile_fraction": 0.2, "frequencies": [1, 2]}
    store = make_sweep(
        tmp_path / "mine", len(NAMES), scheduler=scheduler, stop={"num_env_steps": 4_000},
        evaluation={"every_iterations": 4, "num_episodes": 1},
    )  # fmt: skip
    for index, name in enumerate(NAMES):
        last = 3 if name == "t0005" else 10
        trial = store.trial(name)
        # At 400 env steps the last one of these is the best, at 800 the first.
        scores: dict[int, float] = {4: float(index), 8: 5.0 - index}
        iterations = [
            IterationRecord(
                iteration=at, num_env_steps=100 * at, num_episodes=at, time_s=1.0, evaluation_return=scores.get(at)
            )
            for at in range(1, last + 1)
        ]
        trial.append_iterations(iterations)
        known: dict[str, Any] = {
            "status": "paused", "num_iterations": last, "num_env_steps": 100 * last, "point": {"lr": 1e-3},
            "evaluation_return": scores[8] if last > 8 else None,
        }  # fmt: skip
        trial.write_record(trial.read_record().model_copy(update=known))
    job = RunJob(store.place, tuple(NAMES), cpus_per_trial=1, gpus_per_trial=0, max_concurrent=1)
    run = _Run(job, store, lambda _: None, store.take(), RayWatch({}, grace_s=1.0))
    found: Any = run._build_scheduler()
    run.keeper.close()
    population = found.scheduler
    assert isinstance(population, Population)
    for name in NAMES:
        population.begins(name)
    return population


def test_the_interval_counts_from_where_a_trial_was_compared(judge: Population) -> None:
    assert [judge.due_at(name) for name in NAMES] == [800 + 250] * 5 + [250]
    assert judge.reached(Standing("t0000", 1_040, 0.0, evaluated=True), NobodyEnded()) is Decision.GO_ON


def test_who_was_not_compared_yet_has_no_score_and_the_slower_select_when_they_would_have(judge: Population) -> None:
    # t0000, t0003 and t0004 are the faster ones; t0005 of the slower ones was never compared.
    assert [judge._members[name].score for name in NAMES] == [5.0, 4.0, 3.0, 2.0, 1.0, None]
    assert [judge._members[name].selected_from for name in NAMES] == [800] * 5 + [0]
    outcome = judge.reached(Standing("t0004", 1_200, 1.0, evaluated=True), NobodyEnded())
    assert isinstance(outcome, CopyFrom)
    assert outcome.trial_id == "t0000"
