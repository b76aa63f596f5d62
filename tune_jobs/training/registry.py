"""Make engines by their names, find the engine of a checkpoint, and restore checkpoints.

The table is `tune_jobs.spec.engines`. The modules that it names are imported here, only when they are used: the driver
of a sweep needs neither RLlib nor torch, and a pack's process needs no ray.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from policies.errors import CheckpointError
from tune_jobs.spec.engines import ENGINES, Engine, engine_named
from tune_jobs.store.manifests import read_engine_name
from tune_jobs.training.protocol import PackEngine, TrainingEngine

if TYPE_CHECKING:
    from policies.packed.envs.vector import EnvKind


def make_engine(name: str) -> TrainingEngine:
    """Make an engine that trains one trial at a time."""
    return cast("TrainingEngine", _loaded(engine_named(name).constructor)())


def make_pack_engine(name: str, *, env_kind: EnvKind, num_env_processes: int) -> PackEngine:
    """Make an engine that trains packs.

    Args:
        name: The engine's name.
        env_kind: How its environments are stepped; see `PackPlan`.
        num_env_processes: Processes that step them.
    """
    made = _loaded(engine_named(name).constructor)(env_kind=env_kind, num_env_processes=num_env_processes)
    return cast("PackEngine", made)


def engine_of_checkpoint(checkpoint: Path) -> Engine:
    """Return the engine that wrote a checkpoint, by its manifest or, for an old one, by the folder's content.

    Raises:
        NotFoundError: The folder is missing.
        CheckpointError: The manifest is damaged, or this tune-jobs does not have the engine.
    """
    name = read_engine_name(checkpoint)
    if name is not None:
        return engine_named(name, f"The manifest of checkpoint {checkpoint}")
    for engine in ENGINES:
        if engine.old_state is not None and (checkpoint / engine.old_state).exists():
            return engine
    raise CheckpointError(
        f"Checkpoint {checkpoint} does not hold the state of any engine of this tune-jobs.",
        "Use another checkpoint of the trial.",
    )


def restore_checkpoint(checkpoint: Path, engine: Engine) -> Any:
    """Restore a checkpoint as an RLlib `Algorithm` that can continue training.

    What this process draws at random elsewhere is as it would have been without.

    Args:
        checkpoint: Its folder; callers check the manifest's hashes first.
        engine: Its engine, which must be able to restore.

    Raises:
        CheckpointError: It cannot be restored with exactly the weights that were saved.
    """
    # Not needed to train.
    from tune_jobs.process.state import randomness_given_back

    assert engine.restore is not None
    restore = _loaded(engine.restore)
    # From here on, as torch is loaded with it.
    with randomness_given_back():
        return restore(checkpoint)


def _loaded(path: str) -> Any:
    """Import and return what `module:name` names."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)
