"""The names that the table says RLlib has are names that this RLlib knows."""

import dataclasses

import pytest

from policies.foreign_names import FOREIGN_NAMES
from policies.hyperparams import Algorithm

pytestmark = pytest.mark.ray

OLD = {"num_envs_per_worker", "num_workers", "num_sgd_iter"}
INSIDE = {"capacity", "alpha", "beta"}
"""Of replay_buffer_config."""


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_every_name_of_rllib_is_one(algorithm: Algorithm) -> None:
    from ray.rllib.algorithms.dqn import DQNConfig
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

    config = {"ppo": PPOConfig, "dqn": DQNConfig}[algorithm]()
    known = {*vars(config), "lambda", *(field.name for field in dataclasses.fields(DefaultModelConfig))}
    if algorithm == "dqn":
        known |= config.replay_buffer_config.keys() & INSIDE
    known |= {name for name in ("train_batch_size_per_learner",) if isinstance(getattr(type(config), name), property)}
    assert {foreign.name for foreign in FOREIGN_NAMES[algorithm] if foreign.library == "RLlib"} <= known | OLD


def test_what_is_said_of_rllibs_defaults_and_schedules_holds() -> None:
    from ray.rllib.algorithms.dqn import DQNConfig
    from ray.rllib.algorithms.ppo import PPOConfig

    ppo, dqn = PPOConfig(), DQNConfig()
    assert (ppo.use_kl_loss, ppo.vf_clip_param, ppo.grad_clip_by) == (True, 10.0, "global_norm")
    assert "Prioritized" in dqn.replay_buffer_config["type"]
    assert dqn.epsilon == [(0, 1.0), (10_000, 0.05)]
