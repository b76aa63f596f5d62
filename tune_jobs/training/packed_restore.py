"""Restore a member of a pack from a checkpoint: as it was, or as a copy that goes on with a trial's own values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from policies import random_streams
from policies.envs.spaces import observation_dtype
from policies.errors import CheckpointError
from policies.networks.portable_weights import check_scale
from policies.packed.member import AnyMember
from policies.packed.state import STATE_FOLDER, check_shapes, load_member
from policies.portable.file import read_policy
from tune_jobs.store.names import TRIAL_RECORD
from tune_jobs.training.protocol import TrialTask


def restored_member(fresh: AnyMember, checkpoint: Path, task: TrialTask, space: gym.Space[Any]) -> AnyMember:
    """Return the member that a trial goes on with from a checkpoint.

    In a population the checkpoint may be another trial's, or have values from before a change. Weights, target
    network, statistics, the optimizer's moments and the counters, by which schedules go, are then the checkpoint's, as
    on engine `rllib`; hyperparameters, seed and random numbers are the trial's.

    Args:
        fresh: A new member of the trial.
        checkpoint: The checkpoint's folder, whose files were verified.
        task: The trial, with the iterations that it has done.
        space: What is observed.

    Raises:
        CheckpointError: The checkpoint is damaged, or is not the trial's, or has other networks, or networks that saw
            images times another factor.
    """
    folder = checkpoint / STATE_FOLDER
    if not folder.is_dir():
        raise CheckpointError(
            f"Checkpoint {checkpoint} has no folder {STATE_FOLDER!r}: the packed engine did not write it.",
            "Resume the trial with the engine it began on.",
        )
    member = load_member(folder, fresh.member_id)
    is_own = member.hyperparams == fresh.hyperparams and member.seed == fresh.seed
    if not is_own and not task.changes:
        raise CheckpointError(
            f"Checkpoint {checkpoint} has other hyperparameters or another seed than trial {fresh.member_id}.",
            f"Restore {TRIAL_RECORD}, or use another checkpoint of the trial.",
        )
    check_shapes(member, fresh.weights)
    if observation_dtype(space) == np.uint8:
        check_scale(space, read_policy(checkpoint).network)
    if is_own:
        return member
    rng = random_streams.member_draws_after(task.seed, task.num_iterations)
    return replace(member, hyperparams=fresh.hyperparams, seed=fresh.seed, rng=rng)
