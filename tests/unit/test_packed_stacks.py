"""Who belongs in a stack, and how members come to it and leave it: the same for both algorithms."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, cast

import pytest

from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm, TrainedHyperparams, make_hyperparams
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from policies.packed.shared import SharedByDQN, SharedByPPO, shared_of
from policies.packed.stack import Stack

if TYPE_CHECKING:
    from policies.packed.member import AnyMember

SHARED = {"ppo": SharedByPPO, "dqn": SharedByDQN}
SMALL = {"hidden_sizes": (4,), "num_envs": 2, "train_batch_size": 8}
ALGORITHMS = {"ppo": SMALL | {"minibatch_size": 4}, "dqn": SMALL | {"replay_capacity": 64}}


@pytest.fixture(params=ALGORITHMS)
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    return cast("Algorithm", request.param)


@pytest.fixture
def stack(algorithm: Algorithm) -> Iterator[Stack[Any, Any, Any]]:
    envs = make_packed_envs("CartPole-v1", {}, 2, kind="vectorised")
    made = make_stack(cast("TrainedHyperparams", make_hyperparams(algorithm, ALGORITHMS[algorithm])), envs)
    yield made
    envs.close()


def member(stack: Stack[Any, Any, Any], algorithm: Algorithm, name: str, **values: float) -> AnyMember:
    hyperparams = cast("TrainedHyperparams", make_hyperparams(algorithm, ALGORITHMS[algorithm] | values))
    return new_member(name, hyperparams, 3, stack.envs.observation_space, stack.envs.action_space)


def test_what_is_shared_are_hyperparameters(algorithm: Algorithm) -> None:
    names = {field.name for field in dataclasses.fields(SHARED[algorithm])}
    assert names <= HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields.keys()
    made = cast("TrainedHyperparams", make_hyperparams(algorithm, ALGORITHMS[algorithm]))
    assert dataclasses.asdict(shared_of(made)) == {name: getattr(made, name) for name in names}


def test_members_come_and_go(stack: Stack[Any, Any, Any], algorithm: Algorithm) -> None:
    first, second = member(stack, algorithm, "a", lr=0.1), member(stack, algorithm, "b", lr=0.2)
    stack.add(first, 1)
    stack.add(second, 2)
    assert stack.train_iteration().keys() == {"a", "b"}
    assert stack.remove("a") is first
    assert ([item.member_id for item in stack.members], stack.envs.member_ids) == (["b"], ("b",))
    assert stack.train_iteration().keys() == {"b"}
    assert stack.member("b") is second


def test_who_shares_something_else_does_not_get_in(stack: Stack[Any, Any, Any], algorithm: Algorithm) -> None:
    stack.add(member(stack, algorithm, "a"), 1)
    with pytest.raises(ValueError, match="train_batch_size=4"):
        stack.add(member(stack, algorithm, "b", train_batch_size=4), 2)
    assert ([item.member_id for item in stack.members], stack.envs.member_ids) == (["a"], ("a",))
    assert stack.train_iteration().keys() == {"a"}


def test_who_there_is_no_memory_for_is_no_member(
    stack: Stack[Any, Any, Any], algorithm: Algorithm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: AnyMember, max_env_steps: int | None) -> None:
        raise MemoryError

    stack.add(member(stack, algorithm, "a"), 1)
    monkeypatch.setattr(stack, "_begin", refuse)
    with pytest.raises(MemoryError):
        stack.add(member(stack, algorithm, "b"), 2)
    assert stack.envs.member_ids == ("a",)
    assert stack.train_iteration().keys() == {"a"}
