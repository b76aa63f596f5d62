"""Notes of a plan on what a sweep's environment gives, and on what is made of it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, TypeGuard

import gymnasium as gym
import numpy as np
from gymnasium.spaces.utils import flatdim

from analysis.wording import counted, duration
from policies.acting.baselines import BASELINES
from policies.acting.evaluate import MAX_EPISODE_STEPS
from policies.envs.flat import FlatBox, leaves, named
from policies.envs.images import image_members
from policies.envs.make import EnvInfo
from policies.envs.masks import seen_by_networks
from policies.envs.own_actions import Choices, is_made
from policies.envs.space_hints import image_alone_hint, named_images
from policies.envs.stacked import StackedBox, WithMembers
from policies.errors import shortened
from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.plan.env_checks import channels_hint, filters_example
from tune_jobs.plan.size_notes import size_notes
from tune_jobs.spec.sweep_spec import SweepSpec

_IMAGE = 3
"""The dimensions of an image."""
_MOST_CHANNELS = 16
"""Of an image: four frames in colour. NetHack's texts are of three dimensions, too, none of which is as small."""
_LONG_EPISODE_S = 60.0
_FEW_NUMBERS = 3_000
"""An image of fewer numbers, as one of 31 x 31 pixels in colour, may well be seen as a vector."""
_INSTEAD_OF_SCALED_REWARDS = {
    "ppo": ", and set hyperparams.normalize_rewards: true, which scales what is learned from, and no score",
    "dqn": ", and set hyperparams.reward_scale, which scales what is learned from, and no score",
}
_INSTEAD_OF_SCALED_OBSERVATIONS = (
    ", and set hyperparams.normalize_observations: true, by which a policy is evaluated and saved, too"
)


def env_notes(spec: SweepSpec, env: EnvInfo, packs: PackPlan | None = None) -> list[str]:
    """Return notes on a sweep's environment, with its wrappers; `packs`, if some are planned, say what was measured."""
    step_us = None if packs is None else packs.env_step_us
    sizes = size_notes(spec, env, packs)
    return [
        *_on_observations(spec, env),
        *sizes,
        *_on_actions(env),
        *_on_episodes(spec, env, step_us),
        *_on_goals(spec, env),
    ]


def _on_observations(spec: SweepSpec, env: EnvInfo) -> Iterator[str]:
    seen = seen_by_networks(env.observation_space)
    if isinstance(seen, WithMembers):
        kind = "images of shape" if env.observes_images else "vectors of shape"
        frame, frames = (seen.frame, seen.num_frames) if isinstance(seen, StackedBox) else (seen, 1)
        at_once = f", {frames} observations in each" if frames > 1 else ""
        yield f"Observations of {env.env_id} are made {kind} {seen.shape}{at_once}: {shortened(frame.original)}."
        if spec.rl_module is None and spec.algorithm not in BASELINES and (note := _note_on_image(spec, env, frame)):
            yield note
        if note := _note_on_choices(frame):
            yield note
    if env.observes_images and spec.rl_module is None and (hint := channels_hint(spec, env)):
        # With filters that do not fit it is an error, which says the same.
        yield f"Convolutions go over the first two dimensions of images. {hint}"


def _on_actions(env: EnvInfo) -> Iterator[str]:
    if is_made(actions := env.action_space):
        kind = f"{counted(len(actions.sizes), 'choice')}" if isinstance(actions, Choices) else "vectors"
        yield f"Actions of {env.env_id} are made of {kind}: {shortened(actions.original)}."
    if env.mask is not None:
        yield (
            f"Only actions that {env.env_id} allows, by {env.mask}, are drawn, learned and taken; networks do not see "
            "the mask."
        )
    elif env.unused_mask is not None:
        yield (
            f"{env.env_id} gives {env.unused_mask.place}, which seems to say which actions are allowed, and which is "
            f"not used: env.action_mask: {env.unused_mask.setting} uses it."
        )


def _on_episodes(spec: SweepSpec, env: EnvInfo, step_us: float | None) -> Iterator[str]:
    yield from _on_repeats(spec, env)
    if step_us is not None and env.max_episode_steps is None:
        longest_s = step_us / 1e6 * MAX_EPISODE_STEPS
        if longest_s >= _LONG_EPISODE_S:
            yield (
                f"{env.env_id} sets no limit to the env steps of an episode, and one takes {step_us / 1000:.1f} ms: an "
                f"episode that does not end by itself is cut off after {MAX_EPISODE_STEPS:,}, which take "
                f"{duration(longest_s)}. Each evaluation plays {counted(spec.evaluation.num_episodes, 'episode')}, the "
                "end of the sweep more; env.args.max_episode_steps sets a limit."
            )
    asked = spec.env.args.get("max_episode_steps")
    if isinstance(asked, int) and env.max_episode_steps is not None and env.max_episode_steps < asked:
        where = (
            "A wrapper around an environment of gymnasium.make has a limit inside, which max_episode_steps=-1 leaves "
            "out there."
            if spec.env.atari is None
            else "The emulator ends a game after max_num_frames_per_episode frames, which env.args may set."
        )
        yield (
            f"env.args.max_episode_steps {asked:,} never acts: {env.env_id} cuts off episodes after "
            f"{env.max_episode_steps:,} env steps by itself. {where}"
        )


def _on_repeats(spec: SweepSpec, env: EnvInfo) -> Iterator[str]:
    """Yield what is to be told of an environment whose episodes depend on those before."""
    carried = env.carried
    if carried.scales_rewards:
        yield (
            f"{env.env_id} has a NormalizeReward around it, which divides rewards by what it has seen since it was "
            "made: one policy gets another score each time, and scores can't be compared. Leave it out"
            f"{_INSTEAD_OF_SCALED_REWARDS.get(spec.algorithm, '')}."
        )
    if carried.scales_observations:
        instead = "" if spec.algorithm in BASELINES else _INSTEAD_OF_SCALED_OBSERVATIONS
        yield (
            f"{env.env_id} has a NormalizeObservation around it, which normalises by what it has seen since it was "
            "made: a policy is evaluated on other observations than it is trained on, and is saved without what they "
            f"were normalised by. Leave it out{instead}."
        )
    told = f"and its first observation differs: {env.unrepeated}" if env.unrepeated is not None else None
    if told is None and carried.step is not None:
        told = f"and given the same action, and its first step differs: {carried.step}"
    if told is not None and not (carried.scales_rewards or carried.scales_observations):
        yield (
            f"{env.env_id} was reset twice with the same seed, {told}. Where an episode depends on more than its seed, "
            "a policy that is evaluated again on the same seeds gets other returns. Let reset() leave nothing of the "
            "episode before, and draw all random numbers from self.np_random."
        )


def _on_goals(spec: SweepSpec, env: EnvInfo) -> Iterator[str]:
    """Yield what is to be told of goals at which trials end before the return that they are judged by."""
    is_judged_by_it = spec.objective.type == "steps_to_threshold" and not spec.scheduler.is_population
    goal, whose = env.threshold, f"{env.env_id}'s threshold"
    if is_judged_by_it and spec.objective.threshold is not None:
        goal, whose = spec.objective.threshold, "objective.threshold"
    for name, target in (
        ("training_return", spec.stop.training_return), ("evaluation_return", spec.stop.evaluation_return)
    ):  # fmt: skip
        if goal is None or target is None or target >= goal:
            continue
        below = f"stop.{name} {target:g} is below {whose} {goal:g}"
        if is_judged_by_it:
            yield (
                f"{below}, and objective.type is steps_to_threshold: a trial that ends there without an evaluation of "
                f"{goal:g} counts as one that never reached it. Raise stop.{name} or leave it out, or set "
                f"objective.threshold to {target:g}."
            )
        elif name == "training_return":
            yield f"{below}: trials may end before they solve it."


def _note_on_image(spec: SweepSpec, env: EnvInfo, vectors: FlatBox) -> str | None:
    """Return a note on the largest image among members that are made one vector; None: none is large, or seen."""
    images = image_members(env.observation_space)
    if images and env.image is not None and _has_convolutions(spec):
        num_beside, shape = env.image.num_beside, env.image.shape
        beside = f"; the dense layers see {counted(num_beside, 'other number')} beside it" if num_beside else ""
        frames = spec.env.frame_stack
        stacked = f" of the last {frames} observations" if frames > 1 else ""
        joined = " as the channels of one image" if env.image.more else ""
        return (
            f"Convolutions see {named_images(images)}{stacked}{joined}, of {shape} (rows, columns, channels){beside}."
        )
    sizes = {keys: math.prod(leaf.shape) for keys, leaf in leaves(vectors.original, ()) if keys and _is_image(leaf)}
    keys = max(sizes, key=lambda each: sizes[each], default=())
    if not keys or sizes[keys] < _FEW_NUMBERS:
        return None
    if env.image is not None and keys in images:
        hint = f"hyperparams.conv_filters, such as {filters_example(spec, env)}, has convolutions see it."
    elif env.mask is None:
        hint = image_alone_hint(env.env_id, keys)
    else:
        return None  # who observes the image alone would lose a mask that is a member beside it
    return (
        f"{sizes[keys]:,} numbers of these vectors are those of an image, {named(keys)}: networks see no pixel beside "
        f"another, and have a weight for every number and unit. {hint}"
    )


def _has_convolutions(spec: SweepSpec) -> bool:
    return bool(spec.hyperparams.get("conv_filters")) or "conv_filters" in spec.space


def _note_on_choices(vectors: FlatBox) -> str | None:
    """Return a note on the member whose choices make the most numbers; None: they are few, or a small part."""
    choices = (gym.spaces.Discrete, gym.spaces.MultiDiscrete)
    sizes = {keys: flatdim(leaf) for keys, leaf in leaves(vectors.original, ()) if isinstance(leaf, choices)}
    keys = max(sizes, key=lambda each: sizes[each], default=None)
    if keys is None or sizes[keys] < max(_FEW_NUMBERS, vectors.shape[0] / 2):
        return None
    return (
        f"{sizes[keys]:,} numbers of these vectors are the choices of {named(keys)}, one for each value that there is: "
        "networks have a weight for every number and unit. An ObservationWrapper of your own may leave them out, or "
        "give values that are amounts as numbers, in a Box."
    )


def _is_image(space: gym.Space[Any]) -> TypeGuard[gym.spaces.Box]:
    is_of_bytes = isinstance(space, gym.spaces.Box) and space.dtype == np.uint8
    shape = space.shape or ()
    return is_of_bytes and len(shape) == _IMAGE and min(shape[0], shape[-1]) <= _MOST_CHANNELS
