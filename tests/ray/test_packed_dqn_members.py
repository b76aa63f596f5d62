"""DQN members come and go, are saved and restored, go wrong; what becomes of one does not depend on the others."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray
from packed_dqn import DQNMember, add, make_stack
from packed_rllib import assert_same_stats

from policies.packed.member import MemberStats

if TYPE_CHECKING:
    from policies.packed.dqn.stack import DQNStack

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

# Of all kinds, so that the one that is watched stands alone in a group, or is padded with others in one, of its
# activation or another.
OTHERS = [
    {"hidden_sizes": (size, size), "activation": activation, "lr": lr, "gamma": gamma, "replay_capacity": capacity}
    for size, activation, lr, gamma, capacity in (
        (20, "relu", 1e-3, 0.9, 100), (24, "relu", 1e-2, 0.99, 5000), (64, "tanh", 3e-4, 0.99, 100),
        (22, "relu", 1e-3, 0.5, 900), (17, "relu", 3e-3, 1.0, 64), (40, "silu", 1e-3, 0.99, 100),
        (23, "relu", 1e-4, 0.9, 700), (19, "silu", 5e-3, 0.9, 300), (18, "relu", 1e-3, 0.9, 50),
        (21, "relu", 1e-3, 0.8, 1000), (24, "relu", 2e-3, 0.95, 200),
    )
]  # fmt: skip
WATCHED = {"hidden_sizes": (21, 18), "grad_clip": 0.5, "lr": 3e-3, "replay_capacity": 150, "target_update_freq": 50}
VARIANTS: dict[str, dict[str, Any]] = {
    # 0.6 updates a phase: members that began at other times make theirs in other phases.
    "uniform": {"updates_per_env_step": 0.15},
    "prioritized, three steps": {"replay": "prioritized", "n_step": 3, "updates_per_env_step": 0.4},
    "normalised, soft": {"normalize_observations": True, "tau": 0.1, "dueling": False},
    "no replay, by episodes": {
        "replay": "none",
        "target_update_unit": "episode",
        "target_update_freq": 2,
        "epsilon_unit": "episode",
    },
}


def trained_before(**shared: Any) -> DQNMember:
    """A member that has trained elsewhere, and whose replay memory is empty now."""
    stack = make_stack(**shared)
    add(stack, "before", 50, **{**OTHERS[1], **shared})
    # It learns after the eighth phase, then in all: no sum of updates is as the others'.
    for _ in range(2):
        stack.train_iteration()
    member = stack.remove("before")
    stack.envs.close()
    assert member.num_updates > 0
    return member


def in_pack(
    num_others: int, *, changes: bool = False, head_start: int = 0, **shared: Any
) -> tuple[DQNMember, list[MemberStats], int]:
    """The watched member after 5 iterations beside others, what its iterations gave, and how many groups there were."""
    stack, seen, num_groups = make_stack(**shared), [], 0
    others = [{**found, **shared} for found in OTHERS]
    for index in range(num_others // 2):
        add(stack, f"o{index}", index, **others[index])
    if head_start:
        add(stack, "before", 50, copy.deepcopy(trained_before(**shared)))
    for _ in range(head_start):
        stack.train_iteration()
    add(stack, "watched", 77, **{**WATCHED, **shared})
    for index in range(num_others // 2, num_others):
        add(stack, f"o{index}", index, **others[index])
    for iteration in range(5):
        if changes and iteration == 2:
            add(stack, "again", 50, copy.deepcopy(trained_before(**shared)))
        seen.append(stack.train_iteration()["watched"])
        num_groups = max(num_groups, len(stack._groups))
        if changes:
            stack.remove(f"o{2 * iteration}")
            add(stack, f"n{iteration}", 100 + iteration, **others[iteration])
    member = copy.deepcopy(stack.member("watched"))
    assert set(stack._replay._slots) == {found.member_id for found in stack.members}
    stack.envs.close()
    return member, seen, num_groups


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_member_does_not_depend_on_the_others(variant: str) -> None:
    """Weights after 5 iterations; all that differs is what products of padded sizes round otherwise.

    Rounding changes a component of a gradient by a share of 1e-4 at most, of those that are a thousandth of the
    largest; some 60 updates of the learning rate's size, 5e-3 and less, move a weight by 3e-5 with that. Another
    action would move all of them by hundredths. That there is none is no chance: each choice compares two numbers that
    rounding moves by 1e-7, and there are some hundred.
    """
    shared = VARIANTS[variant]
    alone, seen_alone, _ = in_pack(0, **shared)
    assert alone.num_updates > 40
    assert alone.num_target_updates > 3
    packs = [in_pack(2, **shared), in_pack(11, changes=True, **shared), in_pack(5, head_start=2, **shared)]
    assert packs[0][2] == 1
    assert packs[1][2] > 2
    for packed, seen, _ in packs:
        for name, value in alone.weights.items():
            np.testing.assert_allclose(packed.weights[name], value, rtol=1e-4, atol=1e-4, err_msg=name)
        # The very same episodes: not one action was another.
        assert [found.episodes for found in seen] == [found.episodes for found in seen_alone]
        assert [found.num_env_steps for found in seen] == [found.num_env_steps for found in seen_alone]
        for ours, theirs in zip(seen, seen_alone, strict=True):
            assert ours.learner == pytest.approx(theirs.learner, rel=1e-3, abs=1e-4)
        assert packed.rng.bit_generator.state == alone.rng.bit_generator.state
        for name in ("num_updates", "num_optimizer_steps", "num_target_updates", "target_updates_at", "due"):
            assert getattr(packed, name) == getattr(alone, name), name


def test_members_begin_to_learn_at_their_own_env_step() -> None:
    """Each in a stack of all, and alone: the same episodes and numbers of updates, and weights but for rounding."""
    starts = (0, 70, 190)

    def trained(*wanted: int) -> dict[int, tuple[DQNMember, list[MemberStats]]]:
        stack = make_stack()
        for start in wanted:
            values: dict[str, Any] = {**WATCHED, "learning_starts": start}
            add(stack, f"m{start}", 7 + start, **values)
        seen = [stack.train_iteration() for _ in range(5)]
        found = {start: copy.deepcopy(stack.member(f"m{start}")) for start in wanted}
        stack.envs.close()
        return {start: (member, [stats[f"m{start}"] for stats in seen]) for start, member in found.items()}

    together = trained(*starts)
    assert len({member.num_updates for member, _ in together.values()}) == len(starts)
    for start in starts:
        (alone, seen_alone), (packed, seen) = trained(start)[start], together[start]
        assert packed.num_updates == alone.num_updates > 0
        assert [found.episodes for found in seen] == [found.episodes for found in seen_alone]
        for name, value in alone.weights.items():
            np.testing.assert_allclose(packed.weights[name], value, rtol=1e-4, atol=1e-4, err_msg=name)


def test_members_of_one_seed_are_the_same() -> None:
    stack = make_stack()
    for name in ("a", "b"):
        add(stack, name, 5)
    add(stack, "c", 6)
    for _ in range(2):
        stats = stack.train_iteration()
    assert_same_stats(stats["a"], stats["b"])
    assert stats["a"].episodes != stats["c"].episodes
    stack.envs.close()


def test_sums_of_fractions_of_updates_are_each_members_own() -> None:
    """They differ by less than what a group is made by, and an update is due to one alone."""
    shared: dict[str, Any] = {"updates_per_env_step": 0.15, "env_steps_per_iteration": 4}
    found: dict[tuple[str, ...], dict[str, list[int]]] = {}
    for members in (("a", "b"), ("a",), ("b",)):
        stack = make_stack(**shared)
        for name in members:
            add(stack, name, 5, **shared)
        for _ in range(10):
            stack.train_iteration()
        for member in stack.members:
            # 0.6 updates a phase: the second phase from now makes 1.0 of it.
            member.due = 0.8 if member.member_id == "a" else 0.8 - 1e-8
        counts: dict[str, list[int]] = {name: [] for name in members}
        stack._stale = True
        for _ in range(5):
            stack.train_iteration()
            for member in stack.members:
                counts[member.member_id].append(member.num_updates)
        found[members] = counts
        stack.envs.close()
    together = found["a", "b"]
    assert together == found[("a",)] | found[("b",)]
    assert [a - b for a, b in zip(together["a"], together["b"], strict=True)] == [0, 1, 0, 0, 0]


# -- what goes wrong


def test_a_member_whose_weights_are_no_numbers_touches_no_other() -> None:
    """The others' weights are to the last bit those of a run in which nothing went wrong.

    Not across machines: both runs are the same program on this one, with the same shapes, and round alike.
    """
    weights = {}
    shared: dict[str, Any] = {"replay": "prioritized", "tau": 0.1, "normalize_observations": True}
    for goes_wrong in (False, True):
        stack = make_stack(**shared)
        several: list[dict[str, Any]] = [{"grad_clip": 1.0}, {"hidden_sizes": (5,)}, {"lr": 1e-2}]
        for index, values in enumerate(several):
            add(stack, f"m{index}", index, **{**shared, **values})
        stack.train_iteration()
        if goes_wrong:
            stack.member("m1").weights["af.bias"][:] = math.nan
            stack._stale = True
        for _ in range(3):
            stats = stack.train_iteration()
        weights[goes_wrong] = {m.member_id: stack.member(m.member_id).weights for m in stack.members}
        # What cannot be shown is left out.
        assert all(math.isfinite(value) for found in stats.values() for value in found.learner.values())
        assert ("total_loss" in stats["m1"].learner) is not goes_wrong
        assert ("gradient_norm" in stats["m0"].learner, "gradient_norm" in stats["m2"].learner) == (True, False)
        stack.envs.close()
    for name in ("m0", "m2"):
        for key, value in weights[False][name].items():
            np.testing.assert_array_equal(weights[True][name][key], value)
    # Not hidden, as RLlib's Learner does: the trial fails at its next evaluation.
    assert not np.isfinite(weights[True]["m1"]["encoder.mlp.0.weight"]).any()
    assert not np.isfinite(weights[True]["m1"]["_target_af.bias"]).any()


@pytest.mark.parametrize("n_step", [1, 3])
def test_a_member_whose_env_raises_leaves_the_others_as_they_were(n_step: int) -> None:
    """It goes wrong in its first iteration of two that it takes part in, and leaves after them.

    To the last bit: both runs are the same program on one machine, with the same shapes, and round alike.
    """
    weights = {}
    shared: dict[str, Any] = {"n_step": n_step}
    for how in (None, "raise"):
        troubles = {} if how is None else {str(1024): {"how": how, "at": 30}}
        stack = make_stack("TestTrouble-v0", {"troubles": troubles}, **shared)
        several: list[dict[str, Any]] = [{"lr": 1e-2}, {}, {"hidden_sizes": (5,)}]
        for index, values in enumerate(several):
            add(stack, f"m{index}", 1024 * index, **{**shared, **values})
        stack.train_iteration()
        assert not stack.envs.errors
        for _ in range(2):
            stats = stack.train_iteration()
            assert set(stats) == {"m0", "m1", "m2"}
        if how is not None:
            assert set(stack.envs.errors) == {"m1"}
            assert "the cart left the track" in str(stack.envs.errors["m1"])
        stack.remove("m1")
        stats = stack.train_iteration()
        weights[how] = ({m.member_id: stack.member(m.member_id).weights for m in stack.members}, stats)
        stack.envs.close()
    assert set(weights["raise"][0]) == {"m0", "m2"}
    assert weights["raise"][1] == weights[None][1]
    for name, found in weights[None][0].items():
        for key, value in found.items():
            np.testing.assert_array_equal(weights["raise"][0][name][key], value)


def test_a_member_that_does_not_fit_into_memory_leaves_nothing_behind() -> None:
    stack = make_stack()
    add(stack, "a", 0)
    stack.train_iteration()
    with pytest.raises(MemoryError):
        add(stack, "b", 1, replay_capacity=10**15)
    assert stack.envs.member_ids == ("a",)
    stack.train_iteration()
    add(stack, "b", 1)
    assert set(stack.train_iteration()) == {"a", "b"}
    stack.envs.close()


# -- what is stored


def stored(
    stack: DQNStack, name: str
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """(observations, next observations, rewards, discounts) of a member."""
    (slot,) = stack._replay.slots([name]).tolist()
    rows, num_inputs = stack._replay.written(slot), stack._num_inputs
    return rows[:, :num_inputs], rows[:, num_inputs + 1 : -4], rows[:, -2], rows[:, -1]


@pytest.mark.parametrize("n_step", [1, 3])
def test_no_transition_spans_an_episodes_end_and_only_terminations_end_values(n_step: int) -> None:
    """`TestTicks` tells of each observation which step of which episode it is, and its actions begin at 5."""
    gamma, limit = 0.5, 7
    shared: dict[str, Any] = {"n_step": n_step, "gamma": gamma}
    for end in (None, 4):
        stack = make_stack("TestTicks-v0", {} if end is None else {"end": end}, **shared)
        for name, seed in (("a", 10), ("b", 20)):
            add(stack, name, seed, **shared)
        for _ in range(3):
            stats = stack.train_iteration()
        for name in ("a", "b"):
            now, later, rewards, discounts = stored(stack, name)
            lengths = later[:, 0] - now[:, 0]
            # The time limit is no earlier than the latest termination, and both at once is a termination.
            ends = np.full(len(now), limit) if end is None else end + now[:, 1] % 3
            assert len(now) > 150
            np.testing.assert_array_equal(now[:, 1:], later[:, 1:])
            np.testing.assert_array_equal(lengths, np.minimum(n_step, ends - now[:, 0]))
            terminates = (later[:, 0] == ends) if end is not None else np.zeros(len(now), dtype=bool)
            np.testing.assert_array_equal(discounts, np.where(terminates, 0.0, gamma**lengths))
            expected = [
                sum(gamma**step * (first + step + 1 + episode / 1000) for step in range(int(length)))
                for first, episode, length in zip(now[:, 0], now[:, 1], lengths, strict=True)
            ]
            np.testing.assert_allclose(rewards, expected, rtol=1e-6)
            assert {length for _, length in stats[name].episodes} == ({limit} if end is None else {4, 5, 6})
        stack.envs.close()


def test_the_failure_penalty_is_learnt_from_and_not_reported() -> None:
    stack = make_stack(failure_penalty=-3.0, env_args={"max_episode_steps": 15})
    add(stack, "a", 0)
    episodes = [found for _ in range(4) for found in stack.train_iteration()["a"].episodes]
    now, later, rewards, discounts = stored(stack, "a")
    fallen = np.abs(later[:, 2]) > 0.2095
    np.testing.assert_array_equal(rewards, np.where(fallen, -3.0, 1.0))
    np.testing.assert_array_equal(discounts, np.where(fallen, np.float32(0.0), np.float32(0.99)))
    # The velocity moves the cart: no row begins in one episode and ends in another.
    np.testing.assert_allclose(later[:, 0], now[:, 0] + 0.02 * now[:, 1], atol=1e-6)
    assert all(total == length for total, length in episodes)
    assert {length < 15 for _, length in episodes} == {True, False}
    stack.envs.close()
