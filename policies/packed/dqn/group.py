"""Members of a pack whose DQN networks are computed together: acting, and the updates of a training phase.

Shapes: M members, N sub-environments per member, B rows per batch, U batches that are drawn at once, D
numbers per observation, A actions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policies.envs.masks import FORBIDDEN
from policies.hyperparams import DQNHyperparams
from policies.networks.denormals import denormals_as_zero
from policies.packed.acting import make_acting
from policies.packed.dqn import loss as dqn
from policies.packed.dqn.replay import Indices, StackedReplay
from policies.packed.inputs import Inputs
from policies.packed.member import TARGET_PREFIX, Member
from policies.packed.optimizers import StackedAdam, StackedOptimizer, StackedRMSprop, clip_by_global_norm
from policies.packed.rows import StackedRows
from policies.packed.sampling import Observations
from policies.packed.shared import SharedByDQN
from policies.schedules import linear

Floats = NDArray[np.float32]


_NUMBERS_AT_ONCE = 65_536
"""The most numbers of batches that are drawn at once: they are read back soon, from a cache."""


class Batch(NamedTuple):
    """What an update learns from, member by member."""

    now: Tensor
    """What networks see, with a last column of ones, (M, B, D + 1), or of images (M, B, D)."""
    later: Tensor
    """What they see next."""
    actions: Tensor
    """Whole numbers, (M, B)."""
    rewards: Tensor
    """The rewards of n steps, (M, B)."""
    discounts: Tensor
    """What the next value counts, 0 after an end, (M, B)."""
    masks: Tensor | None
    """Which actions are allowed next, (M, B, A); None: all."""
    weights: Tensor | None
    """Importance weights, (M, B); None: all 1."""
    indices: Indices | None
    """Where the rows are in the replay memory, (M, B), if their priorities are to be set."""


class DQNGroup:
    """M members with about the same layer sizes, whose updates are due at the same time.

    Args:
        members: The members.
        shared: The hyperparameters that the members share.
        seen: What networks see of an observation, D numbers, behind a mask of A numbers if there is one.
        num_actions: The number of actions, A.
        replay: The replay memory that batches are drawn from.
        num_envs: The sub-environments of each member.
        device: Where the updates are computed, and actions of large networks.

    Attributes:
        positions: The members' positions in their stack.
        learns: Whether updates of the members are due.
    """

    def __init__(
        self,
        members: Sequence[Member[DQNHyperparams]],
        shared: SharedByDQN,
        seen: Inputs,
        num_actions: int,
        replay: StackedReplay,
        *,
        num_envs: int,
        device: str,
    ) -> None:
        self.members, self._shared = members, shared
        self.positions: slice | NDArray[np.int64] = slice(0, 0)
        self.learns = False
        self._num_inputs, self._num_actions, self._device = seen.num_inputs, num_actions, device
        self._seen = seen
        self._replay, self._slots = replay, replay.slots([member.member_id for member in members])
        self._hyperparams = [member.hyperparams for member in members]
        self._rows = StackedRows(members, seen.shape, num_actions, device, image=seen.image)
        self._networks = self._rows.networks
        self._targets: StackedRows | None = None
        if shared.target_network:
            self._targets = StackedRows(members, seen.shape, num_actions, device, TARGET_PREFIX, image=seen.image)
        self._optimizer = self._make_optimizer()
        self._rows.read_moments(self._optimizer)
        self._acting = make_acting(self._networks, len(members), num_envs)
        self._grad_clip = self._column(lambda item: math.inf if item.grad_clip is None else item.grad_clip)
        self._clips = any(item.grad_clip is not None for item in self._hyperparams)
        self._tau = self._column(lambda item: item.tau)
        self._reward_scale = self._column(lambda item: item.reward_scale)
        self._scales_rewards = any(item.reward_scale != 1.0 for item in self._hyperparams)
        self._copies = all(item.tau == 1.0 for item in self._hyperparams)
        self._moves_always = all(item.target_update_interval is None for item in self._hyperparams)
        self._has_schedule = any(item.lr_final is not None for item in self._hyperparams)

    def _column(self, value: Callable[[DQNHyperparams], float], dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.tensor([[value(item)] for item in self._hyperparams], device=self._device, dtype=dtype)

    def _make_optimizer(self) -> StackedOptimizer:
        weights, epsilon = self._networks.weights, self._column(lambda item: item.optimizer_epsilon)
        lr = self._column(lambda item: item.lr)
        if self._shared.optimizer == "adam":
            return StackedAdam(
                weights,
                lr,
                beta1=self._column(lambda item: item.adam_beta1, torch.float64),
                beta2=self._column(lambda item: item.adam_beta2, torch.float64),
                epsilon=epsilon,
            )
        return StackedRMSprop(
            weights,
            lr,
            rho=self._column(lambda item: item.rmsprop_rho, torch.float64),
            momentum=self._column(lambda item: item.rmsprop_momentum),
            epsilon=epsilon,
        )

    def act(self, observations: Floats) -> Floats:
        """Return Q-values or advantages, (M, N, A), for prepared observations, (M, N, D)."""
        return self._acting(observations)[..., : self._num_actions]

    @torch.inference_mode()
    @denormals_as_zero()
    def learn(self, numbers: NDArray[np.float64], num_new_steps: int, *, wants_stats: bool) -> list[dict[str, float]]:
        """Make the updates of one training phase.

        Args:
            numbers: Random numbers, uniform in [0, 1), that the batches are drawn with, (updates, M, B).
            num_new_steps: Env steps of each member since the last phase.
            wants_stats: Whether to compute the metrics of the last update.

        Returns:
            For each member, the metrics of the last update; empty if they are not wanted.
        """
        if self._has_schedule:
            lrs = np.array([[self._lr(member)] for member in self.members], dtype=np.float32)
            self._optimizer.lr = torch.from_numpy(lrs).to(self._device)
        num_updates = len(numbers)
        self._optimizer.begin(num_updates)
        stats: list[dict[str, float]] = []
        for number, batch in enumerate(self._batches(numbers)):
            is_last = wants_stats and number == num_updates - 1
            stats = self._update(batch, wants_stats=is_last)
            self._update_targets(num_new_steps * (1 - (number + 1) / num_updates))
        for member in self.members:
            member.num_updates += num_updates
        self._acting.refresh()
        return stats

    def _lr(self, member: Member[DQNHyperparams]) -> float:
        item = member.hyperparams
        return linear(item.lr, item.lr_final, item.lr_decay_steps, member.num_env_steps)

    def _batches(self, numbers: NDArray[np.float64]) -> Iterator[Batch]:
        """Yield the batch of each update; as many as fit a cache are drawn at once, if the memory draws ahead."""
        observations = Observations(self.members, 1, normalizes=self._shared.normalize_observations, seen=self._seen)
        ahead = self._replay.draws_ahead
        size = self._replay.num_columns * numbers[0].size
        at_once = max(1, _NUMBERS_AT_ONCE // size) if ahead else 1
        for start in range(0, len(numbers), at_once):
            drawn = self._replay.draw(self._slots, numbers[start : start + at_once] if ahead else numbers[start])
            rows = drawn.rows if ahead else drawn.rows[None]
            if not self._seen.is_bytes:
                for first in (0, self._seen.num_columns):
                    observations.prepare_columns(rows[..., first : first + self._seen.num_columns])
            batches = torch.from_numpy(rows).to(self._device)
            weights = None if drawn.weights is None else torch.from_numpy(drawn.weights).to(self._device)
            seen, seen_next, masks = self._observed(batches, observations)
            parts = (seen, seen_next, batches[..., -3].long(), batches[..., -2], batches[..., -1])
            now, later, actions, rewards, discounts = (part.unbind(0) for part in parts)
            for at in range(len(batches)):
                own_masks = None if masks is None else masks[at]
                yield Batch(
                    now[at], later[at], actions[at], rewards[at], discounts[at], own_masks, weights, drawn.indices
                )

    def _update(self, batch: Batch, *, wants_stats: bool) -> list[dict[str, float]]:
        shared, weights = self._shared, batch.weights
        next_values = self._next_values(batch.later, batch.masks, uses_double_q=shared.double_q)
        rewards = batch.rewards * self._reward_scale if self._scales_rewards else batch.rewards
        targets = rewards + batch.discounts * next_values
        loss = dqn.loss_gradient(self._networks.forward(batch.now), batch.actions, targets, weights, shared)
        self._networks.backward(loss.gradient)
        norms = None
        if self._clips:
            norms = clip_by_global_norm(self._networks.gradients, self._grad_clip, 1)
        self._optimizer.step(self._networks.gradients)
        if batch.indices is not None:
            self._replay.set_priorities(self._slots, batch.indices, loss.td_errors.cpu().numpy())
        if not wants_stats:
            return []
        return self._stats(dqn.mean_loss(loss.td_errors, weights, shared), loss.q_selected.mean(dim=1), norms)

    def _observed(self, batch: Tensor, observations: Observations) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return what networks see in rows of batches now and next, and the next masks, if any, (U, M, B, ...)."""
        middle, num_masked = self._seen.num_columns, self._seen.num_masked
        if self._seen.is_bytes:
            parts = batch[..., :middle], batch[..., middle : 2 * middle]
            now, later = (observations.prepare_bytes(self._seen.bytes_in_tensor(part)) for part in parts)
            return now, later, None
        masks = batch[..., middle : middle + num_masked] if num_masked else None
        return batch[..., num_masked:middle], batch[..., middle + num_masked : 2 * middle], masks

    def _next_values(self, later: Tensor, masks: Tensor | None, *, uses_double_q: bool) -> Tensor:
        """Return Q' of the best next action that the masks, (M, B, A), allow, (M, B)."""
        num_members = len(self.members)

        def q_values(rows: StackedRows) -> Tensor:
            found = dqn.q_values(rows.networks.evaluate(later, 0, num_members), self._num_actions)
            return found if masks is None else found.masked_fill(masks == 0, FORBIDDEN)

        if self._targets is None:
            return dqn.best_next_values(q_values(self._rows), None)
        online = q_values(self._rows) if uses_double_q else None
        return dqn.best_next_values(q_values(self._targets), online)

    def _update_targets(self, num_steps_after: float) -> None:
        """Update the target networks that are due; `num_steps_after` env steps of the phase follow this update."""
        if self._targets is None:
            return
        if self._moves_always:
            for member in self.members:
                member.num_target_updates += 1
            self._move_targets(range(len(self.members)))
            return
        due = []
        for index, (member, item) in enumerate(zip(self.members, self._hyperparams, strict=True)):
            interval = item.target_update_interval
            if interval is not None:
                by_episode = item.target_update_unit == "episode"
                now = member.num_episodes if by_episode else member.num_env_steps - num_steps_after
                if now - member.target_updates_at < interval:
                    continue
                member.target_updates_at = now
            member.num_target_updates += 1
            due.append(index)
        if due:
            self._move_targets(due)

    def _move_targets(self, due: Sequence[int]) -> None:
        """Move the target networks of some members towards their online networks."""
        assert self._targets is not None
        target, online = self._targets.networks.weights, self._networks.weights
        if len(due) == len(self.members):
            if self._copies:
                target.copy_(online)
            else:
                target.lerp_(online, self._tau)
        else:
            rows = torch.tensor(due, device=self._device)
            target[rows] = torch.lerp(target[rows], online[rows], self._tau[rows])

    def _stats(self, losses: Tensor, q_means: Tensor, norms: Tensor | None) -> list[dict[str, float]]:
        columns = {"total_loss": losses.tolist(), "q_mean": q_means.tolist(), "lr": self._optimizer.lr[:, 0].tolist()}
        stats = [{name: values[index] for name, values in columns.items()} for index in range(len(self.members))]
        if norms is not None:
            for found, norm, item in zip(stats, norms[:, 0].tolist(), self._hyperparams, strict=True):
                if item.grad_clip is not None:  # computed for all, reported where it is clipped
                    found["gradient_norm"] = norm
        return [{name: value for name, value in found.items() if math.isfinite(value)} for found in stats]

    def write_back(self) -> None:
        """Copy the present weights and moments back to the members."""
        self._rows.write_back(self._optimizer)
        for member, item in zip(self.members, self._hyperparams, strict=True):
            if not item.rmsprop_momentum:  # without momentum, nothing depends on the buffer
                member.moments.pop("momentum_buffer", None)
        if self._targets is not None:
            self._targets.write_back()
