"""Training phases of a DQN pack, and the same ones by RLlib's own Learner, member by member."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray
from packed_rllib import MODULE, difference, learner_of, state_of

from policies.hyperparams import DQNHyperparams
from policies.packed.dqn import loss as dqn
from policies.packed.dqn.group import Batch, DQNGroup
from policies.packed.dqn.replay import Drawn, Indices
from policies.packed.envs.vector import EnvKind
from policies.packed.inputs import Inputs
from policies.packed.member import Member, Weights
from policies.replay import Transitions

if TYPE_CHECKING:
    from policies.packed.dqn.stack import DQNStack

SMALL: dict[str, Any] = {
    "hidden_sizes": (8,),
    "num_envs": 4,
    "env_steps_per_iteration": 64,
    "learning_starts": 32,
    "train_batch_size": 16,
    "train_freq": 4,
    "updates_per_env_step": 0.5,
    "replay_capacity": 500,
    "epsilon_decay": 200,
}
DQNMember = Member[DQNHyperparams]
Phases = Sequence[tuple[int, int, int]]
# As in `packed_rllib`: of nine updates, each on 16 rows, whose differences add up.
ROUNDING = 9 * (16 + 30) * 6e-8
PHASES: Phases = ((3, 16, 1), (4, 16, 2), (2, 8, 1))
"""(updates, env steps since the phase before, episodes that ended in them)."""


def make_stack(
    env_id: str = "CartPole-v1",
    env_args: dict[str, Any] | None = None,
    failure_penalty: float | None = None,
    **shared: Any,
) -> DQNStack:
    """A stack without members."""
    from policies.packed.envs.make import make_packed_envs
    from policies.packed.make import make_stack as make

    torch.set_num_threads(1)  # as the engine does
    hyperparams = DQNHyperparams(**{**SMALL, **shared})
    kind: EnvKind = "vectorised" if env_id == "CartPole-v1" else "scalar"
    envs = make_packed_envs(env_id, env_args or {}, hyperparams.num_envs, kind=kind, failure_penalty=failure_penalty)
    return cast("DQNStack", make(hyperparams, envs))


def add(stack: DQNStack, name: str, seed: int, member: DQNMember | None = None, **values: Any) -> DQNMember:
    """A further member; a new one from a few hyperparameters if there is none."""
    from policies.packed.initial import new_member

    if member is None:
        hyperparams = DQNHyperparams(**{**SMALL, **values})
        member = new_member(name, hyperparams, seed, stack.envs.observation_space, stack.envs.action_space)
    stack.add(member, seed)
    return member


def shake(stack: DQNStack, scale: float = 0.3) -> None:
    """Move all weights, so that target networks differ from the online ones by much."""
    for member in list(stack.members):
        stack.member(member.member_id)
        rng = np.random.default_rng(member.seed)
        for name, value in member.weights.items():
            if not name.startswith("obs_"):
                np.add(value, scale * rng.normal(size=value.shape), out=value, casting="unsafe")
    stack._arrange()


def add_noise_rows(stack: DQNStack, gamma: float = 0.9) -> None:
    """Transitions with rewards of all sizes and discounts of one to three steps, the same for all members."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(100, stack._replay.num_columns)).astype(np.float32)
    seen, num_masked = stack._seen, stack._num_masked
    middle, num_observed = seen.num_columns, seen.num_observed
    if seen.is_bytes:
        for start in (0, middle):
            seen.put(rows[:, start : start + middle], rng.integers(0, 256, (100, num_observed)))
    else:
        rows[:, [num_observed, -4]] = 1.0
    rows[:, -3] = rng.integers(0, stack._num_actions, 100)
    if num_masked:
        for start in (0, num_observed + 1):
            masks = rng.integers(0, 2, (100, num_masked))
            # What was done was allowed, and something is in each state.
            masks[np.arange(100), rows[:, -3].astype(int) if start == 0 else rng.integers(num_masked, size=100)] = 1
            rows[:, start : start + num_masked] = masks
    rows[:, -2] *= 3.0
    rows[:, -1] = gamma ** rng.integers(1, 4, 100) * (rng.random(100) < 0.7)
    slots = stack._replay.slots([member.member_id for member in stack.members])
    stack._replay.add(slots, np.broadcast_to(rows, (len(slots), *rows.shape)))


@dataclass
class Learned:
    """What a member's updates gave, one after another."""

    losses: list[float] = field(default_factory=list)
    td_errors: list[NDArray[np.float32]] = field(default_factory=list)
    """Without sign, (B,) each."""
    gradients: list[Weights] = field(default_factory=list)
    """By weight, clipped."""
    weights: list[Weights] = field(default_factory=list)
    """After each update and the target update that may follow it."""
    moments: dict[str, Weights] = field(default_factory=dict)
    """After the last one."""
    lrs: list[float] = field(default_factory=list)
    num_target_updates: int = 0
    batches: list[Transitions] = field(default_factory=list)


def read_gradients(group: DQNGroup, index: int) -> Weights:
    views = group._networks.views_of(group._networks.gradients)
    (layout,) = group._rows._layouts[index]
    return layout.read([layer[index] for layer in views], group._num_inputs)


def as_transitions(rows: NDArray[np.float32], seen: Inputs, weights: NDArray[np.float32] | None) -> Transitions:
    def observed(start: int) -> NDArray[Any]:
        columns = rows[:, start : start + seen.num_columns]
        flat = seen.bytes_in(columns) if seen.is_bytes else columns[:, : seen.num_observed]
        # Images behind a mask are rows in RLlib, too.
        return flat.reshape(-1, *seen.shape) if seen.is_image and not seen.num_masked else flat

    return Transitions(
        obs=observed(0),
        actions=rows[:, -3].astype(np.int64),
        rewards=rows[:, -2],
        next_obs=observed(seen.num_columns),
        discounts=rows[:, -1],
        weights=weights,
    )


def follow(group: DQNGroup, found: dict[str, Learned]) -> contextlib.ExitStack:
    """Write down what each of a group's updates gives; returns what ends that."""
    stack = contextlib.ExitStack()
    update, move, gradient = group._update, group._update_targets, dqn.loss_gradient
    draw = group._replay.draw
    losses: list[dqn.Loss] = []
    raw: list[NDArray[np.float32]] = []

    def spied_gradient(*args: Any) -> dqn.Loss:
        losses.append(gradient(*args))
        return losses[-1]

    def spied_draw(slots: Indices, numbers: NDArray[np.float64]) -> Drawn:
        drawn = draw(slots, numbers)
        # As they are in the memory, before they are prepared in place.
        raw.extend(drawn.rows.copy().reshape(-1, *drawn.rows.shape[-3:]))
        return drawn

    def spied_update(batch: Batch, *, wants_stats: bool) -> list[dict[str, float]]:
        rows = raw.pop(0)
        stats = update(batch, wants_stats=True)
        for index, member in enumerate(group.members):
            one = found[member.member_id]
            weights = None if batch.weights is None else batch.weights[index].numpy().copy()
            one.batches.append(as_transitions(rows[index], group._seen, weights))
            one.losses.append(stats[index]["total_loss"])
            one.lrs.append(stats[index]["lr"])
            one.td_errors.append(losses[-1].td_errors[index].abs().numpy())
            one.gradients.append(read_gradients(group, index))
        return stats if wants_stats else []

    def spied_move(num_steps_after: float) -> None:
        move(num_steps_after)
        group.write_back()
        for member in group.members:
            found[member.member_id].weights.append(copy.deepcopy(member.weights))

    stack.enter_context(patch.object(dqn, "loss_gradient", spied_gradient))
    stack.enter_context(patch.object(group._replay, "draw", spied_draw))
    stack.enter_context(patch.object(group, "_update", spied_update))
    stack.enter_context(patch.object(group, "_update_targets", spied_move))
    return stack


def learn_in_pack(stack: DQNStack, phases: Phases = PHASES) -> dict[str, Learned]:
    """Some training phases of all members, with given numbers; by member."""
    rng = np.random.default_rng(1)
    found = {member.member_id: Learned() for member in stack.members}
    batch_size = stack.members[0].hyperparams.train_batch_size
    # The same numbers for all members.
    numbers = [rng.random((num_updates, 1, batch_size)) for num_updates, _, _ in phases]
    for drawn, (_, num_steps, num_episodes) in zip(numbers, phases, strict=True):
        for group in stack._groups:
            for member in group.members:
                member.num_env_steps += num_steps
                member.num_episodes += num_episodes
            with follow(group, found):
                group.learn(np.repeat(drawn, len(group.members), axis=1), num_steps, wants_stats=True)
    for member in stack.members:
        one = found[member.member_id]
        one.moments, one.num_target_updates = copy.deepcopy(member.moments), member.num_target_updates
    return found


class GivenBatches:
    """Stands in for a replay memory."""

    def __init__(self, batches: Sequence[Transitions]) -> None:
        self.rest = iter(batches)

    def batches(self, num_batches: int, batch_size: int) -> Iterator[Transitions]:
        for _ in range(num_batches):
            batch = next(self.rest)
            assert len(batch.obs) == batch_size
            yield batch


def learn_in_rllib(member: DQNMember, env_id: str, batches: Sequence[Transitions], phases: Phases = PHASES) -> Learned:
    """The same from the same weights and moments, by `DQNLearner`'s own `update_from_replay`."""
    from policies.packed.to_rllib import to_algorithm

    algorithm = to_algorithm(member, env_id=env_id, env_args={})
    learner, found, replay = learner_of(algorithm), Learned(), GivenBatches(batches)
    module = learner.module[MODULE].unwrapped()
    update, move = learner.update_from_transitions, learner._update_target

    def spied_update(rows: Transitions, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
        stats: dict[str, Any] = update(rows, optimizer)
        found.losses.append(float(stats["total_loss"]))
        found.td_errors.append(stats["td_errors"].numpy().copy())
        found.lrs.append(optimizer.param_groups[0]["lr"])
        found.gradients.append(
            {name: param.grad.numpy().copy() for name, param in module.named_parameters() if param.grad is not None}
        )
        return stats

    def spied_move(*args: Any) -> None:
        move(*args)
        found.weights.append(state_of(learner)[0])

    learner.update_from_transitions, learner._update_target = spied_update, spied_move
    num_env_steps, num_episodes = member.num_env_steps, member.num_episodes
    for num_updates, num_steps, new_episodes in phases:
        num_env_steps, num_episodes = num_env_steps + num_steps, num_episodes + new_episodes
        learner.update_from_replay(
            replay, num_updates, num_env_steps=num_env_steps, num_new_steps=num_steps, num_episodes=num_episodes
        )
    found.moments, found.num_target_updates = state_of(learner)[1], learner.num_target_updates
    algorithm.stop()
    return found


def compare(
    members: Sequence[dict[str, Any]],
    *,
    seeds: Sequence[int] | None = None,
    env_id: str = "CartPole-v1",
    phases: Phases = PHASES,
    only: Sequence[int] | None = None,
) -> tuple[list[tuple[Learned, Learned | None]], DQNStack]:
    """Learn in the pack and in RLlib, after two iterations of the pack.

    Args:
        members: Hyperparameters of each, beside `SMALL`.
        seeds: Of each.
        env_id: CartPole or another.
        phases: The training phases.
        only: Indices of the members that RLlib trains too; None: all.

    Returns:
        For each member (the pack's, RLlib's or None), and the stack.
    """
    stack = make_stack(env_id, **members[0])
    for index, values in enumerate(members):
        add(stack, f"m{index}", index if seeds is None else seeds[index], **values)
    for _ in range(2):
        stack.train_iteration()
    assert all(member.num_updates for member in stack.members)
    add_noise_rows(stack)
    shake(stack)
    old = {member.member_id: copy.deepcopy(member) for member in stack.members}
    ours = learn_in_pack(stack, phases)
    stack.envs.close()
    pairs = []
    for index in range(len(members)):
        found = ours[f"m{index}"]
        is_wanted = only is None or index in only
        theirs = learn_in_rllib(old[f"m{index}"], env_id, found.batches, phases) if is_wanted else None
        pairs.append((found, theirs))
    return pairs, stack


def differences(ours: Learned, theirs: Learned) -> dict[str, float]:
    """The largest of each kind over all updates, relative to what is large of its kind."""
    num_updates = len(theirs.losses)
    assert num_updates == len(ours.losses) == len(ours.weights) == len(theirs.weights)
    assert {name for name in theirs.moments if name != "step"} == set(ours.moments)
    found = dict.fromkeys(("losses", "td_errors", "gradients", "weights", "moments", "lr"), 0.0)

    def note(what: str, value: float) -> None:
        found[what] = max(found[what], value)

    for update in range(num_updates):
        note("losses", difference(ours.losses[update], theirs.losses[update]))
        note("td_errors", difference(ours.td_errors[update], theirs.td_errors[update]))
        note("lr", abs(ours.lrs[update] / theirs.lrs[update] - 1))
        mine, other = ours.gradients[update], theirs.gradients[update]
        assert set(mine) == set(other)
        # Relative to the largest: a small loss has small gradients.
        scale = max(np.abs(value).max() for value in other.values())
        assert scale > 0
        note("gradients", max(np.abs(mine[name] - other[name]).max() for name in other) / scale)
        assert set(ours.weights[update]) == set(theirs.weights[update])
        for name, value in theirs.weights[update].items():
            note("weights", difference(ours.weights[update][name], value))
    for moment, values in theirs.moments.items():
        if moment != "step":
            assert set(ours.moments[moment]) == set(values)
            scale = max(np.abs(value).max() for value in values.values())
            for name, value in values.items():
                note("moments", np.abs(ours.moments[moment][name] - value).max() / scale)
    return found


def q_values_of(module: Any, observations: NDArray[np.float32]) -> Any:
    """Q by an RLModule."""
    with torch.no_grad():
        return module.compute_q_values({"obs": torch.from_numpy(observations)})["qf_preds"].numpy()
