"""A sweep of random play, run as any other, and what `make learn` measures of it."""

from pathlib import Path

import pytest

from policies.acting.load import load_policy
from policies.acting.policy import RandomPolicy
from tests.learning.measure import measure, verdict
from tests.learning.targets import Target, Task
from tests.narrowing import present
from tune_jobs.sweeps import verbs as sweeps

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


def test_the_random_preset_plays_its_episodes_and_scores_as_random_play(tmp_path: Path) -> None:
    target = Target("as good as itself", times_random=1.0)
    task = Task("cartpole-random", target, target)
    found = measure(task, 2, tmp_path)
    assert found.num_failed == 0
    assert found.times_random == 1.0  # the same actions on the same episodes, to the last one
    assert 17 < present(found.score) < 27
    assert found.solve_median is None
    assert verdict(task, found) == (True, "pass")
    trials = sweeps.trials("cartpole-random", storage=tmp_path)
    assert [trial.status for trial in trials] == ["completed"] * 2
    # Several may end in the last iteration of 8 env steps only where one falls at once.
    assert all(150 <= trial.num_episodes <= 151 for trial in trials)
    assert trials[0].num_env_steps != trials[1].num_env_steps
    assert [seed.num_env_steps for seed in found.seeds] == [trial.num_env_steps for trial in trials]
    assert type(load_policy(tmp_path / "cartpole-random" / trials[0].checkpoints[-1].path)) is RandomPolicy
