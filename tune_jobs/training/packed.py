"""The `packed` engine: it trains many trials in one process, their networks stacked into one tensor program."""

from __future__ import annotations

import json
from collections.abc import Hashable
from pathlib import Path
from typing import cast

import torch

from policies import random_streams
from policies.errors import CheckpointError
from policies.hyperparams import Algorithm, TrainedHyperparams, make_hyperparams
from policies.packed.envs.make import choose_kind, make_packed_envs, measure_step
from policies.packed.envs.vector import EnvKind
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from policies.packed.member import AnyMember
from policies.packed.portable_member import portable_policy
from policies.packed.stack import AnyStack
from policies.packed.state import STATE_FOLDER, check_shapes, load_member, save_member
from policies.portable.file import PortablePolicy
from tune_jobs.plan.engine_choice import pack_key
from tune_jobs.store.names import TRIAL_RECORD
from tune_jobs.training.devices import device_for
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
            env_seed = task.seed
            if checkpoint is not None:
                member = _restored(member, checkpoint)
                # Other seeds than at the trial's start, because its environments begin new episodes.
                env_seed = random_streams.member_env_seed_after(task.seed, member.num_iterations)
            member.failure_penalty = task.failure_penalty
            stack.add(member, env_seed)
        except BaseException:
            if is_new:
                stack.envs.close()
            raise
        self._stacks[key] = stack
        self._tasks[task.trial_id] = (task, key)

    def _place(self, task: TrialTask, hyperparams: TrainedHyperparams, device: str) -> Hashable:
        """Return the key of the stack for a new member: the one of its kind with the fewest members."""
        kind = (pack_key(hyperparams), task.env_id, json.dumps(task.env_args), task.failure_penalty)
        num_turns = self._num_turns or (2 if device.startswith("cuda") else 1)

        def num_members(key: Hashable) -> int:
            stack = self._stacks.get(key)
            return 0 if stack is None else len(stack.members)

        return min(((*kind, turn) for turn in range(num_turns)), key=num_members)

    def _make_stack(self, task: TrialTask, hyperparams: TrainedHyperparams, device: str) -> AnyStack:
        kind = self._env_kind or choose_kind(measure_step(task.env_id, task.env_args), spare_cpus=0).kind
        envs = make_packed_envs(
            task.env_id,
            task.env_args,
            hyperparams.num_envs,
            failure_penalty=task.failure_penalty,
            kind=kind,
            num_processes=self._num_env_processes,
        )
        return make_stack(hyperparams, envs, device)

    def train_iteration(self) -> dict[str, IterationStats | Exception]:
        """Train every member for one iteration; the stacks take turns."""
        results: dict[str, IterationStats | Exception] = {}
        for stack in self._stacks.values():
            stack.begin_iteration()
        for stack in self._stacks.values():
            for trial_id, stats in stack.finish_iteration().items():
                error = stack.envs.errors.get(trial_id)
                results[trial_id] = error or IterationStats(stats.num_env_steps, stats.episodes, stats.learner)
        return results

    def policy(self, trial_id: str) -> PortablePolicy:
        """Return the current greedy policy of a member."""
        task, stack = self._member_of(trial_id)
        member = stack.member(trial_id)
        training = {
            "trial_id": trial_id,
            "seed": task.seed,
            "hyperparams": task.hyperparams,
            "iteration": member.num_iterations,
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
        if not stack.members:
            stack.envs.close()
            del self._stacks[key]

    def close(self) -> None:
        """Close the environments of all stacks."""
        for stack in self._stacks.values():
            stack.envs.close()
        self._stacks.clear()
        self._tasks.clear()

    def _member_of(self, trial_id: str) -> tuple[TrialTask, AnyStack]:
        task, key = self._tasks[trial_id]
        return task, self._stacks[key]


def _restored(fresh: AnyMember, checkpoint: Path) -> AnyMember:
    """Return the member of a checkpoint, if it has the same network as a fresh one."""
    folder = checkpoint / STATE_FOLDER
    if not folder.is_dir():
        raise CheckpointError(
            f"Checkpoint {checkpoint} has no folder {STATE_FOLDER!r}: the packed engine did not write it.",
            "Resume the trial with the engine it began on.",
        )
    member = load_member(folder, fresh.member_id)
    if member.hyperparams != fresh.hyperparams or member.seed != fresh.seed:
        raise CheckpointError(
            f"Checkpoint {checkpoint} has other hyperparameters or another seed than trial {fresh.member_id}.",
            f"Restore {TRIAL_RECORD}, or use another checkpoint of the trial.",
        )
    check_shapes(member, fresh.weights)
    return member
