"""Policies for other choices than an environment's are refused; masks may be a Tuple with an array for each choice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from policy_factory import registered

from policies.acting.evaluate import check_policy, evaluate_policy
from policies.acting.live import watch_episode
from policies.acting.load import load_policy
from policies.acting.policy import RandomPolicy
from policies.envs.make import check_env, make_env, make_vector_env
from policies.envs.masks import MaskedBox
from policies.errors import EnvError
from policies.hyperparams import PPOHyperparams
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.portable_member import portable_policy
from policies.portable.file import save_policy

ENV = "TestChoosing-v0"
TUPLE = spaces.Tuple([spaces.MultiBinary(2), spaces.MultiBinary(3)])


class Choosing(gym.Env[Any, Any]):
    """Two choices, or as many as are given; of the first only 1, of the second all but 0 is allowed."""

    def __init__(self, sizes: Any = (2, 3), mask: Any = None, length: int = 5) -> None:
        self.action_space = spaces.MultiDiscrete(sizes)
        self.length, self.steps, self.has_mask = length, 0, mask is not None
        seen = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Dict({"action_mask": mask, "seen": seen}) if self.has_mask else seen

    def _seen(self) -> Any:
        seen = np.array([0.5, self.steps / 10], np.float32)
        if not self.has_mask:
            return seen
        return {"action_mask": (np.array([0, 1], np.int8), np.array([0, 1, 1], np.int8)), "seen": seen}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert not self.has_mask or (action[0] == 1 and action[1] > 0), action
        self.steps += 1
        return self._seen(), 1.0, self.steps == self.length, False, {}


@pytest.fixture(autouse=True)
def _env() -> Iterator[None]:
    with registered(ENV, Choosing):
        yield


def random_policy(**env_args: Any) -> RandomPolicy:
    return RandomPolicy.for_env(ENV, env_args)


@pytest.mark.parametrize("sizes", [(5, 5), (3, 2), (2, 4)])
def test_a_policy_for_other_choices_is_refused(sizes: tuple[int, ...]) -> None:
    policy = random_policy(sizes=sizes)
    with pytest.raises(EnvError, match=r"whose actions are MultiDiscrete"):
        evaluate_policy(policy, env_id=ENV, seeds=[0])
    assert evaluate_policy(policy, env_id=ENV, env_args={"sizes": sizes}, seeds=[0]).lengths == (5,)


def test_a_policy_for_other_masks_is_refused() -> None:
    seen = spaces.Box(-1, 1, (3,), np.float32)
    env = make_env(ENV, {"mask": TUPLE})
    policy = random_policy(mask=TUPLE)
    check_policy(policy, env)
    # Of the same shape: more of its numbers are the mask.
    policy.observation_space = MaskedBox(spaces.Box(-1, 1, (2,), np.float32), (3, 2))
    with pytest.raises(EnvError, match="whose observations are"):
        check_policy(policy, env)
    policy.observation_space = MaskedBox(seen, (2, 2))
    with pytest.raises(EnvError, match="whose observations are"):
        check_policy(policy, env)


def test_a_mask_may_be_a_tuple_with_an_array_for_each_choice() -> None:
    args: dict[str, Any] = {"mask": TUPLE}
    info = check_env(ENV, args, "ppo")
    assert isinstance(info.observation_space, MaskedBox)
    assert (info.observation_space.sizes, info.observation_space.shape) == ((2, 3), (7,))
    env, envs, packed = (
        make_env(ENV, args),
        make_vector_env(ENV, args, 2),
        make_packed_envs(ENV, args, 2, kind="scalar"),
    )
    wanted = [0, 1, 0, 1, 1, 0.5, 0]
    assert env.reset(seed=0)[0].tolist() == wanted
    assert envs.reset(seed=0)[0].tolist() == [wanted] * 2
    assert envs.step(np.array([[1, 1], [1, 2]]))[0][:, :5].tolist() == [wanted[:5]] * 2
    packed.add("m", 0)
    assert not packed.errors
    assert packed.observations.reshape(-1, 7)[:, :5].tolist() == [wanted[:5]] * 2
    packed.close()
    assert evaluate_policy(random_policy(**args), env_id=ENV, env_args=args, seeds=[0, 1]).lengths == (5, 5)
    assert len(list(watch_episode(random_policy(**args), ENV, args, 0)[1])) == 6


def test_so_may_that_of_a_policy_file(tmp_path: Path) -> None:
    args: dict[str, Any] = {"mask": TUPLE}
    info = check_env(ENV, args, "ppo")
    member = new_member(
        "t0000", PPOHyperparams(hidden_sizes=(8,), num_envs=4), 3, info.observation_space, info.action_space
    )
    portable = portable_policy(
        member, info.observation_space, info.action_space, env_id=ENV, env_args={}, training={}
    )  # fmt: skip
    save_policy(portable, tmp_path)
    policy = load_policy(tmp_path)
    assert not portable.needs_mask
    own = gym.make(ENV, mask=TUPLE)
    observation, _ = own.reset(seed=0)
    first, second = policy.act(observation)
    assert (first, second > 0) == (1, True)
    assert policy.act([observation] * 3).tolist() == [[first, second]] * 3
    assert evaluate_policy(policy, env_id=ENV, env_args=args, seeds=range(20)).lengths == (5,) * 20


@pytest.mark.parametrize(
    "mask",
    [
        spaces.Tuple([spaces.MultiBinary(3), spaces.MultiBinary(2)]),
        spaces.Tuple([spaces.MultiBinary(2), spaces.MultiBinary(2)]),
        spaces.Tuple([spaces.Text(2), spaces.MultiBinary(3)]),
    ],
)
def test_another_tuple_is_no_mask(mask: Any) -> None:
    with pytest.raises(EnvError, match=r"there are 5 actions to allow, of the choices \[2, 3\]"):
        make_env(ENV, {"mask": mask})


class _Vector(spaces.Box):
    """An environment's own class of vectors; so are the others."""


class _Choice(spaces.Discrete[Any]):
    pass


class _SeveralChoices(spaces.MultiDiscrete):
    pass


class _Members(spaces.Dict):
    pass


class OwnClasses(gym.Env[Any, Any]):
    """Its spaces are of classes of its own."""

    def __init__(self, observed: str = "vector", acts: str = "choice") -> None:
        vector = _Vector(-1, 1, (3,), np.float32)
        self.observation_space = {
            "vector": vector, "choice": _Choice(4), "members": _Members({"a": vector, "b": _Choice(2)}),
        }[observed]  # fmt: skip
        self.action_space = {
            "choice": _Choice(3), "choices": _SeveralChoices([3, 2]), "vector": _Vector(-1, 2, (2,), np.float32),
            "members": _Members({"a": _Choice(3), "b": _Choice(2)}),
        }[acts]  # fmt: skip
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.steps += 1
        return self.observation_space.sample(), 1.0, self.steps == 5, False, {}


@pytest.mark.parametrize("observed", ["vector", "choice", "members"])
@pytest.mark.parametrize("acts", ["choice", "choices", "vector", "members"])
def test_a_class_of_spaces_of_the_envs_own_is_what_it_comes_from(tmp_path: Path, observed: str, acts: str) -> None:
    args = {"observed": observed, "acts": acts}
    with registered("TestOwnClasses-v0", OwnClasses):
        info = check_env("TestOwnClasses-v0", args, "ppo")
        made = (info.observation_space, info.action_space)
        member = new_member("t0000", PPOHyperparams(hidden_sizes=(8,), num_envs=4), 3, *made)
        save_policy(portable_policy(member, *made, env_id=info.env_id, env_args=args, training={}), tmp_path)
        for policy in (load_policy(tmp_path), RandomPolicy.for_env(info.env_id, args)):
            assert evaluate_policy(policy, env_id=info.env_id, env_args=args, seeds=[0, 1]).lengths == (5, 5)
