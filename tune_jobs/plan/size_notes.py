"""Notes of a plan on observations and rewards that networks hardly learn from, as they are too large or too small.

What they bring was measured: decision 58.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import gymnasium as gym
import numpy as np

from policies.acting.baselines import BASELINES
from policies.envs.first_step import Largest
from policies.envs.flat import named
from policies.envs.images import image_members
from policies.envs.make import EnvInfo
from policies.envs.masks import seen_by_networks
from tune_jobs.plan.engine_choice import PackPlan, possible_filters
from tune_jobs.spec.sweep_spec import SweepSpec

_FEW_TIMES = 20
"""How many times what is seen the space allows, from where that is told: MiniGrid's numbers are up to 10 of 255."""
_SMALL, _LARGE, _LARGE_REWARD = 0.1, 10.0, 5.0
_NORMALIZE, _SCALE = "normalize_observations", "reward_scale"


def size_notes(spec: SweepSpec, env: EnvInfo, packs: PackPlan | None) -> Iterator[str]:
    """Yield notes on the sizes of what an environment gives, to whom they matter.

    Args:
        spec: The sweep.
        env: Its environment, with its wrappers.
        packs: Say what random play showed, if some are planned.
    """
    if spec.algorithm in BASELINES or spec.rl_module is not None:
        return
    if env.largest is not None and _NORMALIZE not in spec.space and not spec.hyperparams.get(_NORMALIZE):
        seen = seen_by_networks(env.observation_space)
        assert isinstance(seen, gym.spaces.Box)
        if env.observes_images and seen.dtype == np.uint8:
            yield from _on_bytes(env.env_id, abs(env.largest.value), int(seen.high.max()))
        elif (highest := _highest_of_convolved(spec, env, env.largest)) is not None:
            yield from _on_bytes(env.env_id, abs(env.largest.value), highest)
        else:
            yield from _on_numbers(env.env_id, env.largest, None if packs is None else packs.largest)
    is_clipped = spec.env.atari is not None and spec.env.atari.clip_rewards
    is_scaled = is_clipped or _SCALE in spec.space or _SCALE in spec.hyperparams
    if spec.algorithm == "dqn" and packs is not None and packs.reward is not None and not is_scaled:
        yield from _on_rewards(env.env_id, packs.reward)


def _highest_of_convolved(spec: SweepSpec, env: EnvInfo, largest: Largest) -> int | None:
    """Return the most that bytes may be which convolutions see, if the largest number is one of them; None: it is not.

    As a member beside others, these are divided by it only where convolutions see them: in every trial of the sweep.
    """
    if env.image is None or not all(possible_filters(spec)):
        return None
    for keys, part in zip(image_members(env.observation_space), env.image.parts, strict=False):
        if largest.place.startswith(named(keys)) and part.scale != 1.0:
            return round(1 / part.scale)
    return None


def _on_bytes(env_id: str, largest: float, highest: int) -> Iterator[str]:
    if 0 < largest <= highest / _FEW_TIMES:
        yield (
            f"The first image of {env_id} has numbers of up to {largest:g}, and its space allows {highest}: divided "
            f"by {highest}, as images of bytes are, they are next to nothing for a network. hyperparams.{_NORMALIZE}: "
            "true brings them to a usual size; so does a space that says what they are."
        )


def _on_numbers(env_id: str, first: Largest, played: float | None) -> Iterator[str]:
    if abs(first.value) >= _LARGE:
        yield (
            f"The first observation of {env_id} has numbers as large as {_short(first.value)} ({first.place}): "
            f"networks learn little from numbers that are far from 1. hyperparams.{_NORMALIZE}: true brings all to "
            "that size."
        )
    elif played is not None and 0 < played < _SMALL:
        yield (
            f"No number that {env_id} observes in random play is as far from 0 as {_SMALL}: the largest is "
            f"{played:.2g}, and networks hardly tell such numbers apart. hyperparams.{_NORMALIZE}: true brings all to "
            "a usual size."
        )


def _on_rewards(env_id: str, reward: float) -> Iterator[str]:
    if reward >= _LARGE_REWARD:
        yield (
            f"Rewards of {env_id} are of about {_short(reward)} a step: DQN's values begin near 0, and come late or "
            f"never to sums of such rewards. hyperparams.{_SCALE}: {10.0 ** -max(1, round(math.log10(reward))):g} has "
            "it learn from smaller ones, and changes no return. PPO hardly minds, and has normalize_rewards."
        )


def _short(value: float) -> str:
    """Return a large number in few digits: 41,250, -300.5, 1e+09."""
    return f"{value:,.0f}" if 1_000 <= abs(value) < 1_000_000_000 else f"{value:.4g}"
