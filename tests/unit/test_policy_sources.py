"""What a source of a policy names: a sweep or a baseline of one name; and what it keeps in another environment."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fake_sweeps import FakeSweeps, RunCommand
from policy_factory import make_portable
from sweep_folders import make_sweep_folder

from policies.acting.baselines import ConstantPolicy, baseline_policy
from policies.acting.policy import NetworkPolicy, RandomPolicy
from policies.envs import modules as env_modules
from policies.envs.atari import ATARI
from policies.envs.modules import allow_modules
from policies.envs.own_process import OWN_PROCESS
from policies.envs.wrappers import FRAME_STACK
from policies.errors import SpecError
from policies.hyperparams import ConstantHyperparams
from policies.portable.file import save_policy
from tests.narrowing import present
from tune_jobs.sweeps.conclude import find_policy


@pytest.mark.parametrize("name", ["random", "constant"])
def test_a_sweep_that_is_called_as_a_baseline_is_found_by_its_name(name: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="no environment of its own"):
        find_policy(name, tmp_path)
    make_sweep_folder(tmp_path / name)
    found = find_policy(name, tmp_path)
    assert present(found.store).name == name
    assert isinstance(found.policy, NetworkPolicy)
    # With an environment, as before, it is the baseline.
    baseline = find_policy(name, tmp_path, env_id="CartPole-v1")
    assert baseline.store is None
    assert isinstance(baseline.policy, RandomPolicy | ConstantPolicy)
    # No sweep's policy takes an action.
    with pytest.raises(SpecError, match="no environment of its own"):
        find_policy(name, tmp_path, action=1)


@pytest.mark.parametrize("command", ["evaluate", "video"])
def test_the_commands_find_it_too(run: RunCommand, sweeps: FakeSweeps, command: str, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    make_sweep_folder(elsewhere / "random")
    refused = run(command, "random")
    assert refused.exit_code == 2
    assert "Add --env" in refused.stderr
    assert sweeps.calls == []
    assert run(command, "random", "--storage", elsewhere).exit_code == 0
    assert [call[:2] for call in sweeps.calls] == [(command, ("random",))]


@pytest.mark.parametrize(
    "kept",
    [
        {ATARI: {"frame_skip": 4, "noop_max": 30, "screen_size": 84}, FRAME_STACK: 4},
        {OWN_PROCESS: True, FRAME_STACK: 4},
    ],
)
def test_in_another_environment_a_policy_keeps_all_wrappers_of_its_own(kept: dict[str, Any], tmp_path: Path) -> None:
    policy = baseline_policy(
        ConstantHyperparams(action=0),
        env_id="PongNoFrameskip-v4",
        env_args={**kept, "x": 1},
        observation_space=gym.spaces.Box(0, 255, (84, 84, 4), np.uint8),
        action_space=gym.spaces.Discrete(6),
    )
    save_policy(policy, tmp_path)
    assert find_policy(tmp_path).env_args == {**kept, "x": 1}
    # The arguments of the constructor are the other one's.
    assert find_policy(tmp_path, env_id="ALE/Pong-v5").env_args == kept
    assert find_policy(tmp_path, env_id="PongNoFrameskip-v4").env_args == {**kept, "x": 1}


def test_an_id_without_its_version_may_name_the_policys_own_environment(tmp_path: Path) -> None:
    save_policy(make_portable("Pendulum-v1", g=2.0, max_episode_steps=20), tmp_path)
    own = find_policy(tmp_path)
    assert (own.env_id, own.env_args) == ("Pendulum-v1", {"g": 2.0, "max_episode_steps": 20})
    for env_id in ("Pendulum", "Pendulum-v1", " Pendulum-v1 "):
        named = find_policy(tmp_path, env_id=env_id)
        assert (named.env_id, named.env_args) == (own.env_id, own.env_args)
    other = find_policy(tmp_path, env_id="CartPole")
    assert (other.env_id, other.env_args) == ("CartPole-v1", {})
    # Whoever makes it says what is wrong.
    assert find_policy(tmp_path, env_id="Pendulun").env_id == "Pendulun"


def test_so_it_is_for_a_sweeps_best_policy(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    assert present(find_policy(store.folder, env_id="CartPole").store).place == store.place
    assert find_policy(store.folder, env_id="CartPole-v0").store is None


def test_so_it_is_for_an_environment_of_ones_own_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_named.py").write_text(
        "import gymnasium\n"
        "for version in (1, 2):\n"
        "    gymnasium.register(f'OwnNamed-v{version}', 'gymnasium.envs.classic_control:CartPoleEnv')\n"
    )
    monkeypatch.setattr(env_modules, "_allowed", set())
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    policy = baseline_policy(
        ConstantHyperparams(action=0),
        env_id="own_named:OwnNamed-v2",
        env_args={"sutton_barto_reward": True},
        observation_space=gym.spaces.Box(-1, 1, (4,), np.float32),
        action_space=gym.spaces.Discrete(2),
    )
    save_policy(policy, tmp_path)
    # Not known before it is allowed.
    assert find_policy(tmp_path, env_id="own_named:OwnNamed").env_args == {}
    allow_modules(["own_named"])
    found = find_policy(tmp_path, env_id="own_named:OwnNamed")
    assert (found.env_id, found.env_args) == ("own_named:OwnNamed-v2", {"sutton_barto_reward": True})
    assert find_policy(tmp_path, env_id="own_named:OwnNamed-v1").env_args == {}
    # The module was imported in the guard's child alone.
    assert "own_named" not in sys.modules
