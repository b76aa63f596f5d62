"""The batches of a DQN phase: however many are drawn at once, each update learns from its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from policies.hyperparams import DQNHyperparams
from policies.packed.dqn import group
from policies.packed.dqn.replay import StackedPrioritizedReplay, StackedReplay
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from policies.packed.member import Weights

UPDATES = 8


def weights_after(**values: Any) -> list[Weights]:
    """The weights of two members after phases of eight updates each, in batches of four."""
    settings = [
        DQNHyperparams(
            hidden_sizes=(5,), num_envs=2, train_freq=16, updates_per_env_step=0.5, env_steps_per_iteration=64,
            train_batch_size=4, learning_starts=8, replay_capacity=50, lr=lr, **values,
        )
        for lr in (0.01, 0.003)
    ]  # fmt: skip
    envs = make_packed_envs("CartPole-v1", {}, 2, kind="vectorised")
    stack = make_stack(settings[0], envs)
    for index, item in enumerate(settings):
        stack.add(new_member(f"m{index}", item, index, envs.observation_space, envs.action_space), index)
    stack.train_iteration()
    envs.close()
    assert stack.member("m0").num_updates > 2 * UPDATES
    return [stack.member(f"m{index}").weights for index in range(2)]


@pytest.mark.parametrize("values", [{}, {"normalize_observations": True}, {"replay": "none"}], ids=str)
def test_how_many_are_drawn_at_once_changes_nothing(monkeypatch: pytest.MonkeyPatch, values: dict[str, Any]) -> None:
    shapes: list[tuple[int, ...]] = []
    draw = StackedReplay.draw

    def watched(self: StackedReplay, slots: Any, numbers: Any) -> Any:
        shapes.append(numbers.shape)
        return draw(self, slots, numbers)

    monkeypatch.setattr(StackedReplay, "draw", watched)
    found = []
    # All of a phase, one alone, and three, of which the last draw has two; an observation has five columns.
    for numbers_at_once, sizes in ((65_536, {UPDATES}), (1, {1}), (3 * 2 * 4 * (2 * 5 + 3), {3, 2})):
        monkeypatch.setattr(group, "_NUMBERS_AT_ONCE", numbers_at_once)
        shapes.clear()
        found.append(weights_after(**values))
        assert {shape[0] for shape in shapes} == sizes
        assert {shape[1:] for shape in shapes} == {(2, 4)}
    first, *others = found
    for other in others:
        for ours, theirs in zip(first, other, strict=True):
            for name, value in ours.items():
                np.testing.assert_array_equal(value, theirs[name], err_msg=name)


def test_priorities_are_set_before_the_next_batch_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    def watch(name: str, real: Any) -> None:
        def watched(self: Any, *args: Any) -> Any:
            calls.append(name)
            return real(self, *args)

        monkeypatch.setattr(StackedPrioritizedReplay, name, watched)

    for name in ("draw", "set_priorities"):
        watch(name, getattr(StackedPrioritizedReplay, name))
    weights_after(replay="prioritized")
    assert calls == ["draw", "set_priorities"] * (len(calls) // 2)
    assert len(calls) >= 2 * 2 * UPDATES
