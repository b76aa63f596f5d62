"""The physics of Gymnasium's classic control for many copies at once: MountainCar, Pendulum and Acrobot.

Steps are those of Gymnasium's own environments to the last bit, at a tenth of their time and less. So each expression
stands here as it does there, with the same types and in the same order; a power is the C library's, as NumPy's of one
number is, where NumPy's of an array is a product. CartPole is in `policies.packed.envs.cartpole_rows`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.acrobot import AcrobotEnv
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.envs.classic_control.continuous_mountain_car import Continuous_MountainCarEnv
from gymnasium.envs.classic_control.mountain_car import MountainCarEnv
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from numpy.typing import NDArray
from typing_extensions import override

Numbers = NDArray[Any]


class Stepped(NamedTuple):
    """What a step of all copies gives."""

    states: NDArray[np.float64]
    """Shape (size of a state, num)."""
    observations: NDArray[np.float32]
    """Shape (num, n)."""
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]


class Physics(Protocol):
    """The physics of one environment, which knows its numbers (gravity, limits) and no state."""

    def state(self) -> list[float]:
        """Return the state of the environment that was asked, right after a reset, as a column of states."""

    def step(self, states: NDArray[np.float64], actions: Numbers) -> Stepped:
        """Step each copy; no state is changed in place.

        Args:
            states: Shape (size of a state, num).
            actions: As the environment takes them, shape (num,) or (num, action_dim) and within the bounds.
        """


def physics_of(env: gym.Env[Any, Any]) -> Physics | None:
    """Return the physics of an environment without its wrappers, or None if it is not one of these.

    Args:
        env: Gives the numbers, and with each reset the states that `Physics.state` returns.
    """
    # Exactly these classes: one that was derived may do anything else.
    make = _PHYSICS.get(type(env))
    return None if make is None else make(env)


class _OfEnv:
    """What the physics of all of them have in common: the environment, and its state as it is."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env: Any = env

    def state(self) -> list[float]:
        return [float(number) for number in self._env.state]


class _MountainCar(_OfEnv):
    """Position and velocity."""

    def step(self, states: NDArray[np.float64], actions: Numbers) -> Stepped:
        env = self._env
        position, velocity = states
        velocity = velocity + ((actions - 1) * env.force + _cos(3 * position) * (-env.gravity))
        velocity = np.clip(velocity, -env.max_speed, env.max_speed)
        position = np.clip(position + velocity, env.min_position, env.max_position)
        velocity = np.where((position == env.min_position) & (velocity < 0), 0.0, velocity)
        terminated = (position >= env.goal_position) & (velocity >= env.goal_velocity)
        after = np.stack([position, velocity])
        return Stepped(after, after.T.astype(np.float32), np.full(len(position), -1.0), terminated)


class _ContinuousMountainCar(_OfEnv):
    """Position, velocity, and 1 after a reset: the first step is of double precision, the others of single."""

    @override
    def state(self) -> list[float]:
        return [*super().state(), 1.0]

    def step(self, states: NDArray[np.float64], actions: Numbers) -> Stepped:
        force = actions[:, 0]
        after, terminated = self._moved(states[:2].astype(np.float32), force)
        if (first := states[2] != 0).any():
            moved, ended = self._moved(states[:2, first], force[first])
            after[:, first], terminated[first] = moved, ended
        wide = force.astype(np.float64)
        rewards = np.where(terminated, 100.0, 0.0) - wide * wide * 0.1
        kept = np.zeros_like(states)
        kept[:2] = after
        return Stepped(kept, np.ascontiguousarray(after.T), rewards, terminated)

    def _moved(self, states: Numbers, force: Numbers) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        env = self._env
        position, velocity = states
        pull = np.array([0.0025 * cosine for cosine in _cosines(3 * position)])
        change = (force * env.power - pull.astype(force.dtype)).astype(velocity.dtype)
        if (beyond := (force < env.min_action) | (force > env.max_action)).any():
            # Its bounds are Python's numbers, of double precision, other than an action.
            bounds = np.where(force > 0, float(env.max_action), float(env.min_action))
            change[beyond] = (bounds * env.power - pull)[beyond]
        velocity = velocity + change
        velocity = np.clip(velocity, -env.max_speed, env.max_speed)
        position = np.clip(position + velocity, env.min_position, env.max_position)
        velocity = np.where((position == env.min_position) & (velocity < 0), 0, velocity)
        terminated = (position >= env.goal_position) & (velocity >= env.goal_velocity)
        return np.stack([position, velocity]).astype(np.float32), terminated


class _Pendulum(_OfEnv):
    """Angle and angular velocity."""

    def step(self, states: NDArray[np.float64], actions: Numbers) -> Stepped:
        env = self._env
        angle, velocity = states
        torque = np.clip(actions[:, 0], -env.max_torque, env.max_torque)
        normalized = ((angle + np.pi) % (2 * np.pi)) - np.pi
        # One number after the other: the C library's powers of single precision are no products either.
        squares = np.array([number**2 for number in torque])
        costs = _square(normalized) + 0.1 * _square(velocity) + 0.001 * squares
        velocity = velocity + (
            3 * env.g / (2 * env.l) * np.sin(angle) + 3.0 / (env.m * env.l**2) * torque
        ) * env.dt  # fmt: skip
        velocity = np.clip(velocity, -env.max_speed, env.max_speed)
        angle = angle + velocity * env.dt
        observations = np.stack([np.cos(angle), np.sin(angle), velocity], axis=1).astype(np.float32)
        return Stepped(np.stack([angle, velocity]), observations, -costs, np.zeros(len(angle), dtype=np.bool_))


class _Acrobot(_OfEnv):
    """Two angles and their velocities; the equations are the book's (Sutton and Barto 2018), by Runge-Kutta."""

    def step(self, states: NDArray[np.float64], actions: Numbers) -> Stepped:
        env = self._env
        torque = np.array(env.AVAIL_TORQUE)[actions]
        dt = env.dt - 0
        dt2 = dt / 2.0
        k1 = self._slope(states, torque)
        k2 = self._slope(states + dt2 * k1, torque)
        k3 = self._slope(states + dt2 * k2, torque)
        k4 = self._slope(states + dt * k3, torque)
        after = states + dt / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
        after[:2] = _wrapped(after[:2])
        after[2] = np.clip(after[2], -env.MAX_VEL_1, env.MAX_VEL_1)
        after[3] = np.clip(after[3], -env.MAX_VEL_2, env.MAX_VEL_2)
        one, two = after[:2]
        cos_one = np.cos(one)
        terminated = -cos_one - np.cos(two + one) > 1.0
        observations = np.stack([cos_one, np.sin(one), np.cos(two), np.sin(two), *after[2:]], axis=1)
        return Stepped(after, observations.astype(np.float32), np.where(terminated, 0.0, -1.0), terminated)

    def _slope(self, states: NDArray[np.float64], torque: NDArray[np.float64]) -> NDArray[np.float64]:
        env = self._env
        m1, m2, l1 = env.LINK_MASS_1, env.LINK_MASS_2, env.LINK_LENGTH_1
        lc1, lc2, i1, i2, g = env.LINK_COM_POS_1, env.LINK_COM_POS_2, env.LINK_MOI, env.LINK_MOI, 9.8
        theta1, theta2, dtheta1, dtheta2 = states
        cos2, sin2 = np.cos(theta2), np.sin(theta2)
        d1 = m1 * lc1**2 + m2 * (l1**2 + lc2**2 + 2 * l1 * lc2 * cos2) + i1 + i2
        d2 = m2 * (lc2**2 + l1 * lc2 * cos2) + i2
        phi2 = m2 * lc2 * g * np.cos(theta1 + theta2 - math.pi / 2.0)
        phi1 = (
            -m2 * l1 * lc2 * _square(dtheta2) * sin2
            - 2 * m2 * l1 * lc2 * dtheta2 * dtheta1 * sin2
            + (m1 * lc1 + m2 * l1) * g * np.cos(theta1 - math.pi / 2)
            + phi2
        )
        ddtheta2 = (torque + d2 / d1 * phi1 - m2 * l1 * lc2 * _square(dtheta1) * sin2 - phi2) / (
            m2 * lc2**2 + i2 - _square(d2) / d1
        )
        ddtheta1 = -(d2 * ddtheta2 + phi1) / d1
        return np.stack([dtheta1, dtheta2, ddtheta1, ddtheta2])


def _acrobot(env: AcrobotEnv) -> _Acrobot | None:
    # These can't be set by arguments, but by whoever changes the class.
    is_plain = env.book_or_nips == "book" and not env.torque_noise_max > 0
    return _Acrobot(env) if is_plain else None


_PHYSICS: dict[type, Callable[[Any], Physics | None]] = {
    MountainCarEnv: _MountainCar,
    Continuous_MountainCarEnv: _ContinuousMountainCar,
    PendulumEnv: _Pendulum,
    AcrobotEnv: _acrobot,
}


def is_classic(env: gym.Env[Any, Any]) -> bool:
    """Whether an environment, in whatever wrappers, is one that may have rows: of classic control, CartPole too."""
    return type(env.unwrapped) in {*_PHYSICS, CartPoleEnv}


def _cosines(angles: Numbers) -> list[float]:
    return list(map(math.cos, angles.tolist()))


def _cos(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array(_cosines(angles))


def _square(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    # Not `numbers**2`, which is a product: `float_power` asks the C library, as the power of a single number does.
    return np.float_power(numbers, 2)


def _wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles between -pi and pi, by as many turns as they are away."""
    turn = math.pi - -math.pi
    while (over := angles > math.pi).any():
        angles = np.where(over, angles - turn, angles)
    while (under := angles < -math.pi).any():
        angles = np.where(under, angles + turn, angles)
    return angles
