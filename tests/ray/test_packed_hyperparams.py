"""Every hyperparameter arrives in the pack; see `packed_ppo_cases` and `packed_ppo_batches`."""

import packed_ppo_batches  # noqa: F401 (its cases register themselves)
import packed_ppo_cases
import pytest

from policies.hyperparams import PPOHyperparams

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


@pytest.mark.parametrize("field", sorted(packed_ppo_cases.CASES))
def test_every_hyperparameter_of_ppo_acts_in_a_pack(field: str) -> None:
    packed_ppo_cases.CASES[field]()


def test_every_hyperparameter_of_ppo_has_a_case() -> None:
    """Whoever adds one must hand it on to packs as well, or have the plan leave its trials to RLlib."""
    assert set(packed_ppo_cases.CASES) == set(PPOHyperparams.model_fields)
