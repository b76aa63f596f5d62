"""The base class of stacks: members of a pack that share one tensor program, and how they come and go."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Generic, Protocol, TypeVar

from policies.packed.envs.vector import PackedEnvs
from policies.packed.inputs import Inputs
from policies.packed.member import H, Member, MemberStats
from policies.packed.sampling import EpisodeTracker
from policies.packed.shared import Shared


class Group(Protocol):
    """Members whose networks are computed together."""

    def write_back(self) -> None:
        """Copy the present weights and moments back to the members."""
        ...


G = TypeVar("G", bound=Group)
S = TypeVar("S", bound=Shared)


class Stack(ABC, Generic[H, G, S]):
    """Trains its members together. Members may come and go between iterations without any effect on the others.

    All members have the same environment and the same hyperparameters of `Shared`.

    Args:
        shared: The hyperparameters that all members share.
        envs: The environments, without members yet.
        device: Where the updates are computed.
    """

    def __init__(self, shared: S, envs: PackedEnvs, device: str) -> None:
        self.envs, self._device = envs, device
        self.members: list[Member[H]] = []
        """The members in the order of their rows."""
        self._shared = shared
        self._groups: Sequence[G] = []
        self._episodes = EpisodeTracker()
        # Stale: members came or went since the groups were made. Written: no group has learned since its weights were
        # copied back to the members, which is always so while the groups are stale.
        self._stale, self._is_written = False, True
        self._seen = Inputs.of(envs.observation_space)
        self._num_masked = self._seen.num_masked
        self._num_inputs = self._seen.num_inputs
        """The numbers of an observation that networks see."""

    def add(self, member: Member[H], env_seed: int, max_env_steps: int | None = None) -> None:
        """Add a member and begin its episodes.

        Args:
            member: The member.
            env_seed: Seeds its environments.
            max_env_steps: The most env steps that it will be trained here; None: not known.

        Raises:
            EnvError: Its environments cannot be made or reset; then it is not added.
            ValueError: Its hyperparameters differ from those that the members share.
        """
        own = self._shared.of(member.hyperparams)
        if own != self._shared:
            raise ValueError(f"{member.member_id} does not belong in this stack: it has {own}, not {self._shared}")
        self.envs.add(member.member_id, env_seed)
        self._write_back()
        try:
            self._begin(member, max_env_steps)
        except MemoryError:
            self.envs.remove(member.member_id)
            raise
        self._episodes.add(member.member_id, self.envs.num_envs)
        self.members.append(member)
        self._stale = True

    def remove(self, member_id: str) -> Member[H]:
        """Remove a member and return it with its present weights."""
        member = self.member(member_id)
        self.members.remove(member)
        self.envs.remove(member_id)
        self._episodes.remove(member_id)
        self._forget(member_id)
        self._stale = True
        return member

    def member(self, member_id: str) -> Member[H]:
        """Return a member with its present weights."""
        self._write_back()
        (member,) = (item for item in self.members if item.member_id == member_id)
        return member

    def _write_back(self) -> None:
        if self._is_written:
            return
        for group in self._groups:
            group.write_back()
        self._is_written = True

    def _begin(self, member: Member[H], max_env_steps: int | None) -> None:
        """Make room for what the algorithm keeps for a member besides its weights.

        Raises:
            MemoryError: There is not enough memory; then the member is not added.
        """

    def _forget(self, member_id: str) -> None:
        """Free what `_begin` made."""

    def train_iteration(self) -> dict[str, MemberStats]:
        """Train every member for a whole iteration."""
        self.begin_iteration()
        return self.finish_iteration()

    @abstractmethod
    def begin_iteration(self) -> None:
        """Begin an iteration of every member.

        On a GPU the updates may still run when this returns, so that another stack can sample meanwhile.
        """

    @abstractmethod
    def finish_iteration(self) -> dict[str, MemberStats]:
        """End the iteration and return its results by member id. Members in `PackedEnvs.errors` have failed."""


AnyStack = Stack[Any, Any, Any]
"""A stack of either algorithm."""
