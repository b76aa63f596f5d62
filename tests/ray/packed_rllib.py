"""One batch of a pack, learnt from by the pack and by RLlib's own Learner, member by member."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike, NDArray

from policies.envs.make import make_env
from policies.hyperparams import PPOHyperparams
from policies.packed.envs.vector import EnvKind
from policies.packed.member import Member, MemberStats, Weights
from policies.packed.ppo.group import Batch, PPOGroup

if TYPE_CHECKING:
    from policies.packed.ppo.stack import Fragment, PPOStack

MODULE = "default_policy"
PPOMember = Member[PPOHyperparams]
ROWS = 64
# A share of the largest value. A gradient is a sum over the rows of what came through three layers of 8 at most: 64 and
# 3 * 10 roundings in the pack and as many in RLlib, each of half an eps (6e-8); the updates after the first start apart
# by that, which is as much again. A hyperparameter that acts otherwise moves gradients by more than a thousandth.
ROUNDING = 4 * (ROWS + 30) * 6e-8
SMALL: dict[str, Any] = {
    "hidden_sizes": (8,),
    "train_batch_size": ROWS,
    "minibatch_size": ROWS,
    "num_epochs": 1,
    "num_envs": 4,
}


def make_stack(
    env_id: str,
    members: Sequence[dict[str, Any]],
    env_args: dict[str, Any] | None = None,
    seeds: Sequence[int] | None = None,
) -> PPOStack:
    """A stack of PPO members from a few hyperparameters each, fresh."""
    from policies.packed.envs.make import make_packed_envs
    from policies.packed.initial import new_member
    from policies.packed.make import make_stack as make

    settings = [PPOHyperparams(**{**SMALL, **values}) for values in members]
    kind: EnvKind = "vectorised" if env_id == "CartPole-v1" else "scalar"
    envs = make_packed_envs(env_id, env_args or {}, settings[0].num_envs, kind=kind)
    stack = cast("PPOStack", make(settings[0], envs))
    seeds = range(len(settings)) if seeds is None else seeds
    for index, (hyperparams, seed) in enumerate(zip(settings, seeds, strict=True)):
        member = new_member(f"m{index}", hyperparams, seed, envs.observation_space, envs.action_space)
        stack.add(member, seed)
    return stack


def kept(member: PPOMember) -> PPOMember:
    """A member as it is now."""
    return copy.deepcopy(member)


@dataclass
class Sampled:
    """A batch of a whole stack, and its parts."""

    fragment: Fragment
    groups: list[tuple[PPOGroup, Batch]]
    """(group, its batch)."""
    observations: NDArray[Any]
    """As the envs gave them, (M, R, ...)."""


def sample(stack: PPOStack) -> Sampled:
    """What the next iteration would learn from."""
    if stack._stale:
        stack._regroup()
    num_envs = stack.envs.num_envs
    fragment = stack._sample(stack.members[0].hyperparams.train_batch_size // num_envs)
    groups, start = [], 0
    for group in stack._groups:
        stop = start + len(group.members)
        groups.append((group, stack._batch(group, fragment, start, stop)))
        start = stop
    steps, _, size = fragment.observations.shape
    observations = fragment.observations.reshape(steps, len(stack.members), num_envs, size).swapaxes(0, 1)
    shape = stack.envs.observation_space.shape or ()
    return Sampled(fragment, groups, observations.reshape(len(stack.members), -1, *shape))


def shake(stack: PPOStack, scale: float = 0.1) -> None:
    """Move all weights a little, so that ratios and divergences are not those of the policy that has sampled."""
    for member in list(stack.members):
        stack.member(member.member_id)
        rng = np.random.default_rng(member.seed)
        for name, value in member.weights.items():
            if not name.startswith("obs_"):
                moved = scale * rng.normal(size=value.shape)
                if name == "pi.weight" and member.hyperparams.free_log_std:
                    moved[len(moved) // 2 :] = 0.0
                np.add(value, moved, out=value, casting="unsafe")
    stack._stale = True


@dataclass
class Learned:
    """What one learning phase of a member gave; `last_gradients` are those of its last update, clipped."""

    losses: dict[str, float]
    last_gradients: Weights
    weights: Weights
    moments: dict[str, Weights]
    kl_coeff: float


def learn_in_pack(stack: PPOStack, sampled: Sampled) -> dict[str, Learned]:
    """Learn, and give what became of each member, by id."""
    stack._regroup()
    found = {}
    for group, (old, batch) in zip(stack._groups, sampled.groups, strict=True):
        assert [m.member_id for m in group.members] == [m.member_id for m in old.members]
        group.learn(batch)
        stats = group.finish()
        group.write_back()
        views = group._networks.views_of(group._networks.gradients)
        for index, member in enumerate(group.members):
            gradients: Weights = {}
            for number, layout in enumerate(group._rows._layouts[index]):
                row = number * len(group.members) + index
                gradients |= layout.read([layer[row] for layer in views], stack._num_inputs)
            found[member.member_id] = Learned(
                stats[index], gradients, dict(member.weights), copy.deepcopy(member.moments), member.kl_coeff
            )
    stack._observations.learn(sampled.fragment.observations)
    for member in stack.members:
        found[member.member_id].weights = copy.deepcopy(member.weights)
    return found


def parts_of(sampled: Sampled, member: PPOMember) -> tuple[int, Batch, NDArray[Any]]:
    """(place in its group, batch of the group, observations) of a member."""
    place = 0
    for group, batch in sampled.groups:
        for index, other in enumerate(group.members):
            if other.member_id == member.member_id:
                return index, batch, sampled.observations[place]
            place += 1
    raise KeyError(member.member_id)


def rllib_batch(sampled: Sampled, member: PPOMember, *, sizes: tuple[int, ...], is_one_choice: bool) -> Any:
    """The member's rows as RLlib's connectors would hand them to the Learner."""
    from ray.rllib.policy.sample_batch import MultiAgentBatch, SampleBatch

    index, batch, observations = parts_of(sampled, member)
    actions = torch.from_numpy(batch.actions[index])
    outputs = torch.from_numpy(batch.outputs[index])
    if not sizes:
        mean, log_std = outputs.chunk(2, dim=-1)
        logp = torch.distributions.Normal(mean, log_std.exp()).log_prob(actions).sum(dim=-1)  # type: ignore[no-untyped-call]
    else:
        chosen = [part.argmax(dim=-1) for part in actions.split(sizes, dim=-1)]  # type: ignore[no-untyped-call]
        each = [torch.distributions.Categorical(logits=part) for part in outputs.split(sizes, dim=-1)]  # type: ignore[no-untyped-call]
        logp = torch.stack([one.log_prob(value) for one, value in zip(each, chosen, strict=True)]).sum(dim=0)  # type: ignore[no-untyped-call]
        actions = chosen[0] if is_one_choice else torch.stack(chosen, dim=-1)
    columns = {
        "obs": torch.from_numpy(observations.copy()),
        "actions": actions,
        "action_logp": logp,
        "action_dist_inputs": outputs,
        "advantages": torch.from_numpy(batch.advantages[index].copy()),
        "value_targets": torch.from_numpy(batch.value_targets[index].copy()),
        "loss_mask": torch.ones(len(logp), dtype=torch.bool),
    }
    if batch.values is not None:
        columns["vf_preds"] = torch.from_numpy(batch.values[index].copy())
    return MultiAgentBatch({MODULE: SampleBatch(columns)}, env_steps=len(logp))


def learner_of(algorithm: Any) -> Any:
    return algorithm.learner_group._learner


def state_of(learner: Any) -> tuple[Weights, dict[str, Weights]]:
    """(weights, optimizer's moments by name) of a Learner."""
    module = learner.module[MODULE].unwrapped()
    weights = {name: value.numpy().copy() for name, value in module.state_dict().items()}
    (_, optimizer), *others = learner.get_optimizers_for_module(MODULE)
    assert not others
    moments: dict[str, Weights] = {}
    for name, param in module.named_parameters():
        for moment, value in optimizer.state.get(param, {}).items():
            moments.setdefault(moment, {})[name] = value.numpy().copy()
    return weights, moments


def learn_in_rllib(member: PPOMember, env_id: str, batch: Any) -> Learned:
    """The same with RLlib's Learner, from the same weights and moments; its own `update` does all."""
    from policies.packed.to_rllib import to_algorithm

    algorithm = to_algorithm(member, env_id=env_id, env_args={})
    learner = learner_of(algorithm)
    module, applied = learner.module[MODULE].unwrapped(), []
    apply_gradients = learner.apply_gradients

    def applying(gradients: dict[Any, torch.Tensor]) -> None:
        applied.append({id(learner._params[reference]): value.clone() for reference, value in gradients.items()})
        apply_gradients(gradients)

    learner.apply_gradients = applying
    metrics = learner.update(
        batch=batch,
        timesteps={"num_env_steps_sampled_lifetime": member.num_env_steps},
        minibatch_size=member.hyperparams.minibatch_size,
        num_epochs=member.hyperparams.num_epochs,
    )
    assert len(applied) == member.hyperparams.num_epochs
    losses = {name: float(value.peek()) for name, value in metrics[MODULE].items()}
    gradients = {name: applied[-1][id(param)].numpy() for name, param in module.named_parameters()}
    weights, moments = state_of(learner)
    learned = Learned(losses, gradients, weights, moments, float(learner.curr_kl_coeffs_per_module[MODULE]))
    algorithm.stop()
    return learned


LOSSES = {
    "total_loss": "total_loss",
    "policy_loss": "policy_loss",
    "vf_loss": "vf_loss",
    "entropy": "entropy",
    "kl": "mean_kl_loss",
    "lr": "default_optimizer_learning_rate",
    "gradient_norm": "gradients_default_optimizer_global_norm",
}
"""A pack's name -> RLlib's."""


def difference(ours: ArrayLike, theirs: ArrayLike) -> float:
    """The largest, relative to what is larger of 1 and the largest value."""
    ours, theirs = np.asarray(ours, dtype=np.float64), np.asarray(theirs, dtype=np.float64)
    return float(np.abs(ours - theirs).max() / max(1.0, np.abs(theirs).max()))


def differences(ours: Learned, theirs: Learned) -> dict[str, float]:
    """Of losses, gradients, weights, moments and the KL weight."""
    assert set(ours.weights) == set(theirs.weights)
    assert set(ours.last_gradients) == set(theirs.last_gradients)
    assert {name: set(found) for name, found in ours.moments.items()} == {
        name: set(found) for name, found in theirs.moments.items() if name != "step"
    }
    scale = max(np.abs(value).max() for value in theirs.last_gradients.values())
    assert scale > 0
    assert set(ours.losses) >= {"total_loss", "policy_loss", "vf_loss", "entropy", "lr"}
    return {
        "losses": max(difference(value, theirs.losses[LOSSES[name]]) for name, value in ours.losses.items()),
        # Relative to the largest: a small loss has small gradients.
        "gradients": max(
            np.abs(value - theirs.last_gradients[name]).max() / scale for name, value in ours.last_gradients.items()
        ),
        "weights": max(difference(value, theirs.weights[name]) for name, value in ours.weights.items()),
        "moments": max(
            difference(value, theirs.moments[moment][name])
            for moment, found in ours.moments.items()
            for name, value in found.items()
        ),
        "kl_coeff": difference(ours.kl_coeff, theirs.kl_coeff),
    }


def compare(
    env_id: str,
    members: Sequence[dict[str, Any]],
    *,
    seeds: Sequence[int] | None = None,
    num_epochs: int = 1,
    before: Callable[[PPOStack], None] | None = None,
) -> tuple[list[tuple[Learned, Learned]], PPOStack, Sampled]:
    """Sample once, learn in the pack and in RLlib.

    Args:
        env_id: CartPole or another.
        members: Hyperparameters of each, beside `SMALL`.
        seeds: Of each.
        num_epochs: Updates, on all rows each.
        before: Called with the stack before it samples.

    Returns:
        For each member (the pack's, RLlib's), the stack and what it had sampled.
    """
    stack = make_stack(env_id, [{**values, "num_epochs": num_epochs} for values in members], seeds=seeds)
    # The optimizers have moments then, observation statistics something in them, and some env steps are counted.
    stack.train_iteration()
    if before is not None:
        before(stack)
    sampled = sample(stack)
    shake(stack)
    for member in stack.members:
        member.num_env_steps += ROWS
    old = {member.member_id: kept(member) for member in stack.members}
    ours = learn_in_pack(stack, sampled)
    pairs = []
    for name in sorted(old):
        batch = rllib_batch(sampled, old[name], sizes=stack._heads.sizes, is_one_choice=stack._is_one_choice)
        pairs.append((ours[name], learn_in_rllib(old[name], env_id, batch)))
        assert np.abs(ours[name].weights["pi.weight"] - old[name].weights["pi.weight"]).max() > 1e-5
    stack.envs.close()
    return pairs, stack, sampled


def assert_same_stats(ours: MemberStats, theirs: MemberStats) -> None:
    """But for the last bits: two rows of one product may lie at other places of a vector register."""
    assert (ours.num_env_steps, ours.episodes) == (theirs.num_env_steps, theirs.episodes)
    assert ours.learner == pytest.approx(theirs.learner, rel=1e-4, abs=1e-5)


def episodes_of(fragment: Fragment, row: int, env_id: str, final: NDArray[np.float32]) -> list[Any]:
    """The chunks of one row of a fragment as RLlib's episodes; `final` stands for what terminated episodes ended in."""
    from ray.rllib.env.single_agent_episode import SingleAgentEpisode

    env = make_env(env_id, {})
    cuts = {step: seen for step, place, seen in fragment.cuts if place == row}
    ends = [step + 1 for step in np.flatnonzero(fragment.ended[:, row]).tolist()]
    bounds = [0, *ends, *([len(fragment.ended)] if not ends or ends[-1] < len(fragment.ended) else [])]
    episodes = []
    for start, stop in itertools.pairwise(bounds):
        terminated = bool(fragment.terminated[stop - 1, row])
        truncated = stop - 1 in cuts
        after = final if terminated else cuts[stop - 1] if truncated else fragment.last[row]
        length = stop - start
        outputs = fragment.outputs[start:stop, row]
        episodes.append(
            SingleAgentEpisode(
                observations=[*fragment.observations[start:stop, row], after],
                actions=list(fragment.actions[start:stop, row]),
                rewards=fragment.rewards[start:stop, row].tolist(),
                terminated=terminated,
                truncated=truncated,
                extra_model_outputs={"action_logp": [0.0] * length, "action_dist_inputs": list(outputs)},
                observation_space=env.observation_space,
                action_space=env.action_space,
                len_lookback_buffer=0,
            ).to_numpy()
        )
    env.close()  # type: ignore[no-untyped-call]
    return episodes
