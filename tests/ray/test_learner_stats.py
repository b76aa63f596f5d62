"""What is kept of RLlib's metrics of an update."""

import pytest

from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams

pytestmark = pytest.mark.ray


@pytest.mark.parametrize(
    ("hyperparams", "names"),
    [
        (PPOHyperparams(use_kl_loss=True), {"total_loss", "entropy", "kl"}),
        # RLlib says 0 for a divergence that it does not measure.
        (PPOHyperparams(), {"total_loss", "entropy"}),
        (DQNHyperparams(), {"total_loss", "entropy", "kl"}),
    ],
)
def test_a_divergence_that_was_not_measured_is_no_metric(hyperparams: TrainedHyperparams, names: set[str]) -> None:
    from tune_jobs.training.rllib import _learner_stats

    stats = {"total_loss": 1.0, "entropy": 0.5, "mean_kl_loss": 0.0, "timer": 3.0}
    assert set(_learner_stats({"learners": {"default_policy": stats}}, hyperparams)) == names
