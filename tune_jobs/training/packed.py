"""The `packed` engine: it trains many trials in one process, their networks stacked into one tensor program."""

from __future__ import annotations

import itertools
import json
from collections.abc import Collection, Hashable, Sequence
from pathlib import Path
from typing import Any, cast

import torch

from policies import random_streams
from policies.hyperparams import Algorithm, TrainedHyperparams, make_hyperparams
from policies.packed.envs.make import choose_kind, make_packed_envs, measure_step
from policies.packed.envs.vector import EnvKind
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from policies.packed.member import AnyMember
from policies.packed.portable_member import portable_policy
from policies.packed.stack import AnyStack
from policies.packed.state import STATE_FOLDER, save_member
from policies.portable.file import PortablePolicy
from tune_jobs.plan.engine_choice import pack_key
from tune_jobs.plan.estimates import most_env_steps_until
from tune_jobs.training.devices import device_for
from tune_jobs.training.packed_restore import restored_member
from tune_jobs.training.protocol import IterationStats, TrialTask


class PackedEngine:
    """The engine of packs; implements `PackEngine`.

    Trials that cannot share a stack get stacks of their own, which take turns.

    Args:
        env_kind: How environments are stepped; None: `choose_kind` decides by a measurement.
        num_env_processes: Processes for environments, if the kind uses any.
        device: Where updates are computed; None: on a GPU if the trials are given one, else on the CPU.
        num_turns: The number of stacks that trials of one kind are spread over: one samples on the CPU while another's
            updates run on the GPU. None: two with a GPU, else one.
    """

    def __init__(
        self,
        env_kind: EnvKind | None = None,
        num_env_processes: int = 0,
        device: str | None = None,
        num_turns: int | None = None,
    ) -> None:
        # Small networks are up to several times slower on more than one thread, and packs share the cores.
        torch.set_num_threads(1)
        self._env_kind, self._num_env_processes, self._device = env_kind, num_env_processes, device
        self._num_turns = num_turns
        self._stacks: dict[Hashable, AnyStack] = {}
        self._tasks: dict[str, tuple[TrialTask, Hashable]] = {}
        self._before: dict[str, tuple[int, int]] = {}
        """Env steps and iterations of a trial that its member does not count; negative if it counts another's."""
        self._num_stacks = itertools.count()
        # Of all stacks: one whose members all fail is gone, and they are added to another.
        self._suspects: set[str] = set()
        self.moved: Collection[str] = ()
        """The members that the last iteration moved to another stack."""

    def add(self, task: TrialTask, checkpoint: Path | None) -> None:
        """Add a trial, fresh or exactly as a checkpoint folder holds it."""
        # The values were validated with the sweep file; this turns JSON back into the typed object.
        hyperparams = cast("TrainedHyperparams", make_hyperparams(cast("Algorithm", task.algorithm), task.hyperparams))
        device = self._device or device_for(task.num_gpus)
        key = self._place(task, hyperparams, device)
        is_new = key not in self._stacks
        stack = self._stacks.get(key) or self._make_stack(task, hyperparams, device)
        try:
            space, action_space = stack.envs.observation_space, stack.envs.action_space
            member = new_member(task.trial_id, hyperparams, task.seed, space, action_space)
            env_seed, before = task.seed, (0, 0)
            if checkpoint is not None:
                member = restored_member(member, checkpoint, task, space)
                if task.changes:
                    before = (task.num_env_steps - member.num_env_steps, task.num_iterations - member.num_iterations)
                # Other seeds than at the trial's start, because its environments begin new episodes.
                env_seed = random_streams.member_env_seed_after(task.seed, before[1] + member.num_iterations)
            member.failure_penalty, member.atari_training = task.failure_penalty, task.atari_training
            stack.add(member, env_seed, _max_env_steps(task, hyperparams))
        except BaseException:
            if is_new:
                stack.envs.close()
            raise
        self._stacks[key] = stack
        self._tasks[task.trial_id] = (task, key)
        self._before[task.trial_id] = before

    def _place(self, task: TrialTask, hyperparams: TrainedHyperparams, device: str) -> Hashable:
        """Return the key of the stack for a new member: the one of its kind with the fewest members."""
        seen = json.dumps([task.env_args, task.failure_penalty, task.atari_training])
        kind = (pack_key(hyperparams), task.env_id, seen)
        num_turns = self._num_turns or (2 if device.startswith("cuda") else 1)

        def num_members(key: Hashable) -> int:
            stack = self._stacks.get(key)
            return 0 if stack is None else len(stack.members)

        if not task.in_step:
            return min(((*kind, turn) for turn in range(num_turns)), key=num_members)
        # They come to a comparison in the same iteration, so that none of them waits there alone.
        done = (task.num_env_steps, task.num_iterations)
        same = [
            key
            for key, stack in self._stacks.items()
            if cast("tuple[Any, ...]", key)[:-1] == kind and self._done(stack.members[0]) == done
        ]
        return min(same, key=num_members) if len(same) >= num_turns else (*kind, next(self._num_stacks))

    def _done(self, member: AnyMember) -> tuple[int, int]:
        """Return the env steps and the iterations that a member's trial has done."""
        env_steps, iterations = self._before[member.member_id]
        return env_steps + member.num_env_steps, iterations + member.num_iterations

    def _make_stack(self, task: TrialTask, hyperparams: TrainedHyperparams, device: str) -> AnyStack:
        kind = self._env_kind or choose_kind(measure_step(task.env_id, task.env_args), spare_cpus=0).kind
        envs = make_packed_envs(
            task.env_id,
            task.env_args,
            hyperparams.num_envs,
            failure_penalty=task.failure_penalty,
            atari_training=task.atari_training,
            kind=kind,
            num_processes=self._num_env_processes,
            suspects=self._suspects,
        )
        return make_stack(hyperparams, envs, device)

    def train_iteration(self, held: Collection[str] = ()) -> dict[str, IterationStats | Exception]:
        """Train every member for one iteration, but those that are held; the stacks take turns."""
        results: dict[str, IterationStats | Exception] = {}
        self.moved = ()
        stacks = self._apart(held) if held else list(self._stacks.values())
        for stack in stacks:
            stack.begin_iteration()
        for stack in stacks:
            for trial_id, stats in stack.finish_iteration().items():
                error = stack.envs.errors.get(trial_id)
                num_env_steps = self._before[trial_id][0] + stats.num_env_steps
                results[trial_id] = error or IterationStats(num_env_steps, stats.episodes, stats.learner)
        return results

    def _apart(self, held: Collection[str]) -> list[AnyStack]:
        """Return the stacks to train, after the held members among theirs got a stack of their own."""
        found = []
        for key, stack in list(self._stacks.items()):
            waiting = [member.member_id for member in stack.members if member.member_id in held]
            if len(waiting) == len(stack.members):
                continue
            found.append(stack)
            if waiting:
                self._move(waiting, key)
        return found

    def _move(self, trial_ids: Sequence[str], key: Hashable) -> None:
        """Move members to a new stack, where they begin new episodes, as after a restore."""
        new = (*cast("tuple[Any, ...]", key)[:-1], next(self._num_stacks))
        for trial_id in trial_ids:
            task, _ = self._tasks[trial_id]
            member = self._stacks[key].remove(trial_id)
            if new not in self._stacks:
                self._stacks[new] = self._make_stack(
                    task, member.hyperparams, self._device or device_for(task.num_gpus)
                )
            env_seed = random_streams.member_env_seed_after(task.seed, self._done(member)[1])
            self._stacks[new].add(member, env_seed, _max_env_steps(task, member.hyperparams))
            self._tasks[trial_id] = (task, new)
        self.moved = (*self.moved, *trial_ids)

    def policy(self, trial_id: str) -> PortablePolicy:
        """Return the current greedy policy of a member."""
        task, stack = self._member_of(trial_id)
        member = stack.member(trial_id)
        training = {
            "trial_id": trial_id,
            "seed": task.seed,
            "hyperparams": task.hyperparams,
            "iteration": self._done(member)[1],
        }
        return portable_policy(
            member,
            stack.envs.observation_space,
            stack.envs.action_space,
            env_id=task.env_id,
            env_args=task.env_args,
            training=training,
        )

    def save(self, trial_id: str, folder: Path) -> None:
        """Write a member's state into an empty folder."""
        _, stack = self._member_of(trial_id)
        save_member(stack.member(trial_id), folder / STATE_FOLDER)

    def remove(self, trial_id: str) -> None:
        """Forget a member."""
        _, stack = self._member_of(trial_id)
        stack.remove(trial_id)
        _, key = self._tasks.pop(trial_id)
        del self._before[trial_id]
        if not stack.members:
            stack.envs.close()
            del self._stacks[key]

    def close(self) -> None:
        """Close the environments of all stacks."""
        for stack in self._stacks.values():
            stack.envs.close()
        self._stacks.clear()
        self._tasks.clear()
        self._before.clear()

    def _member_of(self, trial_id: str) -> tuple[TrialTask, AnyStack]:
        task, key = self._tasks[trial_id]
        return task, self._stacks[key]


def _max_env_steps(task: TrialTask, hyperparams: TrainedHyperparams) -> int:
    return most_env_steps_until(task.stop, hyperparams, num_env_runners=0)
