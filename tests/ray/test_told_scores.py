"""What the search method of a whole sweep is told: of every trial the score by the objective, whoever ended it."""

from pathlib import Path

import pytest
from test_search import SPACE, launch

from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


@pytest.mark.parametrize("engine", ["packed", "rllib"])
def test_each_trial_that_ended_has_the_score_by_which_its_setting_is_judged(tmp_path: Path, engine: str) -> None:
    result = launch(
        tmp_path, env="TestTrouble-v0", engine=engine, space=SPACE, num_samples=4, seeds_per_point=2,
        search={"type": "gp", "num_startup_trials": 2}, objective="area",
        scheduler={"type": "asha", "grace_env_steps": 256, "reduction_factor": 2},
    )  # fmt: skip
    trials = SweepStore(result.folder).read_trials()
    assert {trial.status for trial in trials} == {"completed", "stopped"}
    told = {trial.trial_id: trial.objective_score for trial in trials}
    frame = sweeps.dataframe(result.folder).set_index("trial_id")
    assert told == pytest.approx(frame["objective_score"].to_dict())
    assert len(set(told.values())) > 1
