"""Early stopping by Ray Tune's schedulers, on trials whose scores are scripted."""

import pytest
from scripted_trials import run_scripted

from tune_jobs.spec import SchedulerSpec

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

# In the order of their start; with asha and median each is compared with those before it.
MIXED = (1.0, 8.0, 2.0, 7.0, 3.0, 6.0, 4.0, 5.0)


def spec(kind, **fields):
    return SchedulerSpec(type=kind, **{"grace_env_steps": 200, "reduction_factor": 2, **fields})


def test_asha_ends_the_worse_half_at_its_rungs(tmp_path):
    steps = run_scripted(tmp_path, spec("asha"), MIXED, max_env_steps=1600, evaluate_every=2)
    # The first is compared with none. 2, 3 and 4 are below the median of those that were at the first rung before them,
    # 6 and 5 at the second, 7 at none.
    assert steps == [1600, 1600, 200, 1600, 200, 400, 200, 400]


def test_asha_and_median_end_no_trial_before_the_grace_period_nor_on_a_report_without_an_evaluation(tmp_path):
    # Reports in between repeat nothing: the scripted trials say 1e6 there.
    for kind in ("asha", "median"):
        steps = run_scripted(
            tmp_path / kind, spec(kind, grace_env_steps=400), (9.0, 8.0, 1.0, 1.0), max_env_steps=800, evaluate_every=4
        )
        assert steps[0] == 800
        assert min(steps) == 400, kind


def test_hyperband_keeps_the_better_half_of_a_bracket_at_each_rung(tmp_path):
    steps = run_scripted(tmp_path, spec("hyperband"), MIXED, max_env_steps=1600, evaluate_every=2)
    ranked = [count for _, count in sorted(zip(MIXED, steps, strict=True))]
    assert ranked == [200, 200, 200, 200, 400, 400, 800, 1600]


@pytest.mark.parametrize("kind", ["asha", "hyperband", "median"])
def test_a_trial_without_a_finite_score_never_runs_on(tmp_path, kind):
    # The first of all is compared with none; the last two are worse than all others.
    scores = (None, 1.0, 2.0, 3.0, None, float("nan"))
    steps = run_scripted(tmp_path, spec(kind), scores, max_env_steps=1600, evaluate_every=2)
    assert [steps[0], steps[4], steps[5]] == [200, 200, 200]
    assert max(steps) == 1600
