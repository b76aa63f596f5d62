"""Train PPO for the members of a pack that share a tensor program: one vector of environments, one batched update.

Shapes: M members, T vector steps, N sub-environments per member, S = M * N rows, R = T * N, W numbers per observation
with its mask if there is one, D that networks see, A outputs of the policy.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from policies.acting.policy import largest_of_each
from policies.envs.action_bounds import ToBounds
from policies.envs.own_actions import sizes_of
from policies.hyperparams import PPOHyperparams
from policies.packed.envs.vector import PackedEnvs
from policies.packed.inputs import Inputs
from policies.packed.member import MAX_GROUP, Member, MemberStats, group_members
from policies.packed.networks import with_ones
from policies.packed.ppo.gae import advantages_and_targets, standardise
from policies.packed.ppo.group import Batch, PPOGroup
from policies.packed.ppo.loss import LOG_STD_CLIP, Heads
from policies.packed.sampling import Observations, mask_outputs, one_hot
from policies.packed.shared import SharedByPPO
from policies.packed.stack import Stack
from policies.return_statistics import discounted_returns

Floats = NDArray[np.float32]

_IMAGES_AT_ONCE = 64
"""The most images of each member whose values are computed at once."""


class Fragment:
    """The results of T vector steps, as columns of shape (T, S, ...)."""

    def __init__(self, num_steps: int, num_rows: int, seen: Inputs, num_outputs: int) -> None:
        shape = (num_steps, num_rows)
        self.observations: NDArray[Any] = np.empty((*shape, seen.num_observed), dtype=seen.dtype)
        self.outputs = np.empty((*shape, num_outputs), dtype=np.float32)
        self.actions: NDArray[Any] = np.empty(0)
        """Whole numbers, (T, S) or (T, S, choices), or continuous actions as drawn, (T, S, num_actions)."""
        self.rewards, self.own_rewards = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        """The rewards to learn from, normalised for members with `normalize_rewards`, and the env's own, (T, S)."""
        self.terminated, self.ended = np.empty(shape, dtype=np.bool_), np.empty(shape, dtype=np.bool_)
        """Where nothing that comes later counts, and where that or the episode was cut off, (T, S)."""
        self.own_ended = np.empty(shape, dtype=np.bool_)
        """Where the env's own episodes end, (T, S)."""
        self.cuts: list[tuple[int, int, NDArray[Any]]] = []
        """The step, the row and the last observation of each truncated episode."""
        self.last: NDArray[Any] = np.empty((num_rows, seen.num_observed), dtype=seen.dtype)
        """The observations that the next actions answer."""


class PPOStack(Stack[PPOHyperparams, PPOGroup, SharedByPPO]):
    """Trains the PPO members of a pack together; see `Stack`."""

    def __init__(self, shared: SharedByPPO, envs: PackedEnvs, device: str = "cpu") -> None:
        super().__init__(shared, envs, device)
        self._ended: list[tuple[tuple[float, int], ...]] = []
        self._returns: dict[str, NDArray[np.float64]] = {}
        """The discounted returns of running episodes, (N,), of members that normalise rewards."""
        self._has_gpu = device.startswith("cuda")
        self._stream = torch.cuda.Stream() if self._has_gpu else None  # type: ignore[no-untyped-call]
        space = envs.action_space
        self._heads = Heads(sizes_of(space))
        self._is_gaussian = self._heads.is_gaussian
        self._is_one_choice = isinstance(space, gym.spaces.Discrete)
        self._num_actions = sum(self._heads.sizes)
        """The values of all choices, or the components of continuous actions."""
        if isinstance(space, gym.spaces.Box):
            self._num_actions = math.prod(space.shape)
            self._to_bounds = ToBounds(space)
        self._num_outputs = self._num_actions * (2 if self._is_gaussian else 1)

    @override
    def _begin(self, member: Member[PPOHyperparams], max_env_steps: int | None) -> None:
        if member.hyperparams.normalize_rewards:
            self._returns[member.member_id] = np.zeros(self.envs.num_envs)

    @override
    def _forget(self, member_id: str) -> None:
        self._returns.pop(member_id, None)

    def _regroup(self) -> None:
        # What a call costs on a GPU hardly depends on how many members are in it. Of images a group keeps too much.
        is_one_call = self._has_gpu and not any(member.hyperparams.conv_filters for member in self.members)
        groups = group_members(self.members, len(self.members) if is_one_call else MAX_GROUP)
        self.members = [member for group in groups for member in group]
        self.envs.arrange([member.member_id for member in self.members])
        self._groups = [
            PPOGroup(
                group,
                self._shared,
                self._seen,
                self._num_outputs,
                heads=self._heads,
                num_envs=self.envs.num_envs,
                device=self._device,
            )
            for group in groups
        ]
        normalizes = self._shared.normalize_observations
        self._observations = Observations(self.members, self.envs.num_envs, normalizes=normalizes, seen=self._seen)
        self._stale = False

    def begin_iteration(self) -> None:
        """Sample a batch for each member and start the updates."""
        if self._stale:
            self._regroup()
        self._is_written = False
        num_steps = math.ceil(self._shared.train_batch_size / self.envs.num_envs)
        fragment = self._sample(num_steps)
        episodes = self._episodes.follow(
            [member.member_id for member in self.members], fragment.own_rewards, fragment.own_ended
        )
        for member, ended in zip(self.members, episodes, strict=True):
            member.num_env_steps += num_steps * self.envs.num_envs
            member.num_episodes += len(ended)
            member.num_iterations += 1
        start = 0
        with self._on_own_stream():
            for group in self._groups:
                stop = start + len(group.members)
                group.learn(self._batch(group, fragment, start, stop))
                start = stop
        self._observations.learn(fragment.observations)
        self._ended = episodes

    @override
    def finish_iteration(self) -> dict[str, MemberStats]:
        with self._on_own_stream():
            stats = [found for group in self._groups for found in group.finish()]
        return {
            member.member_id: MemberStats(member.num_env_steps, ended, found)
            for member, ended, found in zip(self.members, self._ended, stats, strict=True)
        }

    def _on_own_stream(self) -> AbstractContextManager[Any]:
        """Use this stack's own CUDA stream, so that a GPU shared with other stacks is waited for only for own work."""
        return contextlib.nullcontext() if self._stream is None else torch.cuda.stream(self._stream)

    def _sample(self, num_steps: int) -> Fragment:
        envs, num_members, num_envs = self.envs, len(self.members), self.envs.num_envs
        fragment = Fragment(num_steps, num_members * num_envs, self._seen, self._num_outputs)
        noise = self._draw_noise(num_steps)
        envs.begin(num_steps)
        bounds = np.cumsum([0, *(len(group.members) for group in self._groups)]).tolist()
        # Where a GPU is, bytes are prepared by what acts, so that they may go there as such.
        takes_bytes = self._has_gpu and self._seen.is_bytes
        prepares = [
            self._observations.part(start, stop).prepare_bytes if takes_bytes else None
            for start, stop in itertools.pairwise(bounds)
        ]
        outputs = fragment.outputs.reshape(num_steps, num_members, num_envs, self._num_outputs)
        chosen = []
        for step in range(num_steps):
            observations = fragment.observations[step]
            observations[:] = envs.observations.reshape(observations.shape)
            if takes_bytes:
                seen = observations.reshape(num_members, num_envs, -1)
            else:
                seen = self._observations.prepare(observations)
            for group, prepare, start, stop in zip(self._groups, prepares, bounds, bounds[1:], strict=False):
                outputs[step, start:stop] = group.act(seen[start:stop], prepare)
            if self._num_masked:
                mask_outputs(fragment.outputs[step], fragment.observations[step], self._num_masked)
            actions = self._choose(fragment.outputs[step], noise[step])
            chosen.append(actions)
            done = envs.step(self._to_env(actions))
            fragment.rewards[step], fragment.own_rewards[step] = done.rewards, done.own_rewards
            fragment.terminated[step] = done.is_last
            fragment.ended[step] = done.is_last | done.truncated
            fragment.own_ended[step] = done.terminated | done.truncated
            if done.truncated.any():
                cut = np.flatnonzero(done.truncated & ~done.terminated)
                fragment.cuts += [(step, row, done.final_observations[row].reshape(-1)) for row in cut.tolist()]
        fragment.actions = np.stack(chosen)
        fragment.last[:] = envs.observations.reshape(fragment.last.shape)
        self._normalize_rewards(fragment)
        return fragment

    def _normalize_rewards(self, fragment: Fragment) -> None:
        """Add the discounted returns to the statistics of members with `normalize_rewards`, and scale their rewards."""
        for index, member in enumerate(self.members):
            before = self._returns.get(member.member_id)
            if before is None:
                continue
            rows = slice(index * self.envs.num_envs, (index + 1) * self.envs.num_envs)
            rewards = fragment.rewards[:, rows]
            returns, last = discounted_returns(rewards, fragment.ended[:, rows], member.hyperparams.gamma, before)
            member.return_statistics.add(returns)
            fragment.rewards[:, rows] = member.return_statistics.scale(rewards)
            self._returns[member.member_id] = last

    def _draw_noise(self, num_steps: int) -> Floats:
        """Draw the random numbers for the actions of T steps: Gumbel or normal numbers, (T, S, actions)."""
        num_envs = self.envs.num_envs
        shape = (num_steps, num_envs, self._num_actions)
        parts = []
        for member in self.members:
            if self._is_gaussian:
                parts.append(member.rng.standard_normal(shape, dtype=np.float32))
            else:
                # The largest of logits + Gumbel noise is a draw from their softmax (Gumbel 1954).
                parts.append(member.rng.standard_exponential(shape, dtype=np.float32))
        noise = np.concatenate(parts, axis=1)
        if not self._is_gaussian:
            np.maximum(noise, np.finfo(np.float32).tiny, out=noise)
            np.negative(np.log(noise, out=noise), out=noise)
            if self._is_one_choice and self._num_actions == 2:
                # With two actions only the difference counts.
                noise = noise[..., 0] - noise[..., 1]
        return noise

    def _choose(self, outputs: Floats, noise: Floats) -> NDArray[Any]:
        """Draw each row's action."""
        if self._is_gaussian:
            mean, log_std = outputs[:, : self._num_actions], outputs[:, self._num_actions :]
            return np.asarray(mean + np.exp(log_std.clip(-LOG_STD_CLIP, LOG_STD_CLIP)) * noise, dtype=np.float32)
        if not self._is_one_choice:
            return largest_of_each(outputs + noise, self._heads.sizes)
        if self._num_actions == 2:
            return np.asarray(outputs[:, 1] - outputs[:, 0] > noise, dtype=np.int64)
        return np.asarray((outputs + noise).argmax(axis=1), dtype=np.int64)

    def _to_env(self, actions: NDArray[Any]) -> NDArray[Any]:
        if not self._is_gaussian:
            return actions
        # A member whose weights are not finite fails at its next evaluation; until then no env may get its NaN actions.
        return self._to_bounds(np.nan_to_num(actions))

    def _batch(self, group: PPOGroup, fragment: Fragment, start: int, stop: int) -> Batch:
        """Return the rows of a group's members, `start` to `stop` of the stack, with advantages and value targets."""
        num_envs = self.envs.num_envs
        rows = slice(start * num_envs, stop * num_envs)
        num_members, num_steps = stop - start, len(fragment.rewards)

        def by_member(values: NDArray[Any]) -> NDArray[Any]:
            """Reshape (T, m * N, ...) to (m, T * N, ...)."""
            shape = (num_steps, num_members, num_envs, *values.shape[2:])
            moved = values.reshape(shape).swapaxes(0, 1)
            return moved.reshape(num_members, num_steps * num_envs, *values.shape[2:])

        observations = self._observations.part(start, stop)
        if self._seen.is_bytes:
            seen = by_member(fragment.observations[:, rows])
        else:
            prepared = observations.prepare(fragment.observations[:, rows])
            seen = by_member(prepared.reshape(num_steps, num_members * num_envs, -1))
        values, next_values = self._values(group, fragment, seen, start, stop)
        hyperparams = [member.hyperparams for member in group.members]
        repeat = np.repeat(np.arange(num_members), num_envs)
        advantages, targets = advantages_and_targets(
            fragment.rewards[:, rows],
            values,
            next_values,
            terminated=fragment.terminated[:, rows],
            ended=fragment.ended[:, rows],
            gamma=np.array([item.gamma for item in hyperparams], dtype=np.float32)[repeat],
            gae_lambda=np.array([item.gae_lambda for item in hyperparams], dtype=np.float32)[repeat],
        )
        actions = fragment.actions[:, rows]
        if self._is_one_choice:
            actions = one_hot(actions, self._num_actions)
        elif not self._is_gaussian:
            each = [one_hot(actions[..., place], size) for place, size in enumerate(self._heads.sizes)]
            actions = np.concatenate(each, axis=-1)
        limits_values = any(item.vf_clip_range is not None for item in hyperparams)
        return Batch(
            observations=seen,
            actions=by_member(actions),
            outputs=by_member(fragment.outputs[:, rows]),
            advantages=_as_learnt(by_member(advantages), hyperparams),
            value_targets=by_member(targets),
            values=by_member(values) if limits_values else None,
            masks=by_member(fragment.observations[:, rows, : self._num_masked]) if self._num_masked else None,
            prepare_bytes=observations.prepare_bytes if self._seen.is_bytes else None,
        )

    def _values(
        self, group: PPOGroup, fragment: Fragment, seen: NDArray[Any], start: int, stop: int
    ) -> tuple[Floats, Floats]:
        """Return V of the observations that were acted on and of those that each step led to, (T, m * N).

        Args:
            group: Members `start` to `stop` of the stack.
            fragment: What the stack sampled.
            seen: `Batch.observations` of the group.
            start: The first member's number.
            stop: The number after the last member's.
        """
        num_envs = self.envs.num_envs
        num_members, num_steps = stop - start, len(fragment.rewards)
        observations = self._observations.part(start, stop)
        rows = slice(start * num_envs, stop * num_envs)
        last = fragment.last[rows]
        last = last.reshape(num_members, num_envs, -1) if self._seen.is_bytes else observations.prepare(last)
        all_seen = np.concatenate([seen, last], axis=1)
        if group.has_convolutions:
            # In blocks, since the windows of kernels take many times the memory of an image.
            blocks = range(0, all_seen.shape[1], _IMAGES_AT_ONCE)
            each = [self._evaluate(group, observations, all_seen[:, at : at + _IMAGES_AT_ONCE]) for at in blocks]
            values = np.concatenate(each, axis=1)
        else:
            values = self._evaluate(group, observations, all_seen)
        values = values.reshape(num_members, num_steps + 1, num_envs).swapaxes(0, 1)
        values = values.reshape(num_steps + 1, num_members * num_envs)
        next_values = np.array(values[1:])
        cuts = [(step, row - rows.start, final) for step, row, final in fragment.cuts if rows.start <= row < rows.stop]
        if cuts:
            # In blocks of as many rows a member as it has envs, however many the others need: sums over matrices of
            # another height may be rounded otherwise. Rows that are not filled are not read.
            places = [row // num_envs for _, row, _ in cuts]
            slots = [divmod(places[:number].count(place), num_envs) for number, place in enumerate(places)]
            num_blocks = 1 + max(block for block, _ in slots)
            finals = np.zeros((num_blocks, num_members, num_envs, fragment.last.shape[1]), fragment.last.dtype)
            for place, (block, slot), (_, _, final) in zip(places, slots, cuts, strict=True):
                finals[block, place, slot] = final
            if not self._seen.is_bytes:
                finals = np.stack([observations.prepare(final.reshape(-1, final.shape[-1])) for final in finals])
            found = [self._evaluate(group, observations, final) for final in finals]
            for place, (block, slot), (step, row, _) in zip(places, slots, cuts, strict=True):
                next_values[step, row] = found[block][place, slot]
        return values[:-1], next_values

    def _evaluate(self, group: PPOGroup, observations: Observations, seen: NDArray[Any]) -> Floats:
        """Return V, (m, B), of rows of `Batch.observations`, (m, B, D)."""
        with torch.no_grad():
            if self._seen.is_bytes:
                ready = observations.prepare_bytes(torch.from_numpy(seen).to(self._device))
            else:
                ready = torch.from_numpy(with_ones(seen)).to(self._device)
            return group.values(ready).cpu().numpy()


def _as_learnt(advantages: Floats, hyperparams: Sequence[PPOHyperparams]) -> Floats:
    """Standardise each member's advantages, (M, R), unless it is to learn from them as they are."""
    found = standardise(advantages)
    for index, item in enumerate(hyperparams):
        if not item.normalize_advantages:
            found[index] = advantages[index]
    return found
