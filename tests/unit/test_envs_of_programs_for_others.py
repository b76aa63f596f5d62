"""The environments of the programs for other libraries: they are found, and their images and actions are taken."""

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from report_sources import setting, settings_of, source_of
from synthetic_sweep import make_sweep

from analysis.page import next_steps
from policies.foreign_code import rllib_program, stable_baselines3_program
from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams

MINIBATCHES = "SB3 standardises advantages over each minibatch, ours over the whole train batch."
SMALL = PPOHyperparams(hidden_sizes=(4,), num_envs=2, train_batch_size=32, minibatch_size=16)
PACKAGE = """
import gymnasium as gym
from gymnasium.envs.classic_control import CartPoleEnv

def register():
    gym.register("FromAPackage-v0", CartPoleEnv, max_episode_steps=10)

def register_more():
    gym.register("Spaced-v1", CartPoleEnv)
"""


class Images(gym.Env[Any, Any]):
    """Shows images of bytes.

    Args:
        size: Their height and width.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (as Gymnasium's own)

    def __init__(self, size: int) -> None:
        self.observation_space = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        self.action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 1.0, False, False, {}


@pytest.fixture
def images(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    """The id of an environment of images."""
    # Stable-Baselines3 makes a folder for each model, of which nobody would take it away.
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))
    gym.register("Images-v0", partial(Images))
    yield "Images-v0"
    del gym.registry["Images-v0"]


def run(code: str, folder: Path) -> str:
    """Run code in a process of its own, with the modules of a folder; returns what it prints."""
    code = f"import sys\nsys.path.insert(0, {str(folder)!r})\n{code}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def install(folder: Path, name: str, entry_points: str) -> None:
    """Make a package that declares functions which register environments."""
    (folder / f"{name}.py").write_text(PACKAGE)
    metadata = folder / f"{name}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[gymnasium.envs]\n{entry_points}")


@pytest.mark.skipif(importlib.util.find_spec("ale_py") is None, reason="the emulator of Atari is not installed")
def test_sb3_finds_an_atari_game(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    code = stable_baselines3_program(SMALL, env_id="ALE/Pong-v5", env_args={}, num_env_steps=2).code
    making = code.partition("model = ")[0]
    assert (
        run(f"{making}print(env.observation_space)", tmp_path).splitlines()[-1] == "Box(0, 255, (210, 160, 3), uint8)"
    )


@pytest.mark.parametrize("env_id", ["ALE/Pong-v5", "PongNoFrameskip-v4"])
def test_the_module_that_registers_atari_games_is_named(env_id: str) -> None:
    for code in (
        stable_baselines3_program(SMALL, env_id=env_id, env_args={}, num_env_steps=2).code,
        rllib_program(SMALL, env_id=env_id, env_args={}).code,
    ):
        assert f"'ale_py:{env_id}'" in code


def test_sb3_finds_an_env_of_an_installed_package(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    install(tmp_path, "its_envs", "__root__ = its_envs:register\nmine = its_envs:register_more\n")
    run(
        "from policies.foreign_code import rllib_program, stable_baselines3_program\n"
        "from policies.hyperparams import PPOHyperparams\n"
        "values, programs = PPOHyperparams(num_envs=2, train_batch_size=32, minibatch_size=16), []\n"
        "for env_id in ('FromAPackage', 'mine/Spaced-v1'):\n"
        "    programs.append(stable_baselines3_program(values, env_id=env_id, env_args={}, num_env_steps=2))\n"
        "    rllib = rllib_program(values, env_id=env_id, env_args={}, flattens=True)\n"
        "    assert 'import its_envs' in rllib.code and 'import gymnasium\\n' in rllib.code\n"
        f"    assert programs[-1].notes == ({MINIBATCHES!r},) and rllib.notes == ()\n"
        "    assert programs[-1].code.count('its_envs.register') == rllib.code.count('its_envs.register') == 1\n"
        "assert 'its_envs' not in sys.modules\n"
        "for program in programs:\n"
        "    names = {}\n"
        "    exec(program.code, names)\n"
        "    assert names['model'].num_timesteps == 32\n",
        tmp_path,
    )


def test_packages_of_which_one_registers_an_env_are_told(tmp_path: Path) -> None:
    for name in ("one_envs", "two_envs"):
        install(tmp_path, name, f"__root__ = {name}.__init__:register\n")
    told = run(
        "from policies.foreign_code import stable_baselines3_program\n"
        "from policies.hyperparams import PPOHyperparams\n"
        "values = PPOHyperparams(normalize_advantages=False)\n"
        "for env_id in ('FromAPackage-v0', 'CartPole-v1', 'CartPole', 'phys2d/CartPole-v1'):\n"
        "    program = stable_baselines3_program(values, env_id=env_id, env_args={}, num_env_steps=2)\n"
        "    print(program.notes, [line for line in program.code.splitlines() if '_envs.' in line])\n",
        tmp_path,
    ).splitlines()
    assert told[1:] == ["() []"] * 3
    for name in ("one_envs", "two_envs"):
        assert f"'{name}.register()'" in told[0]
    assert "FromAPackage-v0 is registered by one of " in told[0]


# -- images


@pytest.mark.parametrize(
    "values", [SMALL, SMALL.model_copy(update={"normalize_rewards": True}), DQNHyperparams(replay_capacity=64)]
)
def test_sb3s_convolutions_see_the_bytes_of_images(values: TrainedHyperparams, images: str) -> None:
    pytest.importorskip("stable_baselines3")
    scales = isinstance(values, PPOHyperparams) and values.normalize_rewards
    values = values.model_copy(update={"conv_filters": ((4, 8, 4),), "normalize_observations": True})
    program = stable_baselines3_program(values, env_id=images, env_args={"size": 40}, num_env_steps=32)
    assert ("VecNormalize(env, norm_obs=False, gamma=" in program.code) is scales
    assert ("VecNormalize" in program.code) is scales
    assert "normalize_observations is left out: CnnPolicy takes bytes." in program.notes
    names: dict[str, Any] = {}
    # The last line trains.
    exec(program.code.rsplit("\n", 1)[0], names)
    assert names["model"].observation_space.dtype == np.uint8
    plain = stable_baselines3_program(
        PPOHyperparams(normalize_observations=True), env_id="E", env_args={}, num_env_steps=1
    )
    assert "env = VecNormalize(env, norm_reward=False)" in plain.code
    assert plain.notes == (MINIBATCHES,)


def test_the_least_images_that_sb3s_convolutions_take_are_told(images: str) -> None:
    pytest.importorskip("stable_baselines3")
    values = SMALL.model_copy(update={"conv_filters": ((4, 8, 4),)})
    told = "CnnPolicy has its own, for images of bytes of 36 x 36 pixels or more; others take a features extractor"
    for size in (35, 36):
        program = stable_baselines3_program(values, env_id=images, env_args={"size": size}, num_env_steps=32)
        assert sum(told in note for note in program.notes) == 1
        making = program.code.rsplit("\n", 1)[0]
        if size == 36:
            exec(making, {})
        else:
            with pytest.raises(RuntimeError, match="Kernel size"):
                exec(making, {})


# -- actions


def notes_of_a_report(**changes: Any) -> tuple[str, str]:
    """What the report says of the programs for Stable-Baselines3 and RLlib."""
    made = make_sweep()
    is_masked = changes.pop("is_masked", False)
    made.sweep = made.sweep.model_copy(update={"is_masked": is_masked})
    made.trials = [trial.model_copy(update={"hyperparams": {**trial.hyperparams, **changes}}) for trial in made.trials]
    steps = next_steps.section(source_of(made, settings_of(setting(0, [made.trials[0].trial_id], 1)))).steps
    sb3, rllib = (step.why for step in steps if step.title.startswith("The setting in "))
    return sb3, rllib


def test_what_sb3_does_otherwise_with_continuous_actions_is_told() -> None:
    stretched = "SB3 clips them to their bounds, over which ours stretch -1 to 1 (Gymnasium's RescaleAction does that)"
    one = "its deviation is one for all observations"
    sb3, rllib = notes_of_a_report()
    assert f"If actions are continuous, {stretched}, and {one}, of which ours has one for each." in sb3
    # RLlib's actions and deviations are made as ours.
    assert "continuous" not in rllib
    sb3, _ = notes_of_a_report(free_log_std=True)
    assert f"If actions are continuous, {stretched}." in sb3
    assert one not in sb3
    # Masked actions are not continuous.
    sb3, _ = notes_of_a_report(is_masked=True)
    assert "continuous" not in sb3
    for values in (PPOHyperparams(), DQNHyperparams(double_q=False, dueling=False, learning_starts=0)):
        program = stable_baselines3_program(values, env_id="E", env_args={}, num_env_steps=1, may_be_continuous=True)
        assert any("continuous" in note for note in program.notes) is isinstance(values, PPOHyperparams)


def test_sb3_has_one_deviation_and_clips_actions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stable_baselines3")
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))
    code = stable_baselines3_program(SMALL, env_id="Pendulum-v1", env_args={}, num_env_steps=2).code
    names: dict[str, Any] = {}
    exec(code.rsplit("\n", 1)[0], names)
    policy = names["model"].policy
    assert policy.log_std.shape == (1,)
    assert not policy.squash_output
