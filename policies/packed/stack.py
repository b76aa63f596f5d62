"""What a stack is: members of a pack that share one tensor program."""

from __future__ import annotations

from typing import Protocol

from policies.hyperparams import DQNHyperparams, TrainedHyperparams
from policies.packed.envs.vector import PackedEnvs
from policies.packed.member import Member, MemberStats


class Stack(Protocol):
    """Trains its members together. They may come and go between iterations; the others do not notice.

    They are equal in `tune_jobs.plan.engine_choice.pack_key` and in the environment.
    """

    envs: PackedEnvs
    members: list[Member]
    """In the order of their rows."""

    def add(self, member: Member, env_seed: int) -> None:
        """A further member; its episodes begin.

        Raises:
            EnvError: Its environments cannot be made or reset; it is no member then.
        """
        ...

    def remove(self, member_id: str) -> Member:
        """Take a member out, with its weights as they are now."""
        ...

    def member(self, member_id: str) -> Member:
        """A member, with its weights as they are now."""
        ...

    def train_iteration(self) -> dict[str, MemberStats]:
        """An iteration of every member from beginning to end."""
        ...

    def begin_iteration(self) -> None:
        """Begin an iteration of every member.

        On a GPU the updates may go on when this returns: time for another stack to sample.
        """
        ...

    def finish_iteration(self) -> dict[str, MemberStats]:
        """End the iteration that was begun; what it gave, by id. Members in `PackedEnvs.errors` have failed."""
        ...


def make_stack(hyperparams: TrainedHyperparams, envs: PackedEnvs, device: str = "cpu") -> Stack:
    """A stack without members, for such hyperparameters."""
    if isinstance(hyperparams, DQNHyperparams):
        from policies.packed.dqn.stack import DQNStack

        return DQNStack(envs, device)
    from policies.packed.ppo.stack import PPOStack

    return PPOStack(envs, device)
