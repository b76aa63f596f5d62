"""Every hyperparameter of DQN arrives in the pack; see `packed_dqn_cases` and `packed_dqn_traces`."""

import packed_dqn_cases
import packed_dqn_traces  # noqa: F401 (its cases register themselves)
import pytest

from policies.hyperparams import DQNHyperparams

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

CHECKS = {check.__name__.removeprefix("check_"): check for check in packed_dqn_cases.CASES.values()}
"""Some are of several fields."""


@pytest.mark.parametrize("name", sorted(CHECKS))
def test_every_hyperparameter_of_dqn_acts_in_a_pack(name: str) -> None:
    CHECKS[name]()


def test_every_hyperparameter_of_dqn_has_a_case() -> None:
    """Whoever adds one must hand it on to packs as well, or have the plan leave its trials to RLlib."""
    assert set(packed_dqn_cases.CASES) == set(DQNHyperparams.model_fields)
