"""Cart-poles as rows of arrays, whose number changes.

Their steps are those of Gymnasium's own vectorised version to the last bit, at half of its time: of a few rows each
call of NumPy is a part, and that version makes more of them than the physics needs. What is stepped is compared with
it where rows are made; if another version of Gymnasium steps in another way, that version itself is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv, CartPoleVectorEnv
from numpy.typing import NDArray

from policies.envs.make import make_env, make_vector_env
from policies.packed.envs.rows import Rows

_Flags = NDArray[np.bool_]
_States = NDArray[np.float64]
_COMPARED_STEPS = 60
"""Where the force keeps its direction the pole falls within 11 of them, so that ends are compared, too."""
_COMPARED_LIMIT = 25
"""The time limit meanwhile, which the pole that is pushed to and fro comes to."""


class Constants(NamedTuple):
    """The constants of a cart-pole, by the names that they have in Gymnasium."""

    gravity: float
    masspole: float
    total_mass: float
    length: float
    polemass_length: float
    force_mag: float
    tau: float
    kinematics_integrator: str
    x_threshold: float
    theta_threshold_radians: float
    sutton_barto_reward: bool

    @classmethod
    def of(cls, env: CartPoleVectorEnv) -> Constants:
        """Return those of an environment.

        Raises:
            AttributeError: It has not all of them.
        """
        known = [getattr(env, name) for name in cls._fields[:-1]]
        return cls._make([*known, env._sutton_barto_reward])  # noqa: SLF001 (it is nowhere else)


class CartPolePhysics:
    """The physics of any number of cart-poles, which knows its constants and no state."""

    def __init__(self, constants: Constants) -> None:
        # As arrays without dimensions: a Python number becomes one in each call.
        self._gravity, self._masspole, self._total_mass = map(np.array, constants[:3])
        self._length, self._polemass_length, _, self._tau = map(np.array, constants[3:7])
        self._forces = np.sign(np.array([0, 1]) - 0.5) * constants.force_mag
        self._limits = np.array([[constants.x_threshold], [constants.theta_threshold_radians]])
        self._four_thirds = np.array(4.0 / 3.0)
        self._is_sutton_barto = constants.sutton_barto_reward

    def rewards(self, terminated: _Flags) -> NDArray[np.float32]:
        """Return the rewards of steps: 1, or with Sutton's and Barto's -1 for a fall and else nothing."""
        if self._is_sutton_barto:
            return np.negative(terminated, dtype=np.float32)
        return np.ones(len(terminated), dtype=np.float32)

    def step(self, states: _States, actions: NDArray[Any]) -> tuple[_States, _Flags]:
        """Step each cart-pole, by Euler's method; no state is changed in place.

        Args:
            states: Positions, velocities, angles and angular velocities, shape (4, num).
            actions: 0 or 1, shape (num,).

        Returns:
            The states after it, and whether the position or the angle is beyond its limits, shape (num,).
        """
        # Gymnasium's expressions, with its types and in its order; only products and sums of two are turned round.
        cosine, sine = np.cos(states[2]), np.sin(states[2])
        pushed = np.square(states[3])
        np.multiply(pushed, self._polemass_length, pushed)
        np.multiply(pushed, sine, pushed)
        np.add(pushed, self._forces[actions], pushed)
        np.divide(pushed, self._total_mass, pushed)
        after = np.empty_like(states)
        np.multiply(sine, self._gravity, sine)
        np.subtract(sine, cosine * pushed, sine)
        inertia = np.square(cosine)
        np.multiply(inertia, self._masspole, inertia)
        np.divide(inertia, self._total_mass, inertia)
        np.subtract(self._four_thirds, inertia, inertia)
        np.multiply(inertia, self._length, inertia)
        turned = np.divide(sine, inertia, after[3])
        drawn = np.multiply(turned, self._polemass_length, inertia)
        np.multiply(drawn, cosine, drawn)
        np.divide(drawn, self._total_mass, drawn)
        np.subtract(pushed, drawn, after[1])
        # By how much each number changes in a second becomes what it is afterwards.
        after[::2] = states[1::2]
        np.multiply(after, self._tau, after)
        np.add(after, states, after)
        beyond = np.abs(after[::2]) > self._limits
        return after, np.logical_or(beyond[0], beyond[1])


class CartPoleRows:
    """Cart-poles whose number changes; they never reset by themselves.

    Args:
        env: Gives the time limit, and the physics if there is none; it belongs to this object from here on.
        physics: Takes the steps; None: the environment does.
    """

    def __init__(self, env: CartPoleVectorEnv, physics: CartPolePhysics | None) -> None:
        self._env: Any = env
        # The env's step checks that the actions are 0 or 1, for the number of sub-environments it was made with. Here
        # that number changes, and the actions are a network's choices, which are always 0 or 1.
        env.action_space = _AnyActions()
        self._physics = physics
        self.put(np.zeros((0, 4)), np.zeros(0, dtype=np.int32))

    @classmethod
    def make(cls, env_id: str, env_args: Mapping[str, Any] | None) -> CartPoleRows | None:
        """Return cart-poles, or None if the env is not CartPole or has wrappers that its vectorised version lacks.

        Raises:
            EnvError: In the same cases as `policies.envs.make.make_env`.
        """
        scalar = make_env(env_id, env_args)
        scalar.close()  # type: ignore[no-untyped-call]
        if type(scalar.unwrapped) is not CartPoleEnv:
            return None
        env = make_vector_env(env_id, env_args, 1)
        # With wrappers it is another class.
        return cls(env, own_physics(env)) if type(env) is CartPoleVectorEnv else None

    @property
    def observation_space(self) -> gym.Space[Any]:
        """The observation space of one cart-pole."""
        return self._env.single_observation_space  # type: ignore[no-any-return]

    @property
    def states(self) -> _States:
        """The position, velocity, angle and angular velocity of each cart-pole, shape (num, 4)."""
        return self._states.T

    @property
    def lengths(self) -> NDArray[np.int32]:
        """The number of steps of each running episode, shape (num,)."""
        return self._lengths

    def put(self, states: _States, lengths: NDArray[Any]) -> None:
        """Replace the cart-poles by others, in any number.

        Args:
            states: Their states, shape (num, 4).
            lengths: The steps of their running episodes, shape (num,).
        """
        self._states = np.array(states.T, dtype=np.float64, order="C")
        self._lengths = np.array(lengths, dtype=np.int32)

    def draw_starts(self, generator: np.random.Generator, *shape: int) -> _States:
        """Draw start states, shape (*shape, 4)."""
        return generator.uniform(self._env.low, self._env.high, (*shape, 4))

    def restart(self, rows: Rows, states: _States) -> None:
        """Begin new episodes at some rows from these states, shape (len(rows), 4)."""
        self._states[:, rows] = states.T
        self._lengths[rows] = 0

    def step(self, actions: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32], _Flags, _Flags, _Flags]:
        """Step all cart-poles.

        Returns:
            Observations, shape (num, 4), rewards, terminated, truncated, and whether the episode has ended either way.
        """
        if self._physics is None:
            return self._step_by_gymnasium(actions)
        self._states, terminated = self._physics.step(self._states, actions)
        self._lengths += 1
        truncated = self._lengths >= self._env.max_episode_steps
        observations, rewards = self._states.T.astype(np.float32, order="C"), self._physics.rewards(terminated)
        return observations, rewards, terminated, truncated, np.logical_or(terminated, truncated)

    def _step_by_gymnasium(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], _Flags, _Flags, _Flags]:
        env = self._env
        env.state, env.steps = self._states, self._lengths
        # Otherwise the env would reset the sub-environments whose episodes ended in the step before.
        env.prev_done = np.zeros(len(self._lengths), dtype=np.bool_)
        observations, rewards, terminated, truncated, _ = env.step(actions)
        self._states, self._lengths = env.state, env.steps
        return np.ascontiguousarray(observations), rewards, terminated, truncated, env.prev_done

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


def own_physics(env: CartPoleVectorEnv) -> CartPolePhysics | None:
    """Return the physics of an environment, or None if steps would not be the environment's own to the last bit.

    What fails, as with a class that has other parts, is left to the environment.
    """
    try:
        constants = Constants.of(env)
        return CartPolePhysics(constants) if _steps_alike(constants) else None
    except Exception:  # noqa: BLE001 (another version may raise anything)
        return None


@cache
def _steps_alike(constants: Constants) -> bool:
    """Whether rows with these constants take the steps of Gymnasium's: one pushed to and fro, one left, one right."""
    env: Any = CartPoleVectorEnv(
        3, max_episode_steps=_COMPARED_LIMIT, sutton_barto_reward=constants.sutton_barto_reward
    )
    for name in Constants._fields[:-1]:
        setattr(env, name, getattr(constants, name))
    env.reset(seed=0)
    begin = env.state.T
    both = CartPoleRows(env, None), CartPoleRows(env, CartPolePhysics(constants))
    for rows in both:
        rows.put(begin, np.zeros(len(begin)))
    for number in range(_COMPARED_STEPS):
        theirs, own = (rows.step(np.array([number % 2, 0, 1])) for rows in both)
        if not all(map(np.array_equal, (*theirs, both[0].states), (*own, both[1].states))):
            return False
        ended = np.flatnonzero(own[-1])
        for rows in both:
            rows.restart(ended, begin[ended])
    return True


class _AnyActions(gym.spaces.MultiDiscrete):
    """An action space that accepts the actions of any number of cart-poles without a check."""

    def __init__(self) -> None:
        super().__init__([2])

    def contains(self, x: Any) -> bool:
        del x
        return True
