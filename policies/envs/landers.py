"""Step Gymnasium's LunarLander for many copies, without what is around Box2D's steps.

Box2D's own steps are made one copy after another, as they have to be. What Gymnasium computes around each is computed
in Python's numbers, each expression as it stands there, and what a step has left is not asked for again: the results
are those of Gymnasium's environments to the last bit. Half of an env step's time was spent there.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs.copies import CopiesStep
from policies.envs.faults import close_env
from policies.envs.make import make_env
from policies.envs.plain import is_plain

_MODULE, _CLASS = "gymnasium.envs.box2d.lunar_lander", "LunarLander"
_ENTRY_POINT = f"{_MODULE}:{_CLASS}"
_COMPARED_STEPS = 150  # a fall takes 55 to 120
_ITERATIONS = 6 * 30, 2 * 30
"""Of Box2D's solvers, for velocities and positions."""


class _Numbers:
    """The numbers of Gymnasium's module, as far as they enter a step."""

    def __init__(self) -> None:
        module: Any = importlib.import_module(_MODULE)
        scale = module.SCALE
        self.scale, self.fps = scale, module.FPS
        self.half_width, self.half_height = module.VIEWPORT_W / scale / 2, module.VIEWPORT_H / scale / 2
        self.leg_down = module.LEG_DOWN / scale
        self.main_y, self.main_power = module.MAIN_ENGINE_Y_LOCATION / scale, module.MAIN_ENGINE_POWER
        self.side_away, self.side_height = module.SIDE_ENGINE_AWAY, module.SIDE_ENGINE_HEIGHT
        self.side_power = module.SIDE_ENGINE_POWER


class _Stepped(NamedTuple):
    state: tuple[float, ...]
    reward: float
    terminated: bool


class _Lander:
    """One environment as it is stepped here; its resets are its own."""

    def __init__(self, env: gym.Env[Any, Any], numbers: _Numbers) -> None:
        self._inner: Any = env.unwrapped
        self._numbers = numbers
        self._lander: Any = None
        self._x = self._y = self._angle = 0.0

    def step(self, main: float, side: float, direction: float) -> _Stepped:
        """Step once.

        Args:
            main: The power of the main engine, 0 to 1.
            side: That of a side engine.
            direction: The side: -1 is left, 1 is right.
        """
        inner, numbers = self._inner, self._numbers
        lander = inner.lander
        if lander is not self._lander:
            # An episode has begun, each with bodies of its own.
            self._lander = lander
            position = lander.position
            self._x, self._y, self._angle = position.x, position.y, lander.angle
        x, y, angle, scale = self._x, self._y, self._angle, numbers.scale
        draw = inner.np_random.random
        # As `uniform(-1, 1)` computes it. Drawn without engines, too, as the next episode's start comes after it.
        first = (-1.0 + 2.0 * draw()) / scale
        second = (-1.0 + 2.0 * draw()) / scale
        if main or side:
            sine, cosine = math.sin(angle), math.cos(angle)
        if main:
            along = numbers.main_y + 2 * first
            ox = sine * along + -cosine * second
            oy = -cosine * along - sine * second
            power = numbers.main_power
            lander.ApplyLinearImpulse((-ox * power * main, -oy * power * main), (x + ox, y + oy), True)  # noqa: FBT003 (Box2D's C function)
        if side:
            aside = 3 * second + direction * numbers.side_away / scale
            ox = sine * first + -cosine * aside
            oy = -cosine * first - sine * aside
            power = numbers.side_power
            # Gymnasium's own number for the height, which is another one than its engines'.
            at = (x + ox - sine * 17 / scale, y + oy + cosine * numbers.side_height / scale)
            lander.ApplyLinearImpulse((-ox * power * side, -oy * power * side), at, True)  # noqa: FBT003
        inner.world.Step(1.0 / numbers.fps, *_ITERATIONS)
        position, velocity = lander.position, lander.linearVelocity
        self._x, self._y, self._angle = x, y, angle = position.x, position.y, lander.angle
        left, right = inner.legs
        across = (x - numbers.half_width) / numbers.half_width
        above = (y - (inner.helipad_y + numbers.leg_down)) / numbers.half_height
        speed_x = velocity.x * numbers.half_width / numbers.fps
        speed_y = velocity.y * numbers.half_height / numbers.fps
        left_down = 1.0 if left.ground_contact else 0.0
        right_down = 1.0 if right.ground_contact else 0.0
        shaping = (
            -100 * math.sqrt(across * across + above * above)
            - 100 * math.sqrt(speed_x * speed_x + speed_y * speed_y)
            - 100 * abs(angle)
            + 10 * left_down
            + 10 * right_down
        )
        reward = shaping - inner.prev_shaping - main * 0.30 - side * 0.03
        inner.prev_shaping = shaping
        terminated = False
        if inner.game_over or abs(across) >= 1.0:
            terminated, reward = True, -100.0
        if not lander.awake:
            terminated, reward = True, 100.0
        turning = 20.0 * lander.angularVelocity / numbers.fps
        state = (across, above, speed_x, speed_y, angle, turning, left_down, right_down)
        return _Stepped(state, reward, terminated)


class Landers:
    """Steps copies of a LunarLander without wind, all of which have its arguments; see `policies.envs.copies.Stepper`.

    Args:
        env: One of them, which tells its arguments; it is not stepped.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        inner: Any = env.unwrapped
        self.is_continuous: bool = inner.continuous
        self._numbers = _Numbers()
        self.limit = None if env.spec is None else env.spec.max_episode_steps

    @classmethod
    def of(cls, env_id: str, env_args: Mapping[str, Any] | None) -> Landers | None:
        """Return what steps an environment's copies, or None if it is no LunarLander, or steps in another way.

        No other environment is made. What a LunarLander's raises is left to those who make it next.
        """
        spec = gym.registry.get(env_id)
        if spec is None or spec.entry_point != _ENTRY_POINT:
            return None
        made: list[gym.Env[Any, Any]] = []
        try:
            made.append(make_env(env_id, env_args))
            if not _is_lander(made[0]):
                return None
            made.append(make_env(env_id, env_args))
            found = cls(made[0])
            return found if _step_alike(found, *made) else None
        except Exception:  # noqa: BLE001 (an env may raise anything)
            return None
        finally:
            for env in made:
                close_env(env)

    def copy_of(self, env: gym.Env[Any, Any]) -> _Lander:
        """Return what `step` takes for an environment of its own, over all its episodes."""
        return _Lander(env, self._numbers)

    def step(self, copies: Sequence[_Lander], actions: NDArray[Any]) -> CopiesStep:
        """Step copies, of which there is at least one; they never reset by themselves.

        Args:
            copies: The copies, as `copy_of` returns them.
            actions: One for each: numbers of shape (num,), or powers of shape (num, 2) if it is continuous.
        """
        states: list[tuple[float, ...]] = [(0.0,) * 8] * len(copies)
        rewards, terminated = np.zeros(len(copies)), np.zeros(len(copies), dtype=np.bool_)
        failures: dict[int, Exception] = {}
        engines = (_engines_of_powers if self.is_continuous else _engines_of_choices)(actions)
        for number, (copy, engine) in enumerate(zip(copies, engines, strict=True)):
            try:
                states[number], rewards[number], terminated[number] = copy.step(*engine)
            except Exception as error:  # noqa: BLE001 (of the member whose env it is)
                failures[number] = error
        return CopiesStep(np.array(states, dtype=np.float32), rewards, terminated, failures)

    def close(self) -> None:
        """Do nothing: no environment is kept."""


def _engines_of_choices(actions: NDArray[Any]) -> list[tuple[float, float, float]]:
    return [_CHOICES[action] for action in actions.tolist()]


_CHOICES = ((0.0, 0.0, 0.0), (0.0, 1.0, -1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 1.0))
"""The powers of the main and a side engine, and its side, by the number of an action."""


def _engines_of_powers(actions: NDArray[Any]) -> list[tuple[float, float, float]]:
    engines = []
    for vertical, lateral in np.clip(actions, -1, 1).astype(np.float64).tolist():
        main = (min(vertical, 1.0) + 1.0) * 0.5 if vertical > 0.0 else 0.0
        strength = abs(lateral)
        side = min(strength, 1.0) if strength > 0.5 else 0.0
        engines.append((main, side, math.copysign(1.0, lateral)))
    return engines


def _is_lander(env: gym.Env[Any, Any]) -> bool:
    """Whether an environment is LunarLander without wind, with nothing but its time limit around it, and not drawn."""
    inner: Any = env.unwrapped
    kind = type(inner)
    # Exactly this class: one that was derived may do anything else. By name, as Box2D need not be installed.
    if (kind.__module__, kind.__qualname__) != (_MODULE, _CLASS):
        return False
    return is_plain(env) and inner.render_mode is None and not inner.enable_wind


def _step_alike(landers: Landers, env: gym.Env[Any, Any], other: gym.Env[Any, Any]) -> bool:
    """Whether copies take the environment's own steps: compared through falls, with fixed actions."""
    copies = [landers.copy_of(env)]
    env.reset(seed=0)
    other.reset(seed=0)
    num_falls = 0
    for number in range(_COMPARED_STEPS):
        # Without engines the second time.
        choice = number % len(_CHOICES) if num_falls == 0 else 0
        powers = np.array([math.cos(choice), math.cos(2 * choice)] if choice else [0, 0], dtype=np.float32)
        action: Any = powers if landers.is_continuous else np.int64(choice)
        observation, reward, terminated, _, _ = other.unwrapped.step(action)
        stepped = landers.step(copies, np.asarray(action)[None])
        same = np.array_equal(stepped.observations[0], observation) and stepped.rewards[0] == reward
        if not same or stepped.terminated[0] != terminated or stepped.failures:
            return False
        if terminated:
            num_falls += 1
            env.reset(seed=number)
            other.reset(seed=number)
    return num_falls > 0
