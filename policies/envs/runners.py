"""Step Gymnasium's running robots (MuJoCo's Hopper, HalfCheetah, Walker2d and Swimmer) for many copies at once.

MuJoCo's own steps are made one copy after another, as they have to be. What Gymnasium computes around each, an
observation, a reward and whether the robot has fallen, is computed for all of them together, each expression as it
stands there: the results are those of Gymnasium's environments to the last bit. It took up to a third of the time.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs.copies import CopiesStep
from policies.envs.faults import close_env
from policies.envs.make import make_env
from policies.envs.plain import is_plain

_MODULE = "gymnasium.envs.mujoco."
_COMPARED_STEPS = 60


class Copy:
    """One environment as it is stepped here; its resets are its own.

    Args:
        env: The environment, with its time limit.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        inner: Any = env.unwrapped
        self.model, self.data = inner.model, inner.data
        # Views of the simulation's memory, each of which takes longer to make than to read.
        self.ctrl, self.qpos, self.qvel = inner.data.ctrl, inner.data.qpos, inner.data.qvel


Args = Mapping[str, Any]
_IsHealthy = Callable[[Args, NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]]
"""Returns which robots have not fallen, by the env's arguments and qpos and qvel of shape (num, nq) and (num, nv)."""


def _hopper_is_healthy(args: Args, qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> NDArray[np.bool_]:
    low, high = args["_healthy_state_range"]
    state = np.concatenate([qpos[:, 2:], qvel], axis=1)
    within: NDArray[np.bool_] = np.logical_and(low < state, state < high).all(axis=1)
    return within & _walker_is_healthy(args, qpos, qvel)


def _walker_is_healthy(args: Args, qpos: NDArray[np.float64], _: NDArray[np.float64]) -> NDArray[np.bool_]:
    min_z, max_z = args["_healthy_z_range"]
    min_angle, max_angle = args["_healthy_angle_range"]
    z, angle = qpos[:, 1], qpos[:, 2]
    healthy: NDArray[np.bool_] = (min_z < z) & (z < max_z) & (min_angle < angle) & (angle < max_angle)
    return healthy


_RUNNERS: dict[str, _IsHealthy | None] = {
    "hopper_v5.HopperEnv": _hopper_is_healthy,
    "walker2d_v5.Walker2dEnv": _walker_is_healthy,
    "half_cheetah_v5.HalfCheetahEnv": None,
    "swimmer_v5.SwimmerEnv": None,
}
"""Gymnasium's classes, and what says that a robot has not fallen; None: it can't."""
_ENTRY_POINTS = {f"{_MODULE}{name.replace('.', ':')}" for name in _RUNNERS}


class Runners:
    """Steps copies of one environment, all of which have its arguments; see `policies.envs.copies.Stepper`.

    Args:
        env: One of them, which tells its numbers; it is not stepped.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        inner: Any = env.unwrapped
        self._inner = inner
        # Its arguments, which Gymnasium keeps in fields of these names with an underscore.
        self._args = vars(inner)
        self._mj_step: Callable[[Any, Any, int], None] = importlib.import_module("mujoco").mj_step
        self._is_healthy = _RUNNERS[_class_of(inner)]
        self._skipped = inner.observation_structure["skipped_qpos"]
        self.limit = None if env.spec is None else env.spec.max_episode_steps

    @classmethod
    def of(cls, env_id: str, env_args: Mapping[str, Any] | None) -> Runners | None:
        """Return what steps an environment's copies, or None if it is none of these robots, or steps in another way.

        No other environment is made. What a robot's raises is left to those who make it next.
        """
        spec = gym.registry.get(env_id)
        if spec is None or spec.entry_point not in _ENTRY_POINTS:
            return None
        made: list[gym.Env[Any, Any]] = []
        found = None
        try:
            made.append(make_env(env_id, env_args))
            made.append(make_env(env_id, env_args))
            if is_runner(made[0]) and _step_alike(cls(made[0]), *made):
                found = cls(made[0])
        except Exception:  # noqa: BLE001 (an env may raise anything)
            found = None
        for env in made if found is None else made[1:]:
            close_env(env)
        return found

    def copy_of(self, env: gym.Env[Any, Any]) -> Copy:
        """Return what `step` takes for an environment of its own, over all its episodes."""
        return Copy(env)

    def step(self, copies: Sequence[Copy], actions: NDArray[np.float32]) -> CopiesStep:
        """Step copies, of which there is at least one; they never reset by themselves.

        Args:
            copies: The copies.
            actions: One for each, (num, action_dim), within the bounds.
        """
        inner, args, mj_step, frame_skip = self._inner, self._args, self._mj_step, self._inner.frame_skip
        qpos = np.empty((len(copies), inner.model.nq))
        qvel = np.empty((len(copies), inner.model.nv))
        before = np.empty(len(copies))
        failures: dict[int, Exception] = {}
        for number, copy in enumerate(copies):
            before[number] = copy.qpos[0]
            copy.ctrl[:] = actions[number]
            try:
                mj_step(copy.model, copy.data, frame_skip)
            except Exception as error:  # noqa: BLE001 (of the member whose env it is)
                failures[number] = error
            qpos[number], qvel[number] = copy.qpos, copy.qvel
        velocity = (qpos[:, 0] - before) / inner.dt
        forward = args["_forward_reward_weight"] * velocity
        cost = args["_ctrl_cost_weight"] * np.square(actions).sum(axis=1)
        if self._is_healthy is None:
            rewards, terminated = forward - cost, np.zeros(len(copies), dtype=np.bool_)
        else:
            healthy = self._is_healthy(args, qpos, qvel)
            rewards = forward + healthy * args["_healthy_reward"] - cost
            terminated = ~healthy & bool(args["_terminate_when_unhealthy"])
            np.clip(qvel, -10, 10, out=qvel)
        return CopiesStep(np.concatenate([qpos[:, self._skipped :], qvel], axis=1), rewards, terminated, failures)

    def close(self) -> None:
        """Close the environment that tells its numbers."""
        close_env(self._inner)


def is_runner(env: gym.Env[Any, Any]) -> bool:
    """Whether an environment is one of these robots, with nothing but its time limit around it."""
    return _class_of(env.unwrapped) in _RUNNERS and is_plain(env) and env.unwrapped.render_mode != "human"


def _class_of(inner: gym.Env[Any, Any]) -> str:
    # Exactly these classes: one that was derived may do anything else. By name, as MuJoCo need not be installed.
    kind = type(inner)
    return f"{kind.__module__.removeprefix(_MODULE)}.{kind.__qualname__}" if kind.__module__.startswith(_MODULE) else ""


def _step_alike(runners: Runners, env: gym.Env[Any, Any], other: gym.Env[Any, Any]) -> bool:
    """Whether copies take the environment's own steps: compared from one start, through falls, with fixed actions."""
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    copies = [Copy(env)]
    env.reset(seed=0)
    other.reset(seed=0)
    for number in range(_COMPARED_STEPS):
        share = np.float32(0.5 + 0.5 * np.cos(number + np.arange(space.shape[0])))
        action = (space.low + share * (space.high - space.low)).astype(np.float32)
        observation, reward, terminated, _, _ = other.unwrapped.step(action)
        stepped = runners.step(copies, action[None])
        same = np.array_equal(stepped.observations[0], observation) and stepped.rewards[0] == reward
        if not same or stepped.terminated[0] != terminated or stepped.failures:
            return False
        if terminated:
            env.reset(seed=number)
            other.reset(seed=number)
    return True
