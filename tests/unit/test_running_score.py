"""What a trial's process tells of the score by the objective: what the ranking of settings finds afterwards."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from fake_engine import FakeEngine
from synthetic_sweep import make_sweep
from trial_runs import Trial

from analysis.objectives import score_of
from analysis.records import Objective, TrialRecord
from policies.acting.evaluate import Episodes
from tests.narrowing import present
from tune_jobs.spec.file import load_spec
from tune_jobs.store.progress import Progress
from tune_jobs.training.protocol import IterationStats
from tune_jobs.training.scoring import Judging, judging_of

CAP = 1_200
OBJECTIVES: list[Objective] = ["final", "area", "best", "steps_to_threshold"]


def up_and_down(iteration: int) -> float:
    """Best in the fifth of twelve iterations."""
    return 10.0 - abs(iteration - 5)


def judged(objective: Objective, **changes: Any) -> Judging:
    return Judging(objective, CAP, 8.0 if objective == "steps_to_threshold" else None, **changes)


def trial(folder: Path, judging: Judging | None, stop: Mapping[str, float]) -> Trial:
    engine = FakeEngine(lambda iteration: (float(iteration), 2.0 * iteration))
    return Trial(
        folder, engine=engine, scores=up_and_down, stop=stop, evaluation={"every_iterations": 2}, judging=judging
    )


def expected(progress: Progress, run: Trial, objective: Objective) -> float | None:
    """What `rank_settings` finds in what is in the store."""
    ended = TrialRecord(
        trial_id="t0000", index=0, point_index=0, seed=0, point={}, status=progress.status,
        stop_reason=progress.stop_reason, num_env_steps=progress.num_env_steps,
    )  # fmt: skip
    threshold = judged(objective).threshold
    return score_of(ended, run.results, objective, num_env_steps=CAP, threshold=threshold)


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("stop", [{"num_env_steps": CAP}, {"num_iterations": 9}, {"evaluation_return": 9.0}])
def test_a_trial_that_ends_tells_what_its_setting_is_judged_by(
    tmp_path: Path, objective: Objective, stop: dict[str, float]
) -> None:
    run = trial(tmp_path, judged(objective), stop)
    progress = run.run()
    assert progress.status == "completed"
    assert progress.objective_score == present(expected(progress, run, objective))


def test_objectives_differ(tmp_path: Path) -> None:
    """Or the test above would not tell one from another."""
    stop = {"num_env_steps": CAP}
    found = {trial(tmp_path / objective, judged(objective), stop).run().objective_score for objective in OBJECTIVES}
    assert len(found) == len(OBJECTIVES)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_one_that_goes_on_counts_what_it_did_before(tmp_path: Path, objective: Objective) -> None:
    first = trial(tmp_path, judged(objective), {"num_env_steps": CAP})
    first.run_to(7)
    first.loop.leave()
    second = trial(tmp_path, judged(objective), {"num_env_steps": CAP})
    progress = second.run()
    assert [record.iteration for record in second.results] == list(range(1, 13))
    assert progress.objective_score == present(expected(progress, second, objective))


def test_where_a_scheduler_compares_it_each_evaluation_has_a_score_and_the_newest_stands(tmp_path: Path) -> None:
    run = trial(tmp_path, judged("final", at_evaluations=True), {"num_env_steps": CAP})
    told = []
    for iteration in range(1, 7):
        assert run.loop.before_iteration(stop=False) is None
        wants = run.loop.take(IterationStats(100 * iteration, ((float(iteration), 7),)))
        found = Episodes((1,), (up_and_down(iteration),), (5,)) if wants else None
        told.append(run.loop.conclude(found).objective_score)
        run.loop.flush()
    assert told[0] is None
    assert [told[2], told[4]] == [told[1], told[3]]
    assert told[5] not in (None, told[4])
    # As one that is ended here: what it was at last is taken to go on.
    ended = run.loop.leave("stopped")
    assert ended.objective_score == told[5] == present(expected(ended, run, "final"))


def test_where_none_does_only_its_end_has_one(tmp_path: Path) -> None:
    run = trial(tmp_path, judged("final"), {"num_env_steps": CAP})
    assert run.loop.advance(math.inf).objective_score is None
    assert run.run().objective_score is not None


def test_where_no_search_method_learns_of_it_nothing_is_kept(tmp_path: Path) -> None:
    run = trial(tmp_path, None, {"num_env_steps": CAP})
    assert run.run().objective_score is None
    assert run.loop._score._iterations == []


# -- how it is judged

BASE: dict[str, Any] = {
    "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-5, 1e-1]}}, "num_samples": 20,
    "search": "gp", "stop": {"num_env_steps": 50_000},
}  # fmt: skip


def judging(point: Mapping[str, Any] | None = None, env_threshold: float | None = 475.0, **changes: Any) -> Any:
    sweep = make_sweep().sweep.model_copy(update={"env_threshold": env_threshold})
    return judging_of(load_spec({**BASE, **changes}), sweep, point or {"lr": 1e-3})


def test_it_is_by_the_sweeps_objective() -> None:
    assert judging(objective="area") == Judging("area", 50_000)
    assert judging(objective="area", scheduler="asha") == Judging("area", 50_000, at_evaluations=True)
    assert judging(objective="area", search="random") is None


def test_beside_final_and_best_a_search_learns_of_the_best_evaluation_alone() -> None:
    assert judging() is judging(objective="final") is judging(objective="best") is None


def test_the_threshold_is_the_objectives_or_the_envs_own() -> None:
    steps = {"type": "steps_to_threshold"}
    assert judging(objective=steps) == Judging("steps_to_threshold", 50_000, 475.0)
    assert judging(objective={**steps, "threshold": 100}) == Judging("steps_to_threshold", 50_000, 100.0)
    assert judging(objective=steps, env_threshold=None) is None


def test_a_searched_length_is_what_it_is_to_have_but_for_the_steps_to_a_threshold() -> None:
    searched: dict[str, Any] = {
        "space": {**BASE["space"], "stop.num_env_steps": {"choice": [20_000, 50_000]}}, "stop": {},
        "objective": {"type": "area", "cost": "env_steps"},
    }  # fmt: skip
    point = {"lr": 1e-3, "stop.num_env_steps": 20_000}
    assert judging(point, **searched) == Judging("area", 20_000)
    searched["objective"] = {"type": "steps_to_threshold"}
    assert judging(point, **searched) == Judging("steps_to_threshold", 50_000, 475.0)
