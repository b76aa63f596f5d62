"""What ArrayEnvRunner counts is what RLlib's own runner counts, and what it keeps for that is small."""

from __future__ import annotations

import gc
import types
from typing import Any

import numpy as np
import pytest
import torch
from test_env_runner import ENVS, make_config, make_runners

from policies.envs import modules

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

LOGGED = (
    "episode_return_mean", "episode_return_min", "episode_return_max", "episode_len_mean", "episode_len_min",
    "episode_len_max", "num_episodes", "num_episodes_lifetime", "num_env_steps_sampled_lifetime",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _nothing_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """What other tests of this process allowed would be among the env's arguments, which RLlib's runner hands on."""
    monkeypatch.setattr(modules, "_allowed", set())


def steps_told(runner: Any, num_env_steps: int, sizes: list[int]) -> list[int]:
    """The env steps of the trial that an own module's exploration is told, at each of the runner's steps."""
    told: list[int] = []
    forward = runner.module._forward_exploration

    def telling(batch: Any, **kwargs: Any) -> Any:
        told.append(kwargs["t"])
        return forward(batch, **kwargs)

    runner.module._forward_exploration = telling
    for size in sizes:
        runner.set_state({"num_env_steps_sampled_lifetime": num_env_steps})
        runner.sample(num_timesteps=size, explore=True)
        num_env_steps += 1_000
    return told


@pytest.mark.parametrize(("num_env_runners", "first"), [(0, 50_001), (2, 50_000)])
def test_exploration_is_told_the_env_steps_of_the_trial(num_env_runners: int, first: int) -> None:
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

    from policies.rllib.env_runner import ArrayEnvRunner

    config = make_config("ppo", "cartpole").env_runners(num_env_runners=num_env_runners)
    theirs_config = config.copy(copy_frozen=False).env_runners(
        env_runner_cls=SingleAgentEnvRunner, gym_env_vectorize_mode=ENVS["cartpole"][3]
    )
    worker_index = min(num_env_runners, 1)
    ours = ArrayEnvRunner(config=config, worker_index=worker_index)
    theirs = SingleAgentEnvRunner(config=theirs_config, worker_index=worker_index)
    # Too few steps for an episode to end.
    told = steps_told(ours, 50_001, [20, 8])
    assert told == steps_told(theirs, 50_001, [20, 8])
    assert told[:2] == [first, first + 4 * max(1, num_env_runners)]
    assert told[5] == first + 1_000


def test_metrics_of_episodes_over_several_fragments_are_those_of_rllibs_runner() -> None:
    logged = []
    for runner in make_runners("ppo", "ticks"):
        torch.manual_seed(1)
        fragments = []
        for _ in range(12):
            runner.sample(num_timesteps=15, explore=True)
            found = runner.get_metrics()
            fragments.append({name: found[name].peek() for name in LOGGED if name in found})
        logged.append(fragments)
    ours, theirs = logged
    assert ours == theirs
    assert set(ours[-1]) == set(LOGGED)
    # Episodes of 4 to 6 steps: those of a chunk alone are shorter.
    assert ours[-1]["episode_len_min"] >= 4


def test_no_array_of_a_running_episode_is_kept_for_its_metrics() -> None:
    ours, _ = make_runners("ppo", "pendulum")
    num_steps = 0
    for _ in range(3):
        num_steps += sum(len(chunk) for chunk in ours.sample(num_timesteps=30, explore=True))
        ours.get_metrics()
    kept = ours._ongoing_episodes_for_metrics
    assert [len(parts) for parts in kept.values()] == [3, 3, 3]
    assert sum(len(part) for parts in kept.values() for part in parts) == num_steps == 90
    assert not [each for each in reachable(kept) if isinstance(each, np.ndarray)]


def reachable(root: object) -> list[object]:
    """Everything that an object holds, but classes, functions and modules, which hold everything."""
    found, todo = {id(root): root}, [root]
    while todo:
        for each in gc.get_referents(todo.pop()):
            if id(each) not in found and not isinstance(each, type | types.ModuleType | types.FunctionType):
                found[id(each)] = each
                todo.append(each)
    return list(found.values())
