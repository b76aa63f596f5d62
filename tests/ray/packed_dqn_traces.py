"""The cases of DQN's hyperparameters that are times and numbers, or act on transitions: see `packed_dqn_cases`.

What happens in some iterations is compared with what happens in `ReplayDQN`, whose own cases are in `dqn_cases`.
"""

from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, SupportsFloat
from unittest.mock import patch

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from packed_dqn import SMALL, add, compare, make_stack
from packed_dqn_cases import arrives

from policies.hyperparams import DQNHyperparams
from policies.networks.epsilon import EpsilonSchedule
from policies.packed.dqn.group import Batch, DQNGroup
from policies.packed.envs.vector import Step
from policies.replay import ReplayBuffer, Transitions


@dataclass
class Trace:
    """What happened in some iterations."""

    phases: list[tuple[int, int, float]] = field(default_factory=list)
    """(env steps, updates, learning rate) of each training phase."""
    sizes: set[int] = field(default_factory=set)
    """Of the batches."""
    target_updates: list[float] = field(default_factory=list)
    """Env steps after which they were made."""
    epsilons: dict[float, float] = field(default_factory=dict)
    """By env steps or episodes so far."""
    num_env_steps: list[int] = field(default_factory=list)
    """After each iteration."""
    num_stored: list[int] = field(default_factory=list)
    """Transitions in the replay memory then."""


ENV: dict[str, Any] = {"env_id": "CartPole-v1", "env_args": {"max_episode_steps": 5}}
"""Its episodes end after 5 steps, whatever the actions."""
TRACED: dict[str, Any] = {**SMALL, "num_envs": 1, "env_steps_per_iteration": 60}


def rounded(value: SupportsFloat) -> float:
    return float(f"{float(value):.4g}")


def following_epsilons(trace: Trace) -> AbstractContextManager[Any]:
    at = EpsilonSchedule.at

    def spied(self: EpsilonSchedule, num_units: int) -> float:
        trace.epsilons[num_units] = at(self, num_units)
        return trace.epsilons[num_units]

    return patch.object(EpsilonSchedule, "at", spied)


def pack_trace(num_iterations: int, values: dict[str, Any]) -> Trace:
    trace, stack = Trace(), make_stack(**ENV, **values)
    member = add(stack, "m", 5, **values)
    learn, update, move = DQNGroup.learn, DQNGroup._update, DQNGroup._update_targets

    def spied_learn(
        self: DQNGroup, numbers: NDArray[np.float64], num_new_steps: int, *, wants_stats: bool
    ) -> list[dict[str, float]]:
        found = learn(self, numbers, num_new_steps, wants_stats=wants_stats)
        trace.phases.append((member.num_env_steps, len(numbers), rounded(self._optimizer.lr)))
        return found

    def spied_update(self: DQNGroup, batch: Batch, *, wants_stats: bool) -> list[dict[str, float]]:
        trace.sizes.add(batch.now.shape[1])
        return update(self, batch, wants_stats=wants_stats)

    def spied_move(self: DQNGroup, num_steps_after: float) -> None:
        before = member.num_target_updates
        move(self, num_steps_after)
        if member.num_target_updates > before:
            trace.target_updates.append(member.num_env_steps - num_steps_after)

    with (
        following_epsilons(trace),
        patch.object(DQNGroup, "learn", spied_learn),
        patch.object(DQNGroup, "_update", spied_update),
        patch.object(DQNGroup, "_update_targets", spied_move),
    ):
        for _ in range(num_iterations):
            trace.num_env_steps.append(stack.train_iteration()["m"].num_env_steps)
            trace.num_stored.append(int(stack._replay.sizes(stack._replay.slots(["m"]))[0]))
    assert member.num_updates == sum(count for _, count, _ in trace.phases)
    stack.envs.close()
    return trace


def rllib_trace(num_iterations: int, values: dict[str, Any]) -> Trace:
    from policies.rllib.config import build_algorithm_config

    hyperparams = DQNHyperparams(**{**SMALL, **values})
    algorithm = build_algorithm_config(hyperparams, seed=5, **ENV).build_algo()
    trace, learner = Trace(), algorithm.learner
    learn, update, move, update_target = (
        learner.update_from_replay, learner.update_from_transitions, learner._update_target, learner.update_target
    )  # fmt: skip
    now: list[float] = []

    def spied_learn(replay: ReplayBuffer, num_updates: int, *, num_env_steps: int, **counts: int) -> dict[str, float]:
        stats: dict[str, float] = learn(replay, num_updates, num_env_steps=num_env_steps, **counts)
        trace.phases.append((num_env_steps, num_updates, rounded(stats["lr"])))
        return stats

    def spied_update(rows: Transitions, optimizer: torch.optim.Optimizer) -> Any:
        trace.sizes.add(len(rows.obs))
        return update(rows, optimizer)

    def spied_move(num_env_steps: int, num_episodes: int) -> None:
        now[:] = [num_env_steps]
        move(num_env_steps, num_episodes)

    def spied_target() -> None:
        trace.target_updates.append(now[0])
        update_target()

    learner.update_from_replay, learner.update_from_transitions = spied_learn, spied_update
    learner._update_target, learner.update_target = spied_move, spied_target
    with following_epsilons(trace):
        for _ in range(num_iterations):
            algorithm.train()
            trace.num_env_steps.append(algorithm.num_env_steps)
            trace.num_stored.append(len(algorithm.replay))
    algorithm.stop()
    return trace


def check_trace(name: str, num_iterations: int = 3, shared: dict[str, Any] | None = None, **values: Any) -> Trace:
    """What happens with these values is what happens in RLlib; and, of what is named, other than without them."""
    shared = {**TRACED, **(shared or {})}
    found = pack_trace(num_iterations, {**shared, **values})
    assert found == rllib_trace(num_iterations, {**shared, **values})
    assert getattr(found, name) != getattr(pack_trace(num_iterations, shared), name)
    return found


@arrives("lr_final", "lr_decay_steps")
def check_lr_schedule() -> None:
    found = check_trace("phases", lr=1e-2, lr_final=2e-3, lr_decay_steps=100)
    assert found.phases[-1][2] == 2e-3


@arrives("train_batch_size")
def check_train_batch_size() -> None:
    assert check_trace("sizes", train_batch_size=13).sizes == {13}


@arrives("env_steps_per_iteration")
def check_env_steps_per_iteration() -> None:
    assert check_trace("num_env_steps", env_steps_per_iteration=37, train_freq=1).num_env_steps == [37, 74, 111]


@arrives("train_freq")
def check_train_freq() -> None:
    found = check_trace("phases", train_freq=6)
    assert {now for now, *_ in found.phases} == set(range(36, 181, 6))


@arrives("updates_per_env_step")
def check_updates_per_env_step() -> None:
    for rate in (0.05, 0.1, 0.3, 1.75):
        found = check_trace("phases", updates_per_env_step=rate)
        # The first phase is after 32 env steps: all of those in it count.
        assert abs(sum(count for _, count, _ in found.phases) - rate * (180 - 28)) < 1


@arrives("learning_starts")
def check_learning_starts() -> None:
    assert check_trace("phases", learning_starts=75).phases[0][0] == 76


@arrives("target_update_freq")
def check_target_update_freq() -> None:
    found = check_trace("target_updates", target_update_freq=7)
    assert len(found.target_updates) > 15
    # The updates of a phase are spread over the env steps before it.
    found = check_trace("target_updates", target_update_freq=5, shared={"train_freq": 20})
    assert len(set(found.target_updates)) > 15
    check_trace("target_updates", target_update_freq=1)
    # Null: every 500 env steps if hard, every update if soft.
    assert pack_trace(3, TRACED).target_updates == []
    assert len(pack_trace(3, {**TRACED, "tau": 0.1}).target_updates) == 76


@arrives("target_update_unit")
def check_target_update_unit() -> None:
    found = check_trace("target_updates", target_update_unit="episode", shared={"target_update_freq": 6})
    assert found.target_updates == sorted(found.target_updates)
    assert len(found.target_updates) == pytest.approx(180 / 5 / 6, abs=1)


@arrives("replay_capacity")
def check_replay_capacity() -> None:
    assert check_trace("num_stored", replay_capacity=50).num_stored == [50, 50, 50]


@arrives("epsilon_initial", "epsilon_final", "epsilon_decay")
def check_epsilon() -> None:
    found = check_trace("epsilons", epsilon_initial=0.8, epsilon_final=0.2, epsilon_decay=60)
    assert found.epsilons == {t: pytest.approx(max(0.2, 0.8 - 0.01 * t)) for t in range(180)}
    for value in (0.0, 0.4, 1.0):
        assert random_share(epsilon_initial=value, epsilon_final=value) == value


@arrives("epsilon_start")
def check_epsilon_start() -> None:
    found = check_trace("epsilons", epsilon_start=15, epsilon_decay=100)
    assert found.epsilons[14] == found.epsilons[15] == 1.0 > found.epsilons[16]


@arrives("epsilon_schedule")
def check_epsilon_schedule() -> None:
    for name in ("exponential", "geometric"):
        check_trace("epsilons", epsilon_schedule=name, epsilon_decay=40)


@arrives("epsilon_unit")
def check_epsilon_unit() -> None:
    found = check_trace("epsilons", epsilon_unit="episode", epsilon_decay=10)
    assert set(found.epsilons) == set(range(36))


def random_share(**values: Any) -> float:
    """What share of a member's steps was not greedy, times two: half of the random actions are the greedy ones."""
    torch.manual_seed(0)
    stack = make_stack(learning_starts=10_000, env_steps_per_iteration=4000, **values)
    add(stack, "m", 0, learning_starts=10_000, env_steps_per_iteration=4000, **values)
    stack._arrange()
    act, actions, step = stack._groups[0].act, [], stack.envs.step
    greedy = []

    def spied_act(observations: NDArray[np.float32]) -> NDArray[np.float32]:
        out = act(observations)
        greedy.append(out.argmax(axis=-1).reshape(-1))
        return out

    def spied_step(taken: NDArray[Any]) -> Step:
        actions.append(taken)
        return step(taken)

    with patch.object(stack._groups[0], "act", spied_act), patch.object(stack.envs, "step", spied_step):
        stack.train_iteration()
    stack.envs.close()
    share = 2 * np.mean(np.concatenate(actions) != np.concatenate(greedy))
    return float(np.round(share, 1))


# -- of the transitions


def stored_rows(
    num_iterations: int = 2, **values: Any
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """(observations, next observations, rewards, discounts) of a member's replay memory."""
    stack = make_stack(**values)
    add(stack, "m", 0, **values)
    for _ in range(num_iterations):
        stack.train_iteration()
    (slot,) = stack._replay.slots(["m"]).tolist()
    rows = stack._replay.written(slot)
    stack.envs.close()
    return rows[:, :4], rows[:, 5:9], rows[:, -2], rows[:, -1]


@arrives("gamma")
def check_gamma() -> None:
    for gamma in (0.5, 0.0, 1.0):
        *_, discounts = stored_rows(gamma=gamma)
        assert set(discounts) <= {0.0, gamma}
        assert np.mean(discounts == gamma) > 0.5
    *_, rewards, discounts = stored_rows(gamma=0.5, n_step=3)
    # CartPole gives 1 a step: three steps of it, discounted; fewer at the end of an episode.
    assert set(rewards) == {1.0, 1.5, 1.75}
    assert np.all(discounts == np.where(rewards < 1.75, 0.0, discounts))
    assert set(discounts) == {0.0, 0.125}


@arrives("n_step")
def check_n_step() -> None:
    observations, following, rewards, _ = stored_rows(gamma=1.0, n_step=4)
    assert rewards.max() == np.median(rewards) == 4.0
    # Four steps apart: a cart moves by velocity times 0.02 s in one.
    assert np.median(np.abs(following[:, 0] - observations[:, 0] - 0.08 * observations[:, 1])) < 0.03
    # Longer than a phase, than an episode (of 5 steps), than the memory; learning from the first batch on.
    for n_step in (3, 9, 40):
        shared = {"replay": "prioritized", "train_freq": 1, "learning_starts": 0, "replay_capacity": 20}
        found = check_trace("phases", n_step=n_step, shared={**shared, "updates_per_env_step": 1.0})
        assert found.num_stored == [20, 20, 20]
        assert found.phases[0][0] == 15 + min(n_step, 5)


@arrives("num_envs")
def check_num_envs() -> None:
    for num_envs, expected in ((5, 65), (1, 64)):
        stack = make_stack(num_envs=num_envs)
        member = add(stack, "m", 0, num_envs=num_envs)
        stack.train_iteration()
        assert stack.envs.num_envs == num_envs
        assert len(stack.envs.observations) == num_envs
        assert member.num_env_steps == expected  # in whole vector steps, each with a training phase
        stack.envs.close()


@arrives("replay")
def check_replay() -> None:
    found = {name: compare([{"replay": name}])[0][0][0].batches for name in ("uniform", "prioritized", "none")}
    assert all(batch.weights is None for batch in found["uniform"] + found["none"])
    assert np.ptp(np.concatenate([batch.weights for batch in found["prioritized"]])) > 0.01
    # Nothing was added between these updates: all are of the newest transitions.
    for batch in found["none"][1:]:
        np.testing.assert_array_equal(batch.obs, found["none"][0].obs)
    assert not np.array_equal(found["uniform"][0].obs, found["uniform"][1].obs)
