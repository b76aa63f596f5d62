"""Environments whose spaces no algorithm takes: what the refusal says to wrap them in is what makes them trainable."""

import importlib
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from policies.envs import modules as env_modules
from policies.envs.make import check_env, make_env
from policies.envs.modules import allow_modules
from policies.errors import EnvError
from policies.hyperparams import Algorithm
from tune_jobs.plan.env_notes import env_notes
from tune_jobs.spec.file import load_spec

NUMBERS = spaces.Box(-1, 1, (3,), np.float32)


class Mission(gym.Space[str]):
    """A space of somebody's own, as MiniGrid's, that says no more than it has to."""

    def sample(self, mask: Any = None, probability: Any = None) -> str:
        return "go"

    def contains(self, x: Any) -> bool:
        return isinstance(x, str) and x == "go"


OBSERVATIONS = {
    "mission in a dict": spaces.Dict({"image": spaces.Box(0, 255, (3, 3, 3), np.uint8), "mission": Mission()}),
    "text": spaces.Text(4),
    "text in a dict": spaces.Dict({"here": spaces.Discrete(3), "word": spaces.Text(2)}),
}
ACTIONS: dict[str, gym.Space[Any]] = {
    "multi-discrete": spaces.MultiDiscrete([3, 2, 4]),
    "multi-discrete matrix": spaces.MultiDiscrete(cast("Any", [[3, 2], [2, 2]])),
    "multi-binary": spaces.MultiBinary(3),
    "multi-binary matrix": spaces.MultiBinary([2, 2]),
}
BEYOND: dict[str, tuple[gym.Space[Any], gym.Space[Any], str]] = {
    "mission": (Mission(), NUMBERS, "gymnasium.ObservationWrapper"),
    "graph": (spaces.Graph(NUMBERS, None), NUMBERS, "gymnasium.ObservationWrapper"),
    "sequence": (spaces.Sequence(NUMBERS), NUMBERS, "gymnasium.ObservationWrapper"),
    "empty": (spaces.Box(-1, 1, (0,), np.float32), NUMBERS, "gymnasium.ObservationWrapper"),
    "choices and numbers": (
        NUMBERS,
        spaces.Dict({"a": NUMBERS, "b": spaces.Discrete(2)}),
        "all choices, or all numbers",
    ),
    "text": (NUMBERS, spaces.Text(3), "gymnasium.ActionWrapper"),
}

Refusal = Callable[..., EnvError]
"""Two spaces, and maybe an algorithm -> why an env of them is refused."""
OwnModule = Callable[[str], None]


class Odd(gym.Env[Any, Any]):
    """Of any spaces; refuses an action that is not in its own."""

    def __init__(self, observations: gym.Space[Any], actions: gym.Space[Any]) -> None:
        self.observation_space, self.action_space = observations, actions

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        return self.observation_space.sample(), 0.0, False, False, {}


@pytest.fixture
def refusal(monkeypatch: pytest.MonkeyPatch) -> Refusal:
    """What check_env says of an env of these spaces."""
    monkeypatch.setattr(env_modules, "_allowed", set())
    monkeypatch.setitem(gym.registry, "Odd-v0", None)

    def refuse(observations: gym.Space[Any], actions: gym.Space[Any], algorithm: Algorithm = "ppo") -> EnvError:
        del gym.registry["Odd-v0"]
        gym.register("Odd-v0", cast("Any", lambda: Odd(observations, actions)))
        with pytest.raises(EnvError) as caught:
            check_env("Odd-v0", None, algorithm)
        return caught.value

    return refuse


@pytest.fixture
def own_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[OwnModule]:
    """Writes a module of the user's own, as docs/guides/own-environment.md shows one, with an expression in it."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(expression: str) -> None:
        (tmp_path / "wrapped_envs.py").write_text(
            "import gymnasium\nimport numpy\n\n\n"
            f"def make(render_mode=None):\n    return {expression}\n\n\n"
            'gymnasium.register("Wrapped-v0", make)\n'
        )
        allow_modules(["wrapped_envs"])

    yield write
    sys.modules.pop("wrapped_envs", None)
    gym.registry.pop("Wrapped-v0", None)
    importlib.invalidate_caches()


def expression_in(error: EnvError) -> str:
    (found,) = re.findall("`(.+?)`", error.hint)
    return str(found)


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_the_wrapper_that_is_named_makes_observations_that_are_taken(
    kind: str, refusal: Refusal, own_module: OwnModule
) -> None:
    error = refusal(OBSERVATIONS[kind], spaces.Discrete(2))
    assert "Odd-v0 has" in error.message
    own_module(expression_in(error))
    for algorithm in ("ppo", "dqn"):
        info = check_env("wrapped_envs:Wrapped-v0", None, algorithm)
    env = make_env("wrapped_envs:Wrapped-v0")
    for _ in range(5):
        observation, _ = env.reset()
        assert info.observation_space.contains(observation)
        assert np.isfinite(observation).all()


@pytest.mark.parametrize("kind", ACTIONS)
def test_the_wrapper_that_is_named_makes_actions_that_can_be_taken(
    kind: str, refusal: Refusal, own_module: OwnModule
) -> None:
    own_module(expression_in(refusal(NUMBERS, ACTIONS[kind], "dqn")))
    info = check_env("wrapped_envs:Wrapped-v0", None, "dqn")
    env, space = gym.make("Wrapped-v0"), info.action_space
    env.reset()
    assert isinstance(space, spaces.Discrete)
    actions = range(int(space.n))
    sent = []
    step = env.unwrapped.step

    def noted(action: Any) -> Any:
        sent.append(tuple(np.ravel(action)))
        return step(action)

    env.unwrapped.step = noted  # type: ignore[method-assign]
    for action in actions:
        env.step(action)
    assert len(set(sent)) == len(actions)


@pytest.mark.parametrize("kind", BEYOND)
def test_what_no_wrapper_of_gymnasiums_does_needs_one_of_ones_own(kind: str, refusal: Refusal) -> None:
    observations, actions, words = BEYOND[kind]
    assert words in refusal(observations, actions).hint


@pytest.mark.parametrize("space", [spaces.MultiDiscrete([1000] * 3), spaces.Tuple((spaces.Discrete(2),) * 2)], ids=str)
def test_choices_of_which_no_expression_makes_one_need_a_wrapper_of_ones_own(
    space: gym.Space[Any], refusal: Refusal
) -> None:
    assert "ActionWrapper with Discrete actions" in refusal(NUMBERS, space, "dqn").hint


def test_a_class_of_a_module_is_made_as_such() -> None:
    from policies.envs.space_hints import observation_hint

    assert "wrappers.FlattenObservation(my_envs.Walk())" in observation_hint("my_envs:Walk", spaces.Text(2))


SCREEN = spaces.Box(0, 255, (40, 30, 3), np.uint8)
SMALL = spaces.Box(0, 255, (20, 30, 3), np.uint8)
HEALTH = spaces.Box(0, 1, (2,), np.float32)


@pytest.mark.parametrize(
    ("observations", "place", "size"),
    [
        (spaces.Dict({"health": HEALTH, "map": SMALL, "screen": SCREEN}), "observation['screen']", "3,600"),
        (spaces.Tuple((SMALL, spaces.Dict({"eye": SCREEN}))), "observation[1]['eye']", "3,600"),
    ],
)
def test_the_wrapper_that_a_plan_names_observes_the_image_alone(
    observations: gym.Space[Any], place: str, size: str, own_module: OwnModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())
    monkeypatch.setitem(gym.registry, "Odd-v0", None)
    del gym.registry["Odd-v0"]
    gym.register("Odd-v0", cast("Any", lambda: Odd(observations, spaces.Discrete(2))))
    spec = load_spec({"env": "Odd-v0", "algorithm": "ppo"})
    # That bytes in vectors are large is told besides.
    of_vectors, of_image, of_sizes = env_notes(spec, check_env("Odd-v0", None, "ppo"))
    assert "normalize_observations" in of_sizes
    assert "are made vectors of shape" in of_vectors
    assert of_image.startswith(f"{size} numbers of these vectors are those of an image, {place}:")
    (expression,) = re.findall("`(.+?)`", of_image)
    own_module(expression)
    info = check_env("wrapped_envs:Wrapped-v0", None, "ppo")
    assert info.observes_images
    assert info.observation_space == SCREEN
    assert make_env("wrapped_envs:Wrapped-v0").reset()[0].shape == SCREEN.shape


@pytest.mark.parametrize(
    "observations",
    [
        spaces.Dict({"health": HEALTH, "map": SMALL}),
        spaces.Dict({"first": SMALL, "second": SMALL}),
        spaces.Dict({"grid": spaces.Box(-1, 1, (40, 30, 3), np.float32)}),
        spaces.Dict({"letters": spaces.Box(0, 255, (80, 80), np.uint8)}),
        spaces.Dict({"texts": spaces.Box(0, 255, (21, 79, 80), np.uint8)}),
    ],
)
def test_of_what_is_no_large_image_nothing_is_said(
    observations: gym.Space[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(gym.registry, "Odd-v0", None)
    del gym.registry["Odd-v0"]
    gym.register("Odd-v0", cast("Any", lambda: Odd(observations, spaces.Discrete(2))))
    notes = env_notes(load_spec({"env": "Odd-v0", "algorithm": "ppo"}), check_env("Odd-v0", None, "ppo"))
    (note,) = [note for note in notes if "normalize_observations" not in note]
    assert "are made vectors of shape" in note


def test_no_wrapper_is_named_that_would_lose_a_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    # Whatever is drawn of it, both actions are allowed.
    members: dict[str, gym.Space[Any]] = {"action_mask": spaces.Box(1, 1, (2,), np.int8), "screen": SCREEN}
    monkeypatch.setitem(gym.registry, "Odd-v0", None)
    del gym.registry["Odd-v0"]
    gym.register("Odd-v0", cast("Any", lambda: Odd(spaces.Dict(members), spaces.Discrete(2))))
    notes = env_notes(load_spec({"env": "Odd-v0", "algorithm": "ppo"}), check_env("Odd-v0", None, "ppo"))
    assert [note for note in notes if "observation['action_mask']" in note]
    assert not [note for note in notes if "TransformObservation" in note]
