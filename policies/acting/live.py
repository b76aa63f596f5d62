"""Play an episode for somebody who watches: each step with its picture, its action, and the policy's scores."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from PIL import Image

from policies.acting.evaluate import Resettable, check_policy, check_seeds, episode_cap, episode_steps
from policies.acting.policy import Action, NetworkPolicy, Policy
from policies.envs.faults import close_env
from policies.envs.make import make_env
from policies.envs.rendering import draw_without_display
from policies.errors import EnvError

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
class LiveInfo:
    """What is to be known before the first step."""

    env_id: str
    description: str
    fps: float
    """Frames a second of the environment's own time."""
    is_drawn: bool
    why_not: str
    """Why the environment is not drawn."""


def watch_episode(
    policy: Policy, env_id: str, env_args: Mapping[str, Any] | None, seed: int
) -> tuple[LiveInfo, Iterator[LiveStep]]:
    """Begin an episode; what is returned plays it step by step.

    Args:
        policy: The policy that acts.
        env_id: Gymnasium id.
        env_args: Arguments of the env's constructor; None: none.
        seed: The seed that the env is reset with.

    Raises:
        EnvError: The environment cannot be made, or does not go with the policy.
        NonFiniteWeightsError: The policy's weights are NaN or infinite.
    """
    (seed,) = check_seeds([seed])
    env, why_not = _drawable(env_id, env_args)
    try:
        check_policy(policy, env)
    except BaseException:
        close_env(env)
        raise
    fps = float(env.metadata.get("render_fps") or 30.0)
    info = LiveInfo(env_id, policy.description, fps, not why_not, why_not)
    return info, _steps(policy, env, seed, draws=not why_not)


def _drawable(env_id: str, env_args: Mapping[str, Any] | None) -> tuple[gym.Env[Any, Any], str]:
    """Return an env that can be drawn, or one that can't and why."""
    draw_without_display()
    try:
        env = make_env(env_id, env_args, render_mode="rgb_array")
    except EnvError as error:
        # The same error comes again if it is not about drawing.
        return make_env(env_id, env_args), error.message
    modes = env.metadata.get("render_modes") or ()
    if "rgb_array" not in modes:
        return env, f"{env_id} can't be drawn: its render modes are {', '.join(map(str, modes)) or 'none'}."
    return env, ""


class _Seen(Policy):
    """Acts as another policy does, and keeps what it saw and did last."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(
            policy.observation_space, policy.action_space,
            env_id=policy.env_id, env_args=policy.env_args, description=policy.description,
        )  # fmt: skip
        self._policy = policy
        self.observation: Any = None
        self.action: Action | None = None

    def reset(self, seed: int) -> None:
        """Seed a policy that draws its actions."""
        if isinstance(self._policy, Resettable):
            self._policy.reset(seed)

    def act(self, observations: Any) -> Action:
        self.observation = observations
        self.action = self._policy.act(observations)
        return self.action

    def _act_batch(self, observations: Any) -> Any:
        raise NotImplementedError("one observation at a time is watched")


def _steps(policy: Policy, env: gym.Env[Any, Any], seed: int, *, draws: bool) -> Iterator[LiveStep]:
    seen = _Seen(policy)
    try:
        for steps, total, over in episode_steps(seen, env, seed, max_episode_steps=episode_cap(env, None)):
            scores, kind = _scores(policy, seen.observation)
            yield LiveStep(
                steps, float(total), over, _picture(env) if draws else None, _vector(seen.observation),
                _plain(seen.action), scores, kind,
            )  # fmt: skip
    finally:
        close_env(env)


def _picture(env: gym.Env[Any, Any]) -> str | None:
    frame = np.asarray(env.render())
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        return None
    picture = Image.fromarray(frame)
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
    output = policy.outputs(np.asarray(observation, dtype=np.float32)[None])[0].astype(np.float64)
    if output.size > 2 * MAX_SHOWN:
        return None, None
    network = policy.portable.network
    if network.kind == "categorical":
        powers = np.exp(output - output.max())
        return _numbers(powers / powers.sum()), "probabilities"
    if network.kind == "gaussian":
        return _numbers(np.exp(output[output.size // 2 :])), "gaussian"
    return _numbers(output), "advantages" if _is_dueling(policy) else "values"


def _is_dueling(policy: NetworkPolicy) -> bool:
    return bool(dict(policy.portable.training.get("hyperparams") or {}).get("dueling"))
