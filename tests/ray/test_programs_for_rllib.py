"""The written programs for RLlib configure it as ours trains."""

import importlib.util
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from policies.envs.images import scale_of_bytes
from policies.foreign_code import rllib_program
from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams
from policies.networks.epsilon import EpsilonSchedule

pytestmark = pytest.mark.ray


def names_of(values: TrainedHyperparams, *, builds: bool = False) -> dict[str, Any]:
    code = rllib_program(values, env_id="CartPole-v1", env_args={}).code
    names: dict[str, Any] = {}
    # The last line builds.
    exec(code if builds else code.rsplit("\n", 1)[0], names)
    return names


def config_of(values: TrainedHyperparams) -> Any:
    config = names_of(values)["config"]
    config.validate()
    return config


@pytest.mark.parametrize("hyperparams", [PPOHyperparams, DQNHyperparams])
@pytest.mark.parametrize("grad_clip", [None, 0.5])
def test_gradients_are_clipped_as_ours(hyperparams: Any, grad_clip: float | None) -> None:
    assert config_of(hyperparams(grad_clip=grad_clip)).grad_clip == grad_clip


@pytest.mark.parametrize("start", [0, 300])
def test_epsilon_moves_as_ours(start: int) -> None:
    from ray.rllib.utils.schedules.scheduler import Scheduler

    values = DQNHyperparams(epsilon_start=start, epsilon_decay=200)
    scheduler = Scheduler(fixed_value_or_schedule=config_of(values).epsilon, framework="torch")
    ours = EpsilonSchedule.of(values)
    for now in (0, 150, 299, 400, 1_000):
        assert scheduler.update(timestep=now) == pytest.approx(ours.at(now))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, (4, [1, 1])),
        ({"updates_per_env_step": 0.1}, (10, [1, 1])),
        ({"updates_per_env_step": 0.01, "num_envs": 8}, (25, [1, 2])),
        ({"train_freq": 10, "num_envs": 4}, (3, [1, 3])),
        ({"n_step": 5}, (8, [1, 2])),
        ({"updates_per_env_step": 0.0837}, (12, [1, 1])),
    ],
)
def test_updates_are_as_many_as_ours(changes: dict[str, Any], expected: tuple[int, list[int]]) -> None:
    from ray.rllib.algorithms.dqn.dqn import calculate_rr_weights

    config = config_of(DQNHyperparams(**changes))
    assert (config.get_rollout_fragment_length(), calculate_rr_weights(config)) == expected


@pytest.mark.parametrize("values", [PPOHyperparams(activation="tanh"), DQNHyperparams(activation="elu", dueling=False)])
def test_layers_after_convolutions_are_ours(values: TrainedHyperparams) -> None:
    values = values.model_copy(update={"conv_filters": ((4, 3, 2), (8, 3, 2)), "hidden_sizes": (24,)})
    spaces: tuple[gym.Space[Any], ...] = gym.spaces.Box(0, 1, (16, 16, 3)), gym.spaces.Discrete(2)
    spec = config_of(values).get_rl_module_spec(spaces={"default_policy": spaces})
    layers = [type(layer).__name__ for layer in spec.build().modules()]
    # PPO has a policy and a value function; DQN's target network is made later, by the learner.
    name, num_networks = ("Tanh", 2) if isinstance(values, PPOHyperparams) else ("ELU", 1)
    assert layers.count(name) == 3 * num_networks
    assert "ReLU" not in layers


class Images(gym.Env[Any, Any]):
    """Shows an image whose numbers are the largest of its space.

    Args:
        largest: That number.
        dtype: The type of the numbers.
    """

    def __init__(self, largest: int, dtype: str) -> None:
        self.image = np.full((16, 16, 3), largest, dtype)
        self.observation_space = gym.spaces.Box(0, largest, self.image.shape, self.image.dtype.type)
        self.action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.image, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.image, 1.0, False, True, {}


@pytest.mark.parametrize(
    "values",
    [
        PPOHyperparams(num_envs=2, train_batch_size=8, minibatch_size=8, num_epochs=1),
        DQNHyperparams(learning_starts=0, train_batch_size=4, replay_capacity=64, env_steps_per_iteration=8),
    ],
    ids=type,
)
@pytest.mark.parametrize(("largest", "dtype"), [(255, "uint8"), (1, "uint8"), (7, "float32")])
def test_convolutions_see_images_of_bytes_as_ours_do(values: TrainedHyperparams, largest: int, dtype: str) -> None:
    values = values.model_copy(update={"conv_filters": ((4, 3, 2),), "hidden_sizes": (8,)})
    env_args = {"largest": largest, "dtype": dtype}
    gym.register("Images-v0", partial(Images))
    names: dict[str, Any] = {}
    try:
        exec(rllib_program(values, env_id="Images-v0", env_args=env_args).code, names)
        algorithm = names["algorithm"]
        assert algorithm.train()["num_env_steps_sampled_lifetime"] > 0
        seen, _ = algorithm.env_runner.env.reset()
        algorithm.stop()
    finally:
        del gym.registry["Images-v0"]
    own = Images(largest, dtype)
    assert np.all(seen == own.image * np.float32(scale_of_bytes(own.observation_space)))
    assert seen.dtype == np.float32


def test_soft_target_updates_follow_every_update_and_adam_is_torchs() -> None:
    from ray.rllib.utils.metrics import NUM_TARGET_UPDATES

    values = DQNHyperparams(
        hidden_sizes=(4,), tau=0.1, train_freq=100, updates_per_env_step=0.1, learning_starts=0, optimizer_epsilon=1e-3
    )
    algorithm = names_of(values, builds=True)["algorithm"]
    try:
        result = algorithm.train()
        optimizer = algorithm.learner_group._learner.get_optimizer("default_policy")
    finally:
        algorithm.stop()
    num_env_steps = result["num_env_steps_sampled_lifetime"]
    assert result["learners"]["default_policy"][NUM_TARGET_UPDATES] == num_env_steps * 0.1
    # The note on what is left out says so.
    assert (optimizer.defaults["eps"], optimizer.defaults["betas"]) == (1e-8, (0.9, 0.999))


@pytest.mark.parametrize("values", [PPOHyperparams(train_batch_size=64, minibatch_size=32), DQNHyperparams()], ids=type)
def test_observations_that_are_no_vectors_are_made_some(values: TrainedHyperparams) -> None:
    names: dict[str, Any] = {}
    exec(rllib_program(values, env_id="Blackjack-v1", env_args={"sab": True}, flattens=True).code, names)
    algorithm = names["algorithm"]
    try:
        assert algorithm.train()["num_env_steps_sampled_lifetime"] > 0
        assert algorithm.env_runner.env.single_observation_space.shape == (32 + 11 + 2,)
    finally:
        algorithm.stop()


@pytest.mark.parametrize(("name", "flattens"), [("Lake", True), ("Plain", False)])
def test_it_trains_on_a_class_of_ones_own(
    name: str, flattens: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_plain.py").write_text(
        "from gymnasium.envs.classic_control import CartPoleEnv\n"
        "from gymnasium.envs.toy_text import FrozenLakeEnv\n\n\n"
        "class Plain(CartPoleEnv):\n    pass\n\n\n"
        "class Lake(FrozenLakeEnv):\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    values = PPOHyperparams(num_envs=2, train_batch_size=64, minibatch_size=32, hidden_sizes=(8,))
    env_args: dict[str, Any] = {"is_slippery": False, "max_episode_steps": 20} if flattens else {}
    names: dict[str, Any] = {}
    exec(rllib_program(values, env_id=f"own_plain:{name}", env_args=env_args, flattens=flattens).code, names)
    assert names["algorithm"].train()["num_env_steps_sampled_lifetime"] >= 64
    names["algorithm"].stop()
    del gym.registry[f"{name}-v0"]


@pytest.mark.skipif(importlib.util.find_spec("ale_py") is None, reason="the emulator of Atari is not installed")
@pytest.mark.parametrize("env_id", ["ALE/Pong-v5", "PongNoFrameskip-v4"])
def test_it_finds_an_atari_game_in_a_fresh_process(env_id: str, tmp_path: Path) -> None:
    values = PPOHyperparams(train_batch_size=64, minibatch_size=32, hidden_sizes=(8,))
    code = rllib_program(values, env_id=env_id, env_args={"obs_type": "ram"}).code
    code += "\nprint(algorithm.env_runner.env.single_observation_space)\nalgorithm.stop()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "Box(0, 255, (128,), uint8)"
