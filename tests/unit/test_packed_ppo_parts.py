"""PPO's gradients by hand, episodes over fragments, advantages, and observation statistics of many members."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from packed_members import random_member
from torch import nn

from policies.networks.layers import ObservationStatistics
from policies.packed.inputs import Inputs
from policies.packed.member import OBS_COUNT, OBS_MEAN, OBS_VAR
from policies.packed.ppo import loss as ppo
from policies.packed.ppo.gae import advantages_and_targets, standardise
from policies.packed.sampling import EpisodeTracker, Observations, one_hot
from tests.rounding import assert_rounded, close

if TYPE_CHECKING:
    from policies.packed.ppo.loss import Minibatch

M, B = 4, 208


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def make_case(
    *sizes: int, with_kl: bool, with_old_values: bool = False, seed: int = 0
) -> tuple[torch.Tensor, torch.Tensor, Minibatch]:
    """(outputs, values, minibatch) with ratios far from 1 and values far from their targets, and from the old ones."""
    rng = torch.Generator().manual_seed(seed)
    outputs = 2 * torch.randn(M, B, sum(sizes), generator=rng)
    # Of several choices the ratios are products.
    old_outputs = outputs + torch.randn(M, B, sum(sizes), generator=rng) / len(sizes) ** 0.5
    chosen = [nn.functional.one_hot(torch.randint(size, (M, B), generator=rng), size) for size in sizes]
    actions = torch.cat(chosen, dim=-1).to(outputs.dtype)
    batch = ppo.Minibatch(
        actions=actions,
        logp=ppo.log_probabilities(old_outputs, actions, heads=ppo.Heads(sizes)),
        advantages=torch.randn(M, B, generator=rng),
        value_targets=3 * torch.randn(M, B, generator=rng),
        old_outputs=old_outputs if with_kl else None,
    )
    values = torch.randn(M, B, generator=rng)
    if with_old_values:
        batch.old_values = values + torch.randn(M, B, generator=rng)
    return outputs, values, batch


COEFFICIENTS = ppo.Coefficients(
    clip_param=column(0.1, 0.2, 0.3, 0.05),
    vf_clip_param=column(math.inf, 4.0, 0.5, 10.0),
    vf_clip_range=column(0.5, math.inf, 1.0, 0.1),
    vf_loss_coeff=column(0.5, 1.0, 0.0, 2.0),
    entropy_coeff=column(0.01, 0.0, 0.2, 0.0),
    kl_coeff=column(0.2, 0.0, 1.0, 3.0),
)


def checked_gradients(
    outputs: torch.Tensor, values: torch.Tensor, batch: Minibatch, coefficients: ppo.Coefficients, heads: ppo.Heads
) -> tuple[tuple[torch.Tensor, torch.Tensor], ppo.Parts]:
    """The gradients by hand, compared with those that torch finds of the loss, and the loss."""
    found = ppo.gradients(outputs, values, batch, coefficients, heads=heads)
    outputs.requires_grad_()
    values.requires_grad_()
    parts = ppo.loss(outputs, values, batch, coefficients, heads=heads)
    parts.total_loss.sum().backward()  # type: ignore[no-untyped-call]
    for mine, other in zip(found, (outputs.grad, values.grad), strict=True):
        close(mine, other)
    return found, parts


@pytest.mark.usefixtures("in_double")
@pytest.mark.parametrize("with_old_values", [False, True])
@pytest.mark.parametrize("with_kl", [False, True])
@pytest.mark.parametrize("sizes", [(2,), (3,), (6,), (2, 2), (3, 1, 4)], ids=str)
def test_gradients_by_hand_are_those_of_the_loss(sizes: tuple[int, ...], with_kl: bool, with_old_values: bool) -> None:
    outputs, values, batch = make_case(*sizes, with_kl=with_kl, with_old_values=with_old_values)
    heads = ppo.Heads(sizes)
    ratio = (ppo.log_probabilities(outputs, batch.actions, heads=heads) - batch.logp).exp()
    for limited in (ratio > 1.3, ratio < 0.7):
        for sign in (-1, 1):
            # Clipped and not clipped, on both sides.
            assert (limited & (sign * batch.advantages > 0)).sum() > M * B / 20
    errors = (values - batch.value_targets) ** 2
    assert 0.1 < (errors > COEFFICIENTS.vf_clip_param).float().mean() < 0.9
    _, parts = checked_gradients(outputs, values, batch, COEFFICIENTS, heads)
    assert (parts.kl > 0).all() == with_kl


@pytest.mark.usefixtures("in_double")
@pytest.mark.parametrize("with_old_values", [False, True])
@pytest.mark.parametrize("with_kl", [False, True])
@pytest.mark.parametrize("num_actions", [1, 3])
def test_gradients_by_hand_of_continuous_actions_are_those_of_the_loss(
    num_actions: int, with_kl: bool, with_old_values: bool
) -> None:
    outputs, values, batch = make_case(num_actions, num_actions, with_kl=False, with_old_values=with_old_values)
    heads = ppo.Heads(())
    # Of some rows, standard deviations beyond both limits.
    outputs[..., num_actions:] *= 0.25
    outputs[:, :5, num_actions:] = -21.0
    outputs[:, 5:10, num_actions:] = 21.0
    rng = torch.Generator().manual_seed(1)
    old_outputs = outputs + 0.2 * torch.randn(outputs.shape, generator=rng)
    # Were these drawn by others, their ratios would be 0 or infinite.
    old_outputs[:, :10] = outputs[:, :10]
    mean, log_std = old_outputs.chunk(2, dim=-1)
    batch.actions = mean + log_std.clamp(-20.0, 20.0).exp() * torch.randn(mean.shape, generator=rng)
    batch.logp = ppo.log_probabilities(old_outputs, batch.actions, heads=heads)
    batch.old_outputs = old_outputs if with_kl else None
    ratio = (ppo.log_probabilities(outputs, batch.actions, heads=heads) - batch.logp).exp()
    for limited in (ratio > 1.3, ratio < 0.7):
        for sign in (-1, 1):
            assert (limited & (sign * batch.advantages > 0)).sum() > M * B / 50
    found, parts = checked_gradients(outputs, values, batch, COEFFICIENTS, heads)
    assert (found[0][:, :10, num_actions:] == 0).all()
    assert (found[0][:, 10:, num_actions:] != 0).any(dim=-1).sum() > M * B / 2
    assert (parts.kl > 0).all() == with_kl


@pytest.mark.usefixtures("in_double")
@pytest.mark.parametrize("entropy_coeff", [0.0, 0.01])
def test_gradients_without_a_value_clip(entropy_coeff: float) -> None:
    outputs, values, batch = make_case(2, with_kl=False)
    coefficients = replace(
        COEFFICIENTS, vf_clip_param=column(*[math.inf] * M), entropy_coeff=column(*[entropy_coeff] * M)
    )
    checked_gradients(outputs, values, batch, coefficients, ppo.Heads((2,)))


def by_definition(values: torch.Tensor, old_values: torch.Tensor, targets: torch.Tensor, limit: float) -> torch.Tensor:
    """PPO2's squared value error, row by row."""
    rows = []
    for value, old, target in zip(values.tolist(), old_values.tolist(), targets.tolist(), strict=True):
        limited = min(max(value, old - limit), old + limit)
        rows.append(max((value - target) ** 2, (limited - target) ** 2))
    return torch.tensor(rows)


@pytest.mark.usefixtures("in_double")
def test_the_larger_of_both_value_errors_counts() -> None:
    outputs, values, batch = make_case(2, with_kl=False, with_old_values=True)
    assert batch.old_values is not None
    found = ppo.loss(outputs, values, batch, COEFFICIENTS, heads=ppo.Heads((2,))).vf_loss
    no_range = ppo.loss(outputs, values, replace(batch, old_values=None), COEFFICIENTS, heads=ppo.Heads((2,))).vf_loss
    for index in range(M):
        limit = float(COEFFICIENTS.vf_clip_range[index])
        rows = by_definition(values[index], batch.old_values[index], batch.value_targets[index], limit)
        close(found[index], rows.clamp(max=float(COEFFICIENTS.vf_clip_param[index])).mean())
        assert (found[index] > no_range[index]) == math.isfinite(limit)


@pytest.mark.parametrize("is_gaussian", [False, True])
def test_a_member_without_a_range_of_values_learns_to_the_bit_as_if_no_other_had_one(is_gaussian: bool) -> None:
    outputs, values, batch = make_case(4, with_kl=False, with_old_values=True)
    if is_gaussian:
        batch.actions = batch.actions[..., :2]
    beside, alone = (
        ppo.gradients(outputs, values, rows, COEFFICIENTS, heads=ppo.Heads(() if is_gaussian else (4,)))
        for rows in (batch, replace(batch, old_values=None))
    )
    assert torch.equal(beside[1][1], alone[1][1])
    assert not torch.equal(beside[1], alone[1])
    losses = [
        ppo.loss(outputs, values, rows, COEFFICIENTS, heads=ppo.Heads(() if is_gaussian else (4,))).vf_loss[1]
        for rows in (batch, replace(batch, old_values=None))
    ]
    assert torch.equal(*losses)


@pytest.mark.parametrize("is_gaussian", [False, True])
@pytest.mark.parametrize("name", ["advantages", "value_targets"])
def test_what_is_no_number_reaches_its_members_gradient_and_no_other(name: str, is_gaussian: bool) -> None:
    outputs, values, batch = make_case(4, with_kl=False, with_old_values=True)
    if is_gaussian:
        batch.actions = batch.actions[..., :2]
    getattr(batch, name)[1, 7] = math.nan
    found = ppo.gradients(outputs, values, batch, COEFFICIENTS, heads=ppo.Heads(() if is_gaussian else (4,)))
    gradient = found[0 if name == "advantages" else 1]
    assert gradient[1, 7].isnan().all()
    assert gradient[[0, 2, 3]].isfinite().all()


@pytest.mark.usefixtures("in_double")
def test_ratios_begin_at_one() -> None:
    outputs, values, batch = make_case(3, with_kl=True)
    batch.logp = ppo.log_probabilities(outputs, batch.actions, heads=ppo.Heads((3,)))
    batch.old_outputs = outputs
    parts = ppo.loss(outputs, values, batch, COEFFICIENTS, heads=ppo.Heads((3,)))
    close(parts.policy_loss, -batch.advantages.mean(dim=1))
    close(parts.kl, torch.zeros(M))


# -- advantages


def test_no_advantage_flows_back_over_an_end() -> None:
    """Two sub-environments of other discounts; the first one's episodes end in steps 1 (truncated) and 3."""
    rewards = np.array([[1, 1], [2, 1], [3, 1], [4, 1]], dtype=np.float32)
    values = np.array([[10, 0], [20, 0], [30, 0], [40, 0]], dtype=np.float32)
    next_values = np.array([[20, 0], [25, 0], [40, 0], [99, 7]], dtype=np.float32)
    terminated, ended = np.zeros((4, 2), dtype=bool), np.zeros((4, 2), dtype=bool)
    terminated[3, 0] = ended[1, 0] = ended[3, 0] = True
    # Powers of two, and whole numbers: no result is rounded.
    gamma, gae_lambda = np.array([0.5, 1.0], dtype=np.float32), np.array([0.25, 0.5], dtype=np.float32)
    advantages, targets = advantages_and_targets(
        rewards, values, next_values, terminated=terminated, ended=ended, gamma=gamma, gae_lambda=gae_lambda
    )
    last = 4 - 40
    second = 2 + 0.5 * 25 - 20  # bootstrapped from what the cut episode would have gone on with
    first = [1 + 0.5 * 20 - 10 + 0.125 * second, second, 3 + 0.5 * 40 - 30 + 0.125 * last, last]
    other = 1 + 7.0
    np.testing.assert_array_equal(advantages[:, 0], first)
    np.testing.assert_array_equal(advantages[:, 1], [1.75 + other / 8, 1.5 + other / 4, 1 + other / 2, other])
    np.testing.assert_array_equal(targets, advantages + values)


def test_advantages_are_standardised_member_by_member() -> None:
    rng = np.random.default_rng(0)
    rows = (rng.normal(size=(3, 50)) * [[1.0], [100.0], [1e-6]] + [[5.0], [0.0], [1.0]]).astype(np.float32)
    out = standardise(rows)
    # The mean of 50 is a sum of 50 roundings at most; what is divided by is 1, 100, and 1e-4: the least that is.
    exact = rows.astype(np.float64)
    mean, std = exact.mean(axis=1, keepdims=True), np.maximum(exact.std(axis=1, keepdims=True), 1e-4)
    sizes = (np.abs(exact) + np.abs(exact).mean(axis=1, keepdims=True)) / std
    # Of a deviation's square twice as many, and it moves the result by its share.
    sizes = sizes * (1 + 2 * np.abs(exact - mean) / std)
    assert_rounded(out, (exact - mean) / std, sizes=sizes, num_roundings=60)
    # Those that hardly differ are not blown up.
    assert out[2].std() < 0.1


# -- episodes


class Loops:
    """What the tracker does, step by step."""

    def __init__(self, member_ids: Sequence[str], num_envs: int) -> None:
        self.running = {name: [[0.0, 0] for _ in range(num_envs)] for name in member_ids}

    def follow(
        self, member_ids: Sequence[str], rewards: NDArray[np.float32], ended: NDArray[np.bool_]
    ) -> list[list[tuple[float, int]]]:
        found: dict[str, list[Any]] = {name: [] for name in member_ids}
        for step in range(len(rewards)):
            row = 0
            for name in member_ids:
                for stream in self.running[name]:
                    stream[0] += float(rewards[step, row])
                    stream[1] += 1
                    if ended[step, row]:
                        found[name].append(tuple(stream))
                        stream[:] = [0.0, 0]
                    row += 1
        return [found[name] for name in member_ids]


def test_episodes_go_on_over_fragments_and_changes_of_the_pack() -> None:
    rng = np.random.default_rng(0)
    num_envs, names = 3, ["a", "b", "c"]
    tracker, loops = EpisodeTracker(), Loops([*names, "d"], num_envs)
    for name in names:
        tracker.add(name, num_envs)
    for order, num_steps in ((["a", "b", "c"], 20), (["c", "a", "b"], 7), (["b", "c"], 1), (["d", "c", "b"], 30)):
        for name in {"a", "b", "c"} - set(order):
            if name in names:
                tracker.remove(name)
                names.remove(name)
        if "d" in order:
            tracker.add("d", num_envs)
        rewards = rng.normal(size=(num_steps, len(order) * num_envs)).astype(np.float32)
        ended = rng.random(rewards.shape) < 0.2
        found = tracker.follow(order, rewards, ended)
        expected = loops.follow(order, rewards, ended)
        assert sum(map(len, expected)) > 0 or num_steps == 1
        for ours, theirs in zip(found, expected, strict=True):
            assert [length for _, length in ours] == [length for _, length in theirs]
            # In float64, of fewer than 60 rewards below 10 in size: 60 roundings of 600 are below 1e-11.
            np.testing.assert_allclose([r for r, _ in ours], [r for r, _ in theirs], rtol=0, atol=1e-9)


# -- observations and actions


class Statistics(ObservationStatistics, nn.Module):
    def __init__(self, size: int) -> None:
        super().__init__()
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.model_config = {"normalize_observations": True}
        self.add_statistics()


def test_observations_are_normalised_as_rlmodules_do_it() -> None:
    rng = np.random.default_rng(0)
    num_envs, size = 2, 3
    members = [random_member(f"m{index}", normalize_observations=True) for index in range(3)]
    for member in members:
        member.weights |= {
            OBS_MEAN: np.zeros(size, np.float32), OBS_VAR: np.ones(size, np.float32), OBS_COUNT: np.array(0)
        }  # fmt: skip
    references = [Statistics(size) for _ in members]
    observations = Observations(members, num_envs, normalizes=True, seen=Inputs.vector(size))
    for num_steps in (1, 5, 40):
        drawn = rng.normal(size=(num_steps, len(members) * num_envs, size)) * [1e-3, 1.0, 100.0] + [0.0, 5.0, 300.0]
        rows = drawn.astype(np.float32)
        rows[-1, :, 0] = 1e3 * num_steps**2  # far outside
        prepared = observations.prepare(rows)
        assert prepared.shape == (num_steps, len(members), num_envs, size)
        np.testing.assert_array_equal(observations.prepare(rows[0]), prepared[0])
        np.testing.assert_array_equal(observations.part(1, 3).prepare(rows[:, num_envs:]), prepared[:, 1:])
        observations.learn(rows)
        for index, reference in enumerate(references):
            own = rows[:, index * num_envs : (index + 1) * num_envs]
            expected = reference.prepare(torch.from_numpy(own)).numpy()
            np.testing.assert_allclose(prepared[:, index], expected, rtol=1e-5, atol=1e-5)
            assert np.abs(prepared[:, index]).max() == 10.0
            reference.update_observation_statistics(own.reshape(-1, size))
            for name, value in members[index].weights.items():
                if name in (OBS_MEAN, OBS_VAR, OBS_COUNT):
                    known = reference.state_dict()[name].numpy()
                    assert value.dtype == known.dtype
                    assert value.shape == known.shape
                    np.testing.assert_allclose(value, known, rtol=1e-6)


def test_observations_as_they_are() -> None:
    members = [random_member(f"m{index}") for index in range(2)]
    rows = np.arange(2 * 3 * 4, dtype=np.float32).reshape(6, 4)
    observations = Observations(members, 3, normalizes=False, seen=Inputs.vector(4))
    np.testing.assert_array_equal(observations.prepare(rows), rows.reshape(2, 3, 4))
    observations.learn(rows[None])
    assert OBS_MEAN not in members[0].weights


def test_one_hot() -> None:
    np.testing.assert_array_equal(one_hot(np.array([[2, 0]]), 3), [[[0, 0, 1], [1, 0, 0]]])
