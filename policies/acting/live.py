"""Play an episode for somebody who watches: each step with its picture, its action, and the policy's scores."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

import gymnasium as gym
import numpy as np
from PIL import Image

from policies.acting.evaluate import EndedBy, check_policy, check_seeds, episode_cap, episode_steps
from policies.acting.movies import enlarged
from policies.acting.policy import Action, NetworkPolicy, Policy
from policies.envs.action_names import action_names
from policies.envs.faults import close_env
from policies.envs.make import make_env
from policies.envs.masks import FORBIDDEN
from policies.envs.own_actions import Choices
from policies.envs.rendering import draw_without_display, drawing_hint, frames_per_second, picture_of
from policies.errors import EnvError, said_by

ScoreKind = Literal["probabilities", "values", "advantages", "gaussian"]

MAX_SHOWN = 64
"""The most numbers of an observation, and the most actions' scores, that a step tells."""
_MAX_PIXELS = 640
_JPEG_QUALITY = 80


@dataclass(frozen=True)
class LiveStep:
    """One moment of an episode: after the reset, or after a step."""

    num_env_steps: int
    total: float
    """The return so far."""
    over: bool
    ended_by: EndedBy | None
    """How the episode ended; None: it goes on."""
    picture: str | None
    """A JPEG as base64; None: the environment can't be drawn."""
    observation: list[float | None] | None
    """What the policy saw before its action, of a vector; None after the reset, and of images."""
    action: int | list[float | None] | None
    """What it did; None after the reset."""
    scores: list[float | None] | None
    """By action: probabilities, Q values, or a dueling network's advantages; of a Gaussian policy the standard
    deviations of the action's components, as the network has them. None: the policy has none."""
    score_kind: ScoreKind | None


@dataclass(frozen=True)
class LiveActions:
    """What actions there are."""

    first: int | None
    """The number of the first one; None: actions are vectors."""
    names: tuple[str, ...] | None
    """Their names in their order; None: they have none."""
    low: list[float | None] | None
    high: list[float | None] | None
    """Bounds of each component of a vector, None where it has none; None: actions are numbers."""


@dataclass(frozen=True)
class LiveInfo:
    """What is to be known before the first step."""

    env_id: str
    description: str
    fps: float
    """Frames a second of the environment's own time."""
    is_drawn: bool
    why_not: str
    """Why the environment is not drawn."""
    actions: LiveActions


def watch_episode(
    policy: Policy, env_id: str, env_args: Mapping[str, Any] | None, seed: int, *, start: int = 0
) -> tuple[LiveInfo, Iterator[LiveStep]]:
    """Begin an episode; what is returned plays it step by step, and closes the env at the end or when it is dropped.

    Args:
        policy: The policy that acts.
        env_id: Gymnasium id.
        env_args: Arguments of the env's constructor; None: none.
        seed: The seed that the env is reset with.
        start: The first step that is watched: those before it come without pictures and scores.

    Raises:
        EnvError: The environment cannot be made, or does not go with the policy.
        NonFiniteWeightsError: The policy's weights are NaN or infinite.
    """
    (seed,) = check_seeds([seed])
    env, why_not = _drawable(env_id, env_args)
    try:
        check_policy(policy, env)
        fps = frames_per_second(env.metadata)
        info = LiveInfo(env_id, policy.description, fps, not why_not, why_not, _actions(env))
    except BaseException:
        close_env(env)
        raise
    steps = _steps(policy, env, seed, draws=not why_not, start=start)
    # Only a generator that has begun closes the environment when it is closed or dropped.
    next(steps)
    return info, cast("Iterator[LiveStep]", steps)


def _drawable(env_id: str, env_args: Mapping[str, Any] | None) -> tuple[gym.Env[Any, Any], str]:
    """Return an env that can be drawn, or one that can't and why."""
    draw_without_display()
    why_not = ""
    try:
        env = make_env(env_id, env_args, render_mode="rgb_array")
    except EnvError as error:
        # The same error comes again if it is not about drawing.
        env, why_not = make_env(env_id, env_args), error.message
    modes = env.metadata.get("render_modes") or ()
    if "rgb_array" not in modes:
        return env, f"{env_id} can't be drawn: its render modes are {', '.join(map(str, modes)) or 'none'}."
    return env, why_not


def _actions(env: gym.Env[Any, Any]) -> LiveActions:
    space = env.action_space
    if isinstance(space, gym.spaces.Discrete):
        return LiveActions(int(space.start), action_names(env), None, None)
    if isinstance(space, Choices):
        return LiveActions(None, None, _numbers(np.zeros(len(space.sizes))), _numbers(space.nvec - 1))
    box = cast("gym.spaces.Box", space)
    return LiveActions(None, None, _numbers(box.low), _numbers(box.high))


def _steps(policy: Policy, env: gym.Env[Any, Any], seed: int, *, draws: bool, start: int) -> Iterator[LiveStep | None]:
    """Yield None, before anything is done, and then the steps."""
    try:
        yield None
        for moment in episode_steps(policy, env, seed, max_episode_steps=episode_cap(env, None)):
            is_watched = moment.over or moment.num_env_steps >= start
            scores, kind = _scores(policy, moment.observation) if is_watched else (None, None)
            yield LiveStep(
                moment.num_env_steps, float(moment.total), moment.over, moment.ended_by,
                _picture(env) if draws and is_watched else None,
                _vector(moment.observation), _plain(moment.action), scores, kind,
            )  # fmt: skip
    finally:
        close_env(env)


def _picture(env: gym.Env[Any, Any]) -> str | None:
    try:
        frame = picture_of(env.render())
    except Exception as error:  # an env may raise anything
        env_id = env.spec.id if env.spec is not None else "The env"
        raise EnvError(
            f"{env_id} cannot be drawn: {type(error).__name__}: {said_by(error)}.", drawing_hint(error)
        ) from error
    if frame is None:
        return None
    picture = Image.fromarray(frame)
    # By its longer side: a narrow one would take any amount of memory.
    picture = enlarged(picture, max(picture.size))
    picture.thumbnail((_MAX_PIXELS, _MAX_PIXELS))
    file = io.BytesIO()
    picture.save(file, "JPEG", quality=_JPEG_QUALITY)
    return base64.b64encode(file.getvalue()).decode()


def _numbers(values: Any) -> list[float | None]:
    """Return numbers as a list; those that JSON has no word for are None."""
    return [float(value) if np.isfinite(value) else None for value in np.asarray(values).reshape(-1)]


def _vector(observation: Any) -> list[float | None] | None:
    values = None if observation is None else np.asarray(observation, dtype=np.float64)
    if values is None or values.ndim > 1 or values.size > MAX_SHOWN:
        return None
    return _numbers(values)


def _plain(action: Action | None) -> int | list[float | None] | None:
    if action is None or isinstance(action, int):
        return action
    return _numbers(action)


def _scores(policy: Policy, observation: Any) -> tuple[list[float | None] | None, ScoreKind | None]:
    if observation is None or not isinstance(policy, NetworkPolicy):
        return None, None
    if isinstance(policy.action_space, Choices):
        # Which of the probabilities are of which choice is more than a row of numbers tells.
        return None, None
    output = policy.outputs(np.asarray(observation, dtype=np.float32)[None])[0].astype(np.float64)
    if output.size > 2 * MAX_SHOWN:
        return None, None
    output[output <= FORBIDDEN] = -np.inf
    network = policy.portable.network
    if network.kind == "categorical":
        powers = np.exp(output - output.max())
        return _numbers(powers / powers.sum()), "probabilities"
    if network.kind == "gaussian":
        return _numbers(np.exp(output[output.size // 2 :])), "gaussian"
    return _numbers(output), "advantages" if _is_dueling(policy) else "values"


def _is_dueling(policy: NetworkPolicy) -> bool:
    return bool(dict(policy.portable.training.get("hyperparams") or {}).get("dueling"))
