"""Early stopping by Ray Tune's schedulers, on trials whose scores are scripted, and in a whole sweep."""

from pathlib import Path
from typing import Any

import pytest
from scripted_trials import run_scripted
from test_sweeps import assert_results_without_gaps, launch, make_spec

from tests.narrowing import present
from tune_jobs.spec.scheduler import SchedulerSpec, SchedulerType
from tune_jobs.store.sweep_store import SweepStore

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

# In the order of their start; with asha and median each is compared with those before it.
MIXED = (1.0, 8.0, 2.0, 7.0, 3.0, 6.0, 4.0, 5.0)


def spec(kind: SchedulerType, **fields: Any) -> SchedulerSpec:
    return SchedulerSpec(type=kind, **{"grace_env_steps": 200, "reduction_factor": 2, **fields})


def test_asha_ends_the_worse_half_at_its_rungs(tmp_path: Path) -> None:
    steps = run_scripted(tmp_path, spec("asha"), MIXED, max_env_steps=1600, evaluate_every=2)
    # The first is compared with none. 2, 3 and 4 are below the median of those that were at the first rung before them,
    # 6 and 5 at the second, 7 at none.
    assert steps == [1600, 1600, 200, 1600, 200, 400, 200, 400]


def test_asha_and_median_end_no_trial_before_the_grace_period_nor_on_a_report_without_an_evaluation(
    tmp_path: Path,
) -> None:
    # Reports in between repeat nothing: the scripted trials say 1e6 there.
    for kind in ("asha", "median"):
        steps = run_scripted(
            tmp_path / kind, spec(kind, grace_env_steps=400), (9.0, 8.0, 1.0, 1.0), max_env_steps=800, evaluate_every=4
        )
        assert steps[0] == 800
        assert min(steps) == 400, kind


def test_hyperband_keeps_the_better_half_of_a_bracket_at_each_rung(tmp_path: Path) -> None:
    steps = run_scripted(tmp_path, spec("hyperband"), MIXED, max_env_steps=1600, evaluate_every=2)
    ranked = [count for _, count in sorted(zip(MIXED, steps, strict=True))]
    assert ranked == [200, 200, 200, 200, 400, 400, 800, 1600]


@pytest.mark.parametrize("kind", ["asha", "hyperband", "median"])
def test_a_trial_without_a_finite_score_never_runs_on(tmp_path: Path, kind: SchedulerType) -> None:
    # The first of all is compared with none; the last two are worse than all others.
    scores = (None, 1.0, 2.0, 3.0, None, float("nan"))
    steps = run_scripted(tmp_path, spec(kind), scores, max_env_steps=1600, evaluate_every=2)
    assert [steps[0], steps[4], steps[5]] == [200, 200, 200]
    assert max(steps) == 1600


@pytest.mark.parametrize("scheduler", ["asha", "hyperband", "median"])
def test_every_scheduler_runs_to_the_end(tmp_path: Path, scheduler: str) -> None:
    """One learning rate learns, the others cannot: as many trials as it takes to compare."""
    # HyperBand ends half of its first bracket at the first rung, where nothing is learned yet after 256 env steps.
    grace = 768 if scheduler == "hyperband" else 256
    spec = make_spec(
        space={"lr": {"grid": [1e-2, 1e-7, 2e-7, 3e-7, 4e-7, 5e-7]}},
        num_samples=1,
        stop={"num_env_steps": 2_560},
        scheduler={"type": scheduler, "grace_env_steps": grace, "reduction_factor": 2},
        evaluation={"every_iterations": 2, "num_episodes": 10},
    )
    result = launch(tmp_path, spec, finish=False)
    statuses = [trial.status for trial in result.trials]
    assert set(statuses) <= {"completed", "stopped"}
    assert (result.exit_code, result.sweep.state) == (0, "completed")
    store = SweepStore(result.folder)
    for trial in result.trials:
        assert_results_without_gaps(store, trial)
        if trial.status == "stopped":
            assert present(trial.stop_reason).startswith("scheduler, at ")
            assert grace <= trial.num_env_steps < 2_560
            # What it reached counts: a stopped trial may still be the best.
            assert trial.best_evaluation_return is not None
            assert trial.checkpoints
        else:
            assert trial.num_env_steps >= 2_560
            assert present(trial.stop_reason).startswith("num_env_steps")
        assert trial.ended_at is not None
    assert "completed" in statuses
    if scheduler in ("asha", "hyperband"):
        assert "stopped" in statuses
    # Without a reason to stop it, the one that learns goes on to the end.
    assert result.trials[0].status == "completed"
