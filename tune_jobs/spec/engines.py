"""The table of engines: what each can train, why it can't train the rest, and where its code is.

A new engine needs one more entry and the module that the entry names. Everything else uses the table: the fields of the
sweep file, the plan, the processes of trials and packs, checkpoints and `restore`.

Code is named by strings and loaded by `tune_jobs.training.registry` where it is needed, because the table is also used
to read sweep files, which loads neither ray nor torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from policies.errors import UPGRADE, CheckpointError
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, RandomHyperparams

Need = Literal["rl_module", "convolutions", "large_images", "env_runners", "copies", "pauses", "unseeded"]
"""What a sweep or a trial may need from its engine: an RLModule of the user's own; convolutions; those of large images,
without a GPU and where the engine isn't asked for; env runners in processes of their own; to continue from copies of
other trials' checkpoints; to be paused until others have reached the same env steps; an environment whose episodes
don't follow from its seeds."""


@dataclass(frozen=True)
class Engine:
    """One engine: an entry of the table."""

    name: str
    """The name in sweep files, in records of trials and in manifests of checkpoints."""
    title: str
    """The subject of "... trains them all" in messages."""
    trained: str
    """The words for a trial of this engine in messages: "t0001 is not ..."."""
    about: str
    """A description in one line, for the sweep file's schema."""
    algorithms: frozenset[str]
    """The algorithms that it can train."""
    constructor: str
    """`module:Class` of a `TrainingEngine`, which is made without arguments, or of a `PackEngine`."""
    restore: str | None = None
    """`module:function` that turns a checkpoint folder into an RLlib `Algorithm`; None: that is not possible."""
    trains_many: bool = False
    """Whether it is a `PackEngine`."""
    lacks: Mapping[Need, str] = field(default_factory=dict)
    """The needs that it does not fulfil, each with the reason: the end of a sentence that begins with the setting that
    needs it, or empty if that beginning is enough."""
    can_be_asked_for: bool = True
    """Whether the sweep file's `engine` may name it."""
    gives_way: bool = False
    """Whether another engine is used, without an error, if a sweep names this one but it cannot train the algorithm."""
    old_state: str | None = None
    """A file or folder by which its checkpoints are recognised if their manifests are too old to name engines; None:
    there are no such checkpoints."""

    def why_not(self, need: Need, setting: str) -> str | None:
        """Return why it does not fulfil a need, as a sentence without its full stop, or None if it does.

        Args:
            need: The need.
            setting: The setting that needs it, as the beginning of a sentence: "rl_module is nets:Net".
        """
        if need not in self.lacks:
            return None
        return ", ".join(part for part in (setting, self.lacks[need]) if part)


_LEARNING = frozenset(
    name for name, values in HYPERPARAMS_BY_ALGORITHM.items() if not issubclass(values, RandomHyperparams)
)

ENGINES: tuple[Engine, ...] = (
    Engine(
        name="packed",
        title="the packed engine",
        trained="packed",
        about="many trials at once in each process",
        algorithms=_LEARNING,
        constructor="tune_jobs.training.packed:PackedEngine",
        restore="policies.packed.to_rllib:algorithm_from_checkpoint",
        trains_many=True,
        lacks={
            "rl_module": "and packs have no networks but their own",
            "large_images": "and without a GPU packs are the faster engine up to 300,000",
            "env_runners": "and packs have no env runners",
            "unseeded": "",
        },
        old_state="packed",
    ),
    Engine(
        name="rllib",
        title="RLlib",
        trained="trained by RLlib",
        about="each trial in a process of its own, by RLlib",
        algorithms=_LEARNING,
        constructor="tune_jobs.training.rllib:RLlibEngine",
        restore="tune_jobs.training.rllib:algorithm_from_checkpoint",
        # A sweep that names this engine asks for trials that are not packed, which is always so for baselines.
        gives_way=True,
        old_state="rllib",
    ),
    Engine(
        name="baseline",
        title="the baseline engine",
        trained="played as a baseline",
        about="plays with a policy that does not learn",
        algorithms=frozenset(HYPERPARAMS_BY_ALGORITHM) - _LEARNING,
        constructor="tune_jobs.training.baseline:BaselineEngine",
        can_be_asked_for=False,
        old_state="baseline.json",
    ),
)
"""The engines, in the order in which they are tried. The last one for an algorithm can train what no other can."""


def find_engine(name: str) -> Engine | None:
    """Return the engine of a name, or None if there is none."""
    return next((engine for engine in ENGINES if engine.name == name), None)


def engine_named(name: str, where: str = "A record") -> Engine:
    """Return the engine of a name that was read from a file.

    Args:
        name: The engine's name.
        where: The file's name for the message.

    Raises:
        CheckpointError: There is no engine of this name.
    """
    engine = find_engine(name)
    if engine is None:
        known = ", ".join(each.name for each in ENGINES)
        raise CheckpointError(
            f"{where} names the engine {name[:80]!r}, which this tune-jobs does not have; it has {known}.",
            UPGRADE,
        )
    return engine


def engines_for(algorithm: str) -> tuple[Engine, ...]:
    """Return the engines that can train an algorithm, in the order in which they are tried."""
    return tuple(engine for engine in ENGINES if algorithm in engine.algorithms)


def engine_on_record(name: str, algorithm: str) -> Engine:
    """Return the engine that continues a trial, by its record.

    Args:
        name: The engine's name in the record; old records without one read as rllib for every algorithm.
        algorithm: The trial's algorithm.

    Raises:
        CheckpointError: There is no such engine.
    """
    engine = engine_named(name, "A trial's record")
    return engine if algorithm in engine.algorithms else engines_for(algorithm)[-1]
