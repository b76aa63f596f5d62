"""Step any environment for all members of a pack: scalar sub-environments, in this process or in others.

Those of classic control, which can be rows of arrays, are stepped in one object; all else is the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs.classic_rows import ClassicRows
from policies.envs.faults import close_env
from policies.envs.make import make_env
from policies.envs.spaces import observation_dtype
from policies.envs.tallies import Tally, tally_of
from policies.errors import EnvError
from policies.packed.envs.classic_sub_envs import ClassicSubEnvs
from policies.packed.envs.penalty import Penalty
from policies.packed.envs.process import ProcessHost
from policies.packed.envs.rows import MemberRows, Rows
from policies.packed.envs.sub_envs import HereHost, Host, HostDiedError, SubStep
from policies.packed.envs.together_sub_envs import make_sub_envs
from policies.packed.envs.vector import Step

_NUM_SEEDS = 2**32  # Gymnasium takes larger seeds, but many environments do not


@dataclass(eq=False)
class _Part:
    """A host and its sub-environments, in the host's order."""

    host: Host
    owners: list[tuple[str, int]] = field(default_factory=list)
    """For each sub-environment, its member and its index among the member's sub-environments."""
    rows: Rows = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """The row of each sub-environment."""
    alone_for: str | None = None
    """The only member that the host is for; None: any."""


class ScalarEnvs:
    """The sub-environments of a pack that trains on any environment; implements `PackedEnvs`.

    Sub-environment i of a member is reset from seed + i at first, and without a seed after that. With processes, a
    member's sub-environments are spread over them evenly. One process shares them with this one, which would only wait
    for it; with more, this one has none, so that an env that kills its process does not kill the pack. When a process
    dies, the members that had one in it fail. If they are added again, each gets a process of its own, so that one
    whose env kills its process harms no other.

    Args:
        env_id: Gymnasium id.
        env_args: The same as for `policies.envs.make.make_env`.
        num_envs: Sub-environments of each member.
        failure_penalty: Reward of steps that end by failure; None: the env's own reward.
        atari_training: The arguments of an `AtariTraining`, whose learner these are stepped for; None: there is none.
        num_processes: Processes to step them in; 0: in this one. One shares them with this one.
        suspects: The members that had a sub-environment in a process that died, which are added here; None: none yet.
        rows: Steps all of them at once, in this process; None: one is stepped after the other.

    Raises:
        EnvError: The environment cannot be made, or there is a penalty and it has no failure.
    """

    def __init__(
        self,
        env_id: str,
        env_args: Mapping[str, Any] | None,
        num_envs: int,
        *,
        failure_penalty: float | None = None,
        atari_training: Mapping[str, bool] | None = None,
        num_processes: int = 0,
        suspects: set[str] | None = None,
        rows: ClassicRows | None = None,
    ) -> None:
        self._env_id, self._env_args = env_id, dict(env_args or {})
        env = make_env(env_id, self._env_args)
        self.num_envs = num_envs
        self.observation_space: gym.Space[Any] = env.observation_space
        self.action_space: gym.Space[Any] = env.action_space
        close_env(env)
        self.errors: dict[str, Exception] = {}
        self._penalty = Penalty.find(env_id, self._env_args, failure_penalty)
        training = atari_training or {}
        self._with_lives = training.get("terminal_on_life_loss", False)
        self._clips = training.get("clip_rewards", False)
        self._members = MemberRows(num_envs)
        self._num_processes = num_processes
        self._parts: list[_Part] = [] if rows is None else [_Part(HereHost(ClassicSubEnvs(rows, env_id)))]
        self._suspects = set() if suspects is None else suspects
        self._tallies: dict[str, Tally] = {}
        self.observations: NDArray[Any] = self._zeros(0)

    @property
    def member_ids(self) -> tuple[str, ...]:
        """In the order of their rows."""
        return self._members.ids

    def add(self, member_id: str, seed: int) -> None:
        """Add a member after all others, with its sub-environments reset with its seed."""
        self._members.check_new(member_id)
        shares = self._share_out(member_id)
        parts = [part for part, _ in shares]
        answers = self._ask(
            parts,
            "add",
            [(member_id, [(seed + place) % _NUM_SEEDS for place in places]) for _, places in shares],
            beside=[member_id],
        )
        firsts = self._zeros(self.num_envs)
        problem: EnvError | None = None
        for (part, places), answer in zip(shares, answers, strict=True):
            if isinstance(answer, EnvError):
                problem = answer
            else:
                firsts[places] = answer
                part.owners += [(member_id, place) for place in places]
        if problem is not None:
            self._drop(member_id)
            if isinstance(problem, HostDiedError):
                self._suspects.add(member_id)
            raise problem
        self._members.add(member_id)
        if (tally := tally_of(member_id)) is not None:
            self._tallies[member_id] = tally
        self.observations = np.concatenate([self.observations, firsts])
        self._find_rows()

    def remove(self, member_id: str) -> None:
        """Close a member's sub-environments; the rows after it move up."""
        self._drop(member_id)
        self.observations = self.observations[self._members.remove(member_id)]
        self.errors.pop(member_id, None)
        self._tallies.pop(member_id, None)
        self._find_rows()

    def arrange(self, member_ids: Sequence[str]) -> None:
        """Put the members into this order; their running episodes go on."""
        self.observations = self.observations[self._members.arrange(member_ids)]
        self._find_rows()

    def begin(self, num_steps: int) -> None:
        """Do nothing, because nothing is drawn ahead here."""

    def step(self, actions: NDArray[Any]) -> Step:
        """Step every row; members whose env raises an error fail."""
        to_env = self._for_env(actions)
        num = len(self._members)
        finals = self._zeros(num)
        rewards = np.zeros(num, dtype=np.float32)
        terminated, truncated = np.zeros(num, dtype=np.bool_), np.zeros(num, dtype=np.bool_)
        lost = np.zeros(num, dtype=np.bool_)
        firsts: dict[int, NDArray[Any]] = {}
        failed: dict[str, EnvError] = {}
        parts = [part for part in self._parts if part.owners]
        # Copied, because members that fail in this step lose their rows.
        all_rows = [part.rows for part in parts]
        answers: list[SubStep | EnvError] = self._ask(parts, "step", [(to_env[rows],) for rows in all_rows])
        for rows, answer in zip(all_rows, answers, strict=True):
            if isinstance(answer, EnvError):  # its process has died, and its members have failed already
                continue
            finals[rows], rewards[rows] = answer.final_observations, answer.rewards
            terminated[rows], truncated[rows] = answer.terminated, answer.truncated
            lost[rows] = False if answer.lost_lives is None else answer.lost_lives
            firsts |= {int(rows[place]): first for place, first in answer.first_observations.items()}
            failed |= answer.errors
        for member_id, error in failed.items():
            self._fail([member_id], error)
        observations = finals
        if firsts:
            observations = finals.copy()
            observations[list(firsts)] = list(firsts.values())
        for member_id in self.errors:
            for array in (finals, observations, rewards, terminated, truncated, lost):
                array[self._members.of(member_id)] = 0
        self.observations = observations
        ends = Counter(self._members.ids[row // self.num_envs] for row in firsts)
        for member_id, tally in self._tallies.items():
            if member_id not in self.errors:
                tally.add(self.num_envs, ends[member_id])
        seen = self._as_learnt(rewards, terminated)
        return Step(observations, finals, seen, rewards, terminated, truncated, lost if self._with_lives else None)

    def _as_learnt(self, rewards: NDArray[np.float32], terminated: NDArray[np.bool_]) -> NDArray[np.float32]:
        if self._clips:
            return np.sign(rewards)
        return rewards if self._penalty is None else self._penalty.apply(rewards, terminated)

    def close(self) -> None:
        """Close all sub-environments and end their processes."""
        for part in self._parts:
            part.host.close()
        self._parts = []

    def _zeros(self, num: int) -> NDArray[Any]:
        space = self.observation_space
        return np.zeros((num, *(space.shape or ())), dtype=observation_dtype(space))

    def _for_env(self, actions: NDArray[Any]) -> NDArray[Any]:
        if isinstance(self.action_space, gym.spaces.Discrete):
            return actions + int(self.action_space.start)
        return np.asarray(actions, dtype=self.action_space.dtype)

    # -- hosts

    def _share_out(self, member_id: str) -> list[tuple[_Part, list[int]]]:
        """Choose hosts for a new member's sub-environments, and which of them each host gets."""
        if member_id in self._suspects:
            part = _Part(self._make_host(apart=True), alone_for=member_id)
            self._parts.append(part)
            return [(part, list(range(self.num_envs)))]
        shared = [part for part in self._parts if part.alone_for is None]
        while len(shared) < (2 if self._num_processes == 1 else max(1, self._num_processes)):
            # What is stepped here is first: it is, when its results are asked for, while the other process steps too.
            shared.append(_Part(self._make_host(apart=self._num_processes > 1 or bool(shared))))
            self._parts.append(shared[-1])
        places: list[list[int]] = [[] for _ in shared]
        for place in range(self.num_envs):
            loads = [len(part.owners) + len(more) for part, more in zip(shared, places, strict=True)]
            places[loads.index(min(loads))].append(place)
        return [(part, more) for part, more in zip(shared, places, strict=True) if more]

    def _make_host(self, *, apart: bool) -> Host:
        if apart:
            return ProcessHost(self._env_id, self._env_args, with_lives=self._with_lives)
        return HereHost(make_sub_envs(self._env_id, self._env_args, with_lives=self._with_lives))

    def _find_rows(self) -> None:
        for part in self._parts:
            rows = [self._members.of(member_id).start + place for member_id, place in part.owners]
            part.rows = np.array(rows, dtype=np.intp)

    def _ask(
        self, parts: Sequence[_Part], method: str, args: Sequence[tuple[Any, ...]], *, beside: Sequence[str] = ()
    ) -> list[Any]:
        """Call a method of several hosts and return their results; where a host raised an `EnvError`, the error.

        Args:
            parts: The hosts.
            method: The method.
            args: Its arguments for each host.
            beside: Members that may end the hosts, beside those that have sub-environments there.
        """
        answers: list[Any] = [None] * len(parts)
        for index, part in enumerate(parts):
            try:
                part.host.send(method, *args[index])
            except HostDiedError as error:
                answers[index] = error
        for index, part in enumerate(parts):
            if answers[index] is None:
                try:
                    answers[index] = part.host.receive()
                except EnvError as error:
                    answers[index] = error
        # Of all, as asking hosts again may find one of them dead a second time, by another error.
        for part, answer in zip(parts, answers, strict=True):
            if isinstance(answer, HostDiedError):
                answer.in_company = len({member_id for member_id, _ in part.owners}.union(beside)) > 1
        # Only after all answers, because handling a failure asks hosts again.
        for part, answer in zip(parts, answers, strict=True):
            if isinstance(answer, HostDiedError) and part in self._parts:
                part.host.close()
                self._parts.remove(part)
                members = dict.fromkeys(member_id for member_id, _ in part.owners)
                self._suspects.update(members)
                self._fail(members, answer)
        return answers

    def _fail(self, member_ids: Collection[str], error: EnvError) -> None:
        """Mark members as failed: they stay until they are removed, but have no sub-environments any more."""
        self.observations = self.observations.copy()
        for member_id in member_ids:
            self.errors.setdefault(member_id, error)
            self._drop(member_id)
            self.observations[self._members.of(member_id)] = 0
        self._find_rows()

    def _drop(self, member_id: str) -> None:
        """Close a member's sub-environments."""
        for part in [part for part in self._parts if any(owner == member_id for owner, _ in part.owners)]:
            part.owners = [pair for pair in part.owners if pair[0] != member_id]
            if part.alone_for is None:
                self._ask([part], "remove", [(member_id,)], beside=[member_id])
        for part in [part for part in self._parts if part.alone_for == member_id]:
            part.host.close()
            self._parts.remove(part)
