"""Images of bytes are of bytes wherever an environment is made; what is none is refused, and not cut off."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from policy_factory import registered

from policies.acting.policy import RandomPolicy
from policies.acting.running import Running
from policies.envs.byte_images import as_bytes
from policies.envs.checked import CheckedEnvs
from policies.envs.make import check_env, make_env, make_vector_env
from policies.errors import EnvError, EnvFailedError, ObservationError
from policies.packed.envs.sub_envs import SubEnvs

ENV = "TestGrey-v0"
SHAPES = [(4, 5), (4, 5, 1)]
WRONG: dict[str, tuple[Any, str]] = {
    "a share": (0.25, "0.25"), "too small": (-1, "-1"), "too large": (300, "300"), "far too large": (1e30, r"1e\+30"),
    "none": (np.nan, "nan"),
}  # fmt: skip


class Grey(gym.Env[Any, Any]):
    """Observes an image of which one number is told; from some step on it is another."""

    action_space = gym.spaces.Discrete(2)

    def __init__(
        self, shape: Any, value: Any = 7, later: Any = None, dtype: str = "int64", masked: bool = False
    ) -> None:
        self.observation_space: Any = gym.spaces.Box(0, 255, tuple(shape), np.uint8)
        self.values, self.dtype, self.steps = (value, value if later is None else later), dtype, 0
        self.infos = {"action_mask": np.ones(2, np.int8)} if masked else {}

    def _seen(self) -> Any:
        image = np.arange(20).reshape(self.observation_space.shape).astype(self.dtype)
        image[2, 3] = self.values[self.steps >= 2]
        return image

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._seen(), self.infos

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._seen(), 1.0, self.steps == 5, False, self.infos


@pytest.fixture(autouse=True)
def _env() -> Iterator[None]:
    with registered(ENV, Grey):
        yield


def dtype_of(value: Any) -> str:
    return "int64" if isinstance(value, int) else "float64"


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("what", WRONG)
def test_what_is_no_byte_is_refused_in_the_plan(what: str, shape: tuple[int, ...], masked: bool) -> None:
    value, shown = WRONG[what]
    args = {"shape": shape, "dtype": dtype_of(value), "masked": masked, "action_mask": masked}
    check_env(ENV, args)
    with pytest.raises(EnvError, match=f"an observation in which {shown} is no byte, a whole number from 0 to 255"):
        check_env(ENV, {**args, "value": value})


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_plan_says_that_it_is_what_reset_returns(shape: tuple[int, ...]) -> None:
    with pytest.raises(
        EnvError, match=rf"^reset\(\) of {ENV} returns an observation in which 300 is no byte"
    ) as caught:
        check_env(ENV, {"shape": shape, "value": 300})
    assert caught.value.hint.startswith("Mend its reset()")


@pytest.mark.parametrize("frames", [{}, {"frame_stack": 2}], ids=str)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("what", WRONG)
def test_so_it_is_in_a_later_step_wherever_that_is(what: str, shape: tuple[int, ...], frames: dict[str, Any]) -> None:
    value, shown = WRONG[what]
    args = {"shape": shape, "later": value, "dtype": dtype_of(value), **frames}
    words = f"raised an error in step.*in which {shown} is no byte"
    check_env(ENV, args)
    episode = Running(make_env(ENV, args), 0, 0)
    episode.step(0)
    with pytest.raises(EnvFailedError, match=words):
        episode.step(0)
    rows = CheckedEnvs(make_vector_env(ENV, args, 2), ENV)
    rows.reset(seed=0)
    rows.step(np.zeros(2, np.int64))
    with pytest.raises(EnvFailedError, match=words):
        rows.step(np.zeros(2, np.int64))
    packed = SubEnvs(ENV, args)
    packed.add("m", [0])
    assert not packed.step(np.zeros(1, np.int64)).errors
    with pytest.raises(EnvFailedError, match=words):
        raise packed.step(np.zeros(1, np.int64)).errors["m"]


@pytest.mark.parametrize("dtype", ["int64", "int8", "uint8", "float32", "bool"])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_bytes_of_another_type_are_the_same_bytes_everywhere(shape: tuple[int, ...], dtype: str) -> None:
    args = {"shape": shape, "dtype": dtype}
    image = np.arange(20).reshape(4, 5, 1)
    image[2, 3] = 7
    wanted = (image > 0 if dtype == "bool" else image).astype(np.uint8)
    assert check_env(ENV, args).observation_space.shape == (4, 5, 1)
    env, packed = make_env(ENV, args), SubEnvs(ENV, args)
    rows = CheckedEnvs(make_vector_env(ENV, args, 1), ENV)
    found = [env.reset(seed=0)[0], rows.reset(seed=0)[0][0], packed.add("m", [0])[0]]
    found += [env.step(0)[0], rows.step(np.zeros(1, np.int64))[0][0]]
    found += [packed.step(np.zeros(1, np.int64)).final_observations[0]]
    for observation in found:
        assert observation.dtype == np.uint8
        assert np.array_equal(observation, wanted)


def test_bytes_are_not_copied() -> None:
    image = np.zeros((4, 5, 1), np.uint8)
    assert as_bytes(image) is image


def test_a_policy_is_given_bytes_too() -> None:
    policy = RandomPolicy.for_env(ENV, {"shape": (4, 5)})
    assert policy.act(np.ones((4, 5), np.int64)) in (0, 1)
    with pytest.raises(ObservationError, match=r"in which 0\.5 is no byte"):
        policy.act(np.full((4, 5), 0.5))


def test_what_are_no_numbers_is_told_as_before() -> None:
    with pytest.raises(EnvError, match="observations of dtype <U21 but declares uint8"):
        check_env(ENV, {"shape": (4, 5, 1), "dtype": "str"})


class Vectorised(gym.vector.VectorEnv[Any, Any, Any]):
    """Observes numbers of eight bytes, or one that is no byte."""

    def __init__(self, num_envs: int, shape: Any, value: Any = 7) -> None:
        self.num_envs, self.value = num_envs, value
        self.single_observation_space: Any = gym.spaces.Box(0, 255, tuple(shape), np.uint8)
        self.single_action_space = gym.spaces.Discrete(2)
        self.metadata = {"autoreset_mode": gym.vector.AutoresetMode.NEXT_STEP}

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return np.full((self.num_envs, *self.single_observation_space.shape), self.value), {}


def test_so_are_those_of_an_envs_own_vectorised_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gym.registry[ENV], "vector_entry_point", Vectorised)
    shape = (4, 5, 1)
    assert isinstance(make_vector_env(ENV, {"shape": shape}, 2).unwrapped, Vectorised)
    found, _ = CheckedEnvs(make_vector_env(ENV, {"shape": shape}, 2), ENV).reset()
    assert found.dtype == np.uint8
    assert (found == 7).all()
    wrong = CheckedEnvs(make_vector_env(ENV, {"shape": shape, "value": -1}, 2), ENV)
    with pytest.raises(EnvError, match=f"The vectorised {ENV} returned an observation in which -1 is no byte"):
        wrong.reset()
