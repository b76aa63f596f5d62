"""What a source of a policy names: a sweep or a baseline of one name; and what it keeps in another environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fake_sweeps import FakeSweeps, RunCommand
from sweep_folders import make_sweep_folder

from policies.acting.baselines import ConstantPolicy, baseline_policy
from policies.acting.policy import NetworkPolicy, RandomPolicy
from policies.envs.atari import ATARI
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
