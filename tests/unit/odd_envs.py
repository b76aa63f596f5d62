"""Environments that misbehave; child processes find them as `odd_envs:Name`."""

from __future__ import annotations

import os
import time

import gymnasium as gym
import numpy as np

RAISE, EXIT, WRONG_SHAPE = 1, 2, 3


class Fragile(gym.Env):
    """A random walk that goes on by action 0; by the others it breaks. It ends after 7 steps."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.steps = self.draw(), 0
        return self.state.copy(), {}

    def step(self, action):
        if action == RAISE:
            raise RuntimeError("the motor broke")
        if action == EXIT:
            os._exit(7)
        self.state += 0.1 * self.draw()
        self.steps += 1
        observation = np.zeros(5) if action == WRONG_SHAPE else self.state.copy()
        return observation, float(self.state.sum()), self.steps == 7, False, {}

    def draw(self):
        return self.np_random.normal(size=2)


class Slow(Fragile):
    """Two milliseconds a step."""

    action_space = gym.spaces.Discrete(1)

    def step(self, action):
        time.sleep(0.002)
        return super().step(action)


class Unseedable(Fragile):
    """Forgets its seed."""

    action_space = gym.spaces.Discrete(1)

    def draw(self):
        return np.random.default_rng().normal(size=2)


class ForgetsLater(Fragile):
    """Takes another generator in each reset that has no seed."""

    action_space = gym.spaces.Discrete(1)

    def reset(self, *, seed=None, options=None):
        self.generator = np.random.default_rng(seed)
        return super().reset(seed=seed)

    def draw(self):
        return self.generator.normal(size=2)


_shared = np.random.default_rng(0)


class Sharing(Fragile):
    """All copies draw from one generator, which whoever has a seed seeds."""

    action_space = gym.spaces.Discrete(1)

    def reset(self, *, seed=None, options=None):
        global _shared  # noqa: PLW0603
        if seed is not None:
            _shared = np.random.default_rng(seed)
        return super().reset(seed=seed)

    def draw(self):
        return _shared.normal(size=2)


class RefusesSeeds(Fragile):
    """Cannot be reset from seed 13."""

    def reset(self, *, seed=None, options=None):
        if seed == 13:
            raise ValueError("13 brings bad luck")
        return super().reset(seed=seed)


class Images(gym.Env):
    """Observes images, and cannot be drawn."""

    metadata = {"render_modes": []}  # noqa: RUF012
    observation_space = gym.spaces.Box(0, 255, (20, 16, 3), np.uint8)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return np.zeros((20, 16, 3), np.uint8), {}

    def step(self, action):
        return np.zeros((20, 16, 3), np.uint8), 0.0, True, False, {}


class VerySlow(Fragile):
    """A quarter of a second a step."""

    action_space = gym.spaces.Discrete(1)

    def step(self, action):
        time.sleep(0.25)
        return super().step(action)
