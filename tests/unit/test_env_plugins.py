"""Environments of installed packages are found: by the entry points that packages declare for Gymnasium."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

MODULE = """
import gymnasium as gym
from gymnasium.envs.classic_control import CartPoleEnv

def register():
    gym.register("FromAPackage-v0", CartPoleEnv, max_episode_steps=10)

def register_more():
    gym.register("Spaced-v1", CartPoleEnv)

def broken():
    raise OSError("no display")
"""
ENTRY_POINTS = """
[gymnasium.envs]
__root__ = my_envs:register
broken = my_envs:broken
mine = my_envs:register_more
"""


@pytest.fixture
def run_python(tmp_path: Path) -> Callable[[str], list[str]]:
    """Run code in a process that has such a package installed; returns what it prints."""
    (tmp_path / "my_envs.py").write_text(MODULE)
    metadata = tmp_path / "my_envs-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my-envs\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS)

    def run(code: str) -> list[str]:
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{code}"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        return done.stdout.split()

    return run


def test_an_env_of_an_installed_package_is_found(run_python: Callable[[str], list[str]]) -> None:
    assert run_python(
        "from policies.envs.make import check_env, make_vector_env\n"
        "print(check_env('FromAPackage-v0', {}, 'dqn').max_episode_steps)\n"
        "print(check_env('FromAPackage', {}).env_id)\n"
        "print(make_vector_env('mine/Spaced-v1', {}, 3).num_envs)\n"
    ) == ["10", "FromAPackage-v0", "3"]


def test_nothing_of_a_package_is_imported_for_an_env_that_is_known(run_python: Callable[[str], list[str]]) -> None:
    assert run_python(
        "from policies.envs.make import check_env\n"
        "check_env('CartPole-v1', {}); check_env('CartPole', {})\n"
        "print('my_envs' in sys.modules)\n"
    ) == ["False"]


def test_a_package_that_fails_is_named_where_an_env_is_missing(run_python: Callable[[str], list[str]]) -> None:
    text = " ".join(
        run_python(
            "from policies.envs.make import check_env\n"
            "from policies.errors import EnvError\n"
            "check_env('mine/Spaced-v1', {})\n"
            "try:\n    check_env('FromAPackag-v0', {})\nexcept EnvError as error:\n    print(error)\n"
        )
    )
    assert "Did you mean 'FromAPackage-v0'?" in text
    assert "The package my-envs could not register its own: OSError: no display." in text
