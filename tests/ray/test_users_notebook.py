"""A script's own environment in the script's own Ray, and a restore in a process that has none."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ray

SCRIPT = Path(__file__).with_name("a_users_notebook.py")
ENVS = """
import gymnasium as gym
import numpy as np


class Maze(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 5
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), {}

    def step(self, action):
        self.left -= 1
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), float(action), self.left == 0, False, {}
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the script says."""
    folder, source = tmp_path_factory.mktemp("notebook"), tmp_path_factory.mktemp("src")
    (source / "notebooks_envs.py").write_text(ENVS)
    command = [sys.executable, str(SCRIPT), str(folder / "sweeps"), str(source)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    told: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return told


@pytest.mark.parametrize(("what", "trials"), [("packed", ["packed: completed"]), ("single", ["rllib: completed"])])
def test_modules_of_the_scripts_own_path_are_found_in_its_own_ray(
    said: dict[str, Any], what: str, trials: list[str]
) -> None:
    """Also by an env runner, whose process RLlib starts."""
    assert said[what] == trials


def test_a_restore_leaves_what_the_script_draws_and_its_signals_and_starts_ray_for_this_machine_alone(
    said: dict[str, Any],
) -> None:
    assert said["changed"] == []
    assert said["listens at"] == "127.0.0.1"
    assert said["trains on"] == 3
