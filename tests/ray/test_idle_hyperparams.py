"""What `policies.idle.find` says to be idle is on RLlib's engine too; for packs see `tests/unit/test_acting.py`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trials import make_task

from policies.hyperparams import Algorithm, make_hyperparams
from policies.idle.find import Limits, idle_rule

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

LIMITS = Limits(num_env_steps=200, num_iterations=2, max_episode_steps=8, is_packed=False)
# (algorithm, name, two values, further hyperparameters): where the engines' code differs most.
CASES = [
    ("ppo", "lr", (1e-3, 1e-2), {"lr_final": 1e-4, "lr_decay_steps": 128}),
    ("ppo", "gae_lambda", (0.2, 0.9), {"gamma": 0.0}),
    ("ppo", "vf_clip_param", (0.01, 5.0), {"vf_loss_coeff": 0.0}),
    ("ppo", "vf_clip_range", (0.001, 5.0), {"vf_loss_coeff": 0.0}),
    ("ppo", "kl_target", (1e-6, 9.0), {"use_kl_loss": True, "kl_coeff": 0.0}),
    ("dqn", "lr_decay_steps", (3, 30), {"lr_final": 1e-4}),
    ("dqn", "n_step", (8, 20), {}),
    ("dqn", "target_update_unit", ("env_step", "episode"), {"target_update_freq": 201}),
    ("dqn", "replay_capacity", (200, 999), {"replay": "prioritized"}),
    ("dqn", "learning_starts", (0, 16), {}),
    ("dqn", "epsilon_final", (0.0, 0.9), {"epsilon_start": 200}),
]


@pytest.mark.parametrize(("algorithm", "name", "values", "further"), CASES, ids=[f"{one[0]}-{one[1]}" for one in CASES])
def test_what_is_said_to_be_idle_is_on_rllib(
    tmp_path: Path, algorithm: Algorithm, name: str, values: tuple[Any, Any], further: dict[str, Any]
) -> None:
    from tune_jobs.training.rllib import RLlibEngine

    engine, found = RLlibEngine(), []
    for value in values:
        task = make_task(tmp_path, algorithm, env_args={"max_episode_steps": 8}, **{**further, name: value})
        assert idle_rule(algorithm, name, make_hyperparams(algorithm, task.hyperparams), LIMITS) is not None
        engine.build(task, None)
        episodes = [episode for _ in range(2) for episode in engine.train_iteration().episodes]
        module = engine.algorithm.learner_group._learner.module["default_policy"]
        weights = {key: value.numpy().copy() for key, value in module.state_dict().items()}
        found.append((episodes, weights))
    engine.close()
    (episodes, weights), (episodes2, weights2) = found
    assert episodes == episodes2
    for key, value in weights.items():
        np.testing.assert_array_equal(value, weights2[key], err_msg=key)
