"""Check a sweep's other settings against its environment, before anything starts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np

from policies.acting.baselines import BASELINES
from policies.envs.failures import check_failure_penalty
from policies.envs.images import image_members
from policies.envs.make import EnvInfo
from policies.envs.mask_settings import ACTION_MASK
from policies.envs.masks import seen_by_networks
from policies.envs.own_actions import Choices
from policies.envs.space_hints import channels_last_hint, named_images, one_image_hint
from policies.envs.stacked import StackedBox
from policies.envs.wrappers import PIXELS, RESERVED
from policies.errors import EnvError, SpecError
from policies.hyperparams import ConstantHyperparams, Hyperparams
from policies.portable.convolution import output_shape
from policies.portable.file import action_problem
from tune_jobs.spec.sweep_spec import SweepSpec

# The fewest rows and columns, and filters that fit them; the second are those of Young and Tian 2019 for MinAtar.
_EXAMPLES = ((20, "[[16, 8, 4], [32, 4, 2]]"), (3, "[[16, 3, 1]]"), (1, "[[16, 1, 1]]"))
# Those of Mnih et al. 2015.
_EXAMPLES_FOR_ATARI = ((36, "[[32, 8, 4], [64, 4, 2], [64, 3, 1]]"), *_EXAMPLES)
_FEW_CHANNELS = (1, 3, 4)
"""Of grey images, of coloured ones, and of those with transparency or of four frames."""


def check_env_args(spec: SweepSpec) -> None:
    """Refuse wrappers among the constructor's arguments, because they have fields of their own.

    Raises:
        SpecError: There is one.
    """
    for name in (*RESERVED, "failure_penalty"):
        if name in spec.env.args:
            raise SpecError(
                f"env.args.{name} is {spec.env.args[name]!r}, but {name} is not an argument of an env's constructor.",
                f"Write it as env.{name}, beside env.id.",
            )


def check_env_rules(spec: SweepSpec, env: EnvInfo, hyperparams: Sequence[Hyperparams]) -> None:
    """Check a sweep's objective, penalty and networks against its environment.

    Args:
        spec: The sweep.
        env: Its environment, with its wrappers.
        hyperparams: The hyperparameters of every point.

    Raises:
        SpecError: There is a penalty but no failure; convolutions but no images, or images but no convolutions; a free
            deviation but no continuous actions; a constant action that the environment does not have; a module of the
            user's own and a mask of actions; or the objective is about a threshold that nobody knows.
    """
    _check_constant_actions(spec, env, hyperparams)
    if spec.objective.type == "steps_to_threshold" and spec.objective.threshold is None and env.threshold is None:
        raise SpecError(
            f"objective.type is steps_to_threshold, but {env.env_id} has no reward threshold, and objective.threshold "
            "is not set.",
            "Set objective.threshold to the evaluation return that counts as solved.",
        )
    if spec.env.failure_penalty is not None:
        try:
            check_failure_penalty(env.env_id, env.failure, spec.env.failure_penalty)
        except EnvError as error:
            hint = error.hint.replace("failure_penalty", "env.failure_penalty")
            raise SpecError(f"env.{error.message}", hint) from error
    if spec.rl_module is not None and env.mask is not None:
        raise SpecError(
            f"{env.env_id} says which actions are allowed ({env.mask}), but rl_module is {spec.rl_module!r}: only our "
            "own networks keep to a mask.",
            f"Leave rl_module out; or set env.{ACTION_MASK}: false, and read the mask in the module, where the "
            "observations have it.",
        )
    if spec.algorithm not in BASELINES:
        _check_networks(spec, env, hyperparams)
    if not isinstance(env.action_space, gym.spaces.Box):
        _refuse_free_log_std(spec, env, hyperparams)


def _refuse_free_log_std(spec: SweepSpec, env: EnvInfo, hyperparams: Sequence[Any]) -> None:
    domain = spec.space.get("free_log_std")
    searched = [] if domain is None else [value for _, value in domain.probes()]
    if True in [*searched, *(getattr(values, "free_log_std", False) for values in hyperparams)]:
        place = "hyperparams.free_log_std" if domain is None else "space.free_log_std"
        raise SpecError(
            f"{place} is true, but the actions of {env.env_id} are not continuous ({env.action_space}): they have no "
            "standard deviation.",
            f"Leave {place} out.",
        )


def _check_constant_actions(spec: SweepSpec, env: EnvInfo, hyperparams: Sequence[Hyperparams]) -> None:
    """Refuse points of the baseline `constant` whose action the environment does not have."""
    place = "space.action" if "action" in spec.space else "hyperparams.action"
    for values in hyperparams:
        if not isinstance(values, ConstantHyperparams):
            continue
        if problem := action_problem(values.action, cast("Any", env.action_space)):
            hint = f"Set {place} to one of the actions, such as --set {place}={_some_action(env)}."
            if "action" in spec.space:
                hint = f"Let {place} give only actions that there are, such as {_some_action(env)}."
            raise SpecError(f"{place}: {problem} ({env.env_id}: {env.action_space}).", hint)


def _some_action(env: EnvInfo) -> str:
    space: Any = env.action_space
    if hasattr(space, "n"):
        return str(int(space.start))
    if isinstance(space, Choices):
        return json.dumps([0] * len(space.sizes), separators=(",", ":"))
    return json.dumps(np.clip(np.zeros(space.shape), space.low, space.high).ravel().tolist(), separators=(",", ":"))


def _check_networks(spec: SweepSpec, env: EnvInfo, hyperparams: Sequence[Any]) -> None:
    shape = tuple(seen_by_networks(env.observation_space).shape or ())
    domain = spec.space.get("conv_filters")
    place = "hyperparams.conv_filters" if domain is None else "space.conv_filters"
    # A search method may choose the points later, so every value that it can choose is checked.
    searched = [] if domain is None else [value for _, value in domain.probes()]
    for filters in [*searched, *(values.conv_filters for values in hyperparams)]:
        if filters is None:
            if env.observes_images and spec.rl_module is None:
                raise SpecError(
                    f"{env.env_id} has images of shape {shape} as observations, but {place} is null: a network for "
                    "images begins with convolutions.",
                    _with_channels(
                        spec,
                        env,
                        f"Set {place} to [channels, kernel, stride] of each layer, such as "
                        f"{filters_example(spec, env)}.",
                    ),
                )
            continue
        if env.image is None:
            raise SpecError(
                f"{place} is {[list(one) for one in filters]}, but the observations of {env.env_id} are flat, of shape "
                f"{shape}{_several_images(env)}: convolutions are for images.",
                _without_images(env, place),
            )
        try:
            output_shape(env.image.shape, filters)
        except SpecError as error:
            hint = _with_channels(spec, env, error.hint)
            raise SpecError(f"{place} does not fit {env.env_id}: {error.message}", hint) from error


def _several_images(env: EnvInfo) -> str:
    images = image_members(env.observation_space)
    return f", with {len(images)} images among their members, of different sizes" if images else ""


def _without_images(env: EnvInfo, place: str) -> str:
    """Return what to do about convolutions where vectors are observed: several members of them may be images."""
    images = list(image_members(env.observation_space))
    if images:
        seen = env.observation_space
        own = seen.frame.original if isinstance(seen, StackedBox) else getattr(seen, "original", seen)
        hint = "Those of one height and width are seen together, as the channels of one."
        if own is not None:  # else frames are stacked below a mask, which a wrapper could lose
            hint += f" {one_image_hint(env.env_id, own, images)}"
        return f"Leave {place} out, or observe only one of {named_images(images)}. {hint}"
    return f"Leave {place} out, or observe images with env.{PIXELS}: true."


def filters_example(spec: SweepSpec, env: EnvInfo) -> str:
    """Return `conv_filters` that fit the images that an environment has, if their channels come last."""
    assert env.image is not None
    shape = env.image.shape
    smallest = min(shape[1:] if _has_channels_first(shape) else shape[:2])
    examples = _EXAMPLES if spec.env.atari is None else _EXAMPLES_FOR_ATARI
    return next(example for fewest, example in examples if smallest >= fewest)


def channels_hint(spec: SweepSpec, env: EnvInfo) -> str:
    """Return what to do about images whose channels seem to come first; empty: they don't."""
    shape = seen_by_networks(env.observation_space).shape or ()
    if not _has_channels_first(shape):
        return ""
    # Frames are stacked along the last dimension.
    own_shape = (*shape[:2], shape[2] // spec.env.frame_stack)
    return (
        f"Channels come last here, (rows, columns, channels), but {own_shape} looks as if they came first. "
        f"{channels_last_hint(env.env_id, seen_by_networks(env.observation_space), own_shape)}"
    )


def _with_channels(spec: SweepSpec, env: EnvInfo, hint: str) -> str:
    return " ".join(filter(None, (channels_hint(spec, env), hint)))


def _has_channels_first(shape: Sequence[int]) -> bool:
    return shape[0] in _FEW_CHANNELS and shape[0] < min(shape[1:])
