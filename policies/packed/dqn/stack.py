"""Train DQN for the members of a pack that share a tensor program: one vector of environments, batched updates.

An iteration does what `policies.rllib.dqn_algorithm` does for one trial: phases of sampling, each followed by the
updates that are due.

Shapes: M members, T vector steps, N sub-environments per member, S = M * N rows, B rows per batch, W numbers per
observation with its mask if there is one, D that networks see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from policies.hyperparams import DQNHyperparams
from policies.networks.epsilon import EpsilonSchedule
from policies.packed.dqn.group import DQNGroup
from policies.packed.dqn.n_step import StackedNStep
from policies.packed.dqn.replay import make_stacked_replay
from policies.packed.envs.vector import PackedEnvs, Step
from policies.packed.member import Member, MemberStats, group_members
from policies.packed.sampling import Observations, allowed_at, mask_outputs, merge_statistics
from policies.packed.shared import SharedByDQN
from policies.packed.stack import Stack

Floats = NDArray[np.float32]

_MAX_GROUP = 32
"""Batches are smaller than PPO's, so more members fit a core's cache."""
_NUMBERS_AT_ONCE = 65_536


@dataclass(eq=False)
class _Draws:
    """The random numbers for the members' actions and batches in some phases."""

    explores: Floats
    """Uniform in [0, 1), (T, M, N); below epsilon, the action is random."""
    actions: NDArray[Any]
    """The random actions, (T, M, N); with masks, the uniform numbers in [0, 1) that they are made of."""
    batches: NDArray[np.float64]
    """Uniform in [0, 1), (phases, most updates of a phase, M, B)."""


class DQNStack(Stack[DQNHyperparams, DQNGroup, SharedByDQN]):
    """Trains the DQN members of a pack together; see `Stack`."""

    def __init__(self, shared: SharedByDQN, envs: PackedEnvs, device: str = "cpu") -> None:
        super().__init__(shared, envs, device)
        self._replay = make_stacked_replay(shared, self._seen)
        self._n_step = StackedNStep(envs.num_envs, self._seen, shared.n_step)
        self._steps_per_phase = math.ceil(shared.train_freq / shared.num_envs)
        """Vector steps between two training phases."""
        self._updates_per_phase = self._steps_per_phase * envs.num_envs * shared.updates_per_env_step
        # Env steps at which a restored member's replay memory is as full as it was when learning began.
        self._refilled_at: dict[str, int] = {}
        self._unlearned: list[NDArray[Any]] = []
        self._stats: dict[str, MemberStats] = {}
        self._num_actions = int(cast("gym.spaces.Discrete[Any]", envs.action_space).n)

    def _begin(self, member: Member[DQNHyperparams], max_env_steps: int | None) -> None:
        """Make room for the member's transitions."""
        hyperparams = member.hyperparams
        self._replay.add_member(member.member_id, hyperparams, max_env_steps)
        self._n_step.add_member(member.member_id, hyperparams)
        if member.num_updates and self._shared.replay != "none":
            # Its memory is empty again. It is filled to where it was when learning began; until then nothing is learnt.
            num_steps = max(hyperparams.learning_starts, self._shared.train_batch_size)
            self._refilled_at[member.member_id] = member.num_env_steps + num_steps

    def _forget(self, member_id: str) -> None:
        """Drop the member's transitions."""
        self._replay.remove_member(member_id)
        self._n_step.remove_member(member_id)
        self._refilled_at.pop(member_id, None)

    def _regroup(self) -> None:
        """Make the groups anew, from members that learn at the same time, whatever their position among the rows."""
        self._write_back()
        groups = group_members(
            self.members,
            _MAX_GROUP,
            lambda item: (self._learns(item), self._num_updates(item), round(item.due, 6)),
        )
        places = {member.member_id: index for index, member in enumerate(self.members)}
        self._groups = []
        for members in groups:
            group = DQNGroup(
                members,
                self._shared,
                self._seen,
                self._num_actions,
                self._replay,
                num_envs=self.envs.num_envs,
                device=self._device,
            )
            indices = np.array([places[member.member_id] for member in members], dtype=np.int64)
            is_run = bool(np.all(np.diff(indices) == 1))
            group.positions = slice(int(indices[0]), int(indices[-1]) + 1) if is_run else indices
            group.learns = self._learns(members[0])
            self._groups.append(group)

    def _arrange(self) -> None:
        """Put members that are computed together side by side; called only between iterations."""
        self._write_back()
        self.members = [member for group in group_members(self.members) for member in group]
        self._ids = [member.member_id for member in self.members]
        self.envs.arrange(self._ids)
        self._schedules = [EpsilonSchedule.of(item.hyperparams) for item in self.members]
        self._observations = self._make_observations()
        self._regroup()
        self._stale = False

    def _make_observations(self) -> Observations:
        return Observations(
            self.members,
            self.envs.num_envs,
            normalizes=self._shared.normalize_observations,
            seen=self._seen,
        )

    def _learns(self, member: Member[DQNHyperparams]) -> bool:
        """Whether updates of a member are due."""
        if member.num_env_steps < self._refilled_at.get(member.member_id, 0):
            return False
        (size,) = self._replay.sizes(self._replay.slots([member.member_id]))
        has_a_batch = bool(size >= self._shared.train_batch_size)
        return has_a_batch and member.num_env_steps >= member.hyperparams.learning_starts

    def _num_updates(self, member: Member[DQNHyperparams]) -> int:
        """Return the number of updates that are due; it allows for rounding, as 10 x 0.1 is less than 1 in binary."""
        return math.floor(member.due + self._updates_per_phase + 1e-9)

    def _is_mixed(self, group: DQNGroup) -> bool:
        """Whether updates are due for only some members of a group, because sums of fractions drift apart."""
        if not group.learns:
            return any(map(self._learns, group.members))
        return len(set(map(self._num_updates, group.members))) > 1

    def begin_iteration(self) -> None:
        """Do the whole iteration, since sampling waits for the updates of every phase."""
        if self._stale:
            self._arrange()
        shared = self._shared
        num_envs, updates_per_phase = self.envs.num_envs, self._updates_per_phase
        steps_per_phase = self._steps_per_phase
        new_steps = steps_per_phase * num_envs
        num_phases = math.ceil(shared.env_steps_per_iteration / new_steps)
        at_once = max(1, _NUMBERS_AT_ONCE // ((math.floor(updates_per_phase) + 1) * shared.train_batch_size))
        stats: dict[str, dict[str, float]] = {}
        rewards, ended = [], []
        self.envs.begin(num_phases * steps_per_phase)
        for start in range(0, num_phases, at_once):
            draws = self._draw(min(at_once, num_phases - start), steps_per_phase, updates_per_phase)
            for phase in range(start, min(start + at_once, num_phases)):
                for number in range(steps_per_phase):
                    step = self._sample(draws, (phase - start) * steps_per_phase + number)
                    rewards.append(step.own_rewards)
                    ended.append(step.terminated | step.truncated)
                # Updates may be rarer than phases: the metrics of the last update made are wanted.
                is_late = (num_phases - phase - 1) * updates_per_phase <= 1.0
                self._learn(draws, phase - start, new_steps, stats if is_late else None)
        episodes = self._episodes.follow(self._ids, np.stack(rewards), np.stack(ended))
        for member in self.members:
            member.num_iterations += 1
        self._stats = {
            member.member_id: MemberStats(member.num_env_steps, found, stats.get(member.member_id, {}))
            for member, found in zip(self.members, episodes, strict=True)
        }

    @override
    def finish_iteration(self) -> dict[str, MemberStats]:
        return self._stats

    def _draw(self, num_phases: int, steps_per_phase: int, updates_per_phase: float) -> _Draws:
        """Draw each member's numbers for some phases, in an order that does not depend on the other members."""
        num_members, num_envs = len(self.members), self.envs.num_envs
        num_steps = num_phases * steps_per_phase
        shared = self._shared
        most = math.floor(updates_per_phase) + 1
        draws = _Draws(
            np.empty((num_steps, num_members, num_envs), dtype=np.float32),
            np.empty((num_steps, num_members, num_envs), dtype=np.float64 if self._num_masked else np.int64),
            np.empty((num_phases, most, num_members, shared.train_batch_size)),
        )
        for index, member in enumerate(self.members):
            draws.explores[:, index] = member.rng.random((num_steps, num_envs), dtype=np.float32)
            if self._num_masked:
                draws.actions[:, index] = member.rng.random((num_steps, num_envs))
            else:
                draws.actions[:, index] = member.rng.integers(0, self._num_actions, (num_steps, num_envs))
            if shared.replay != "none":
                draws.batches[:, :, index] = member.rng.random((num_phases, most, shared.train_batch_size))
        return draws

    def _sample(self, draws: _Draws, number: int) -> Step:
        """Make one vector step and put its transitions into the replay memory."""
        num_members, num_envs = len(self.members), self.envs.num_envs
        observations = self.envs.observations.reshape(num_members * num_envs, -1)
        seen = self._observations.prepare(observations)
        outputs = np.empty((num_members, num_envs, self._num_actions), dtype=np.float32)
        for group in self._groups:
            outputs[group.positions] = group.act(seen[group.positions])
        randomly = draws.actions[number]
        if self._num_masked:
            by_member = observations.reshape(num_members, num_envs, -1)
            mask_outputs(outputs, by_member, self._num_masked)
            randomly = allowed_at(randomly, by_member, self._num_masked)
        epsilon = [
            schedule.at(member.num_episodes if schedule.unit == "episode" else member.num_env_steps)
            for schedule, member in zip(self._schedules, self.members, strict=True)
        ]
        explores = draws.explores[number] < np.array(epsilon, dtype=np.float32)[:, None]
        actions = np.where(explores, randomly, outputs.argmax(axis=-1)).reshape(-1)
        step = self.envs.step(actions)
        rows = self._n_step.rows(self._ids, observations, actions, step)
        if isinstance(rows, list):
            for name, own in zip(self._ids, rows, strict=True):
                if len(own):
                    self._replay.add(self._replay.slots([name]), own[None])
        else:
            self._replay.add(self._replay.slots(self._ids), rows)
        ended = step.terminated | step.truncated
        counts = ended.reshape(num_members, num_envs).sum(axis=1).tolist() if ended.any() else [0] * num_members
        for member, count in zip(self.members, counts, strict=True):
            member.num_env_steps += num_envs
            member.num_episodes += count
        if self._shared.normalize_observations:
            self._unlearned.append(observations)
        return step

    def _learn(self, draws: _Draws, phase: int, new_steps: int, stats: dict[str, dict[str, float]] | None) -> None:
        """Run the training phase of every member that learns."""
        if any(map(self._is_mixed, self._groups)):
            self._regroup()
        for group in self._groups:
            if not group.learns:
                continue
            num_updates = self._num_updates(group.members[0])
            for member in group.members:
                member.due = member.due + self._updates_per_phase - num_updates
            if not num_updates:
                continue
            self._is_written = False
            numbers = draws.batches[phase, :num_updates][:, group.positions]
            found = group.learn(numbers, new_steps, wants_stats=stats is not None)
            if stats is not None:
                stats.update(zip((member.member_id for member in group.members), found, strict=True))
        self._learn_statistics()

    def _learn_statistics(self) -> None:
        """Merge the observations of the phase into the statistics, if observations are normalised."""
        if not self._shared.normalize_observations:
            return
        rows = np.stack(self._unlearned)[..., self._num_masked :]
        rows = rows.reshape(len(self._unlearned), len(self.members), -1, self._num_inputs)
        self._unlearned = []
        for index, member in enumerate(self.members):
            # A refilling member's are in its checkpoint's statistics already, as far as its policy goes on as it did.
            if member.num_env_steps > self._refilled_at.get(member.member_id, 0):
                merge_statistics(member, rows[:, index].reshape(-1, self._num_inputs), self._seen.scale)
        self._observations = self._make_observations()
