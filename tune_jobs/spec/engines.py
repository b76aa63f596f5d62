"""The engines: what each can train, why it can't train the rest, and where its code is.

The one table of them. A further engine is one more entry and the module that the entry names; everything else, the
fields of the sweep file, the plan, the processes of trials and packs, checkpoints and `restore`, goes by the table.

Code is named by text and loaded by `tune_jobs.training.registry` where it is needed: the table itself is looked at by
whoever reads a sweep file, and loads neither ray nor torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from policies.errors import CheckpointError
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, RandomHyperparams

Need = Literal["rl_module", "convolutions", "env_runners", "copies", "pauses", "unseeded"]
"""What a sweep or a trial may need of its engine: an RLModule of the user's own; convolutions; env runners in processes
of their own; to go on from copies of other trials' checkpoints; to be paused until others have come as far; an
environment whose episodes don't follow from its seeds."""


@dataclass(frozen=True)
class Engine:
    """One engine: an entry of the table."""

    name: str
    """In sweep files, in records of trials and in manifests of checkpoints."""
    title: str
    """The subject of "... trains them all" in messages."""
    trained: str
    """What messages call a trial of it: "t0001 is not ..."."""
    about: str
    """A line for the sweep file's schema."""
    algorithms: frozenset[str]
    """Those that it trains at all."""
    constructor: str
    """`module:Class` of a `TrainingEngine`, made without arguments, or of a `PackEngine`."""
    restore: str | None = None
    """`module:function`, checkpoint folder -> RLlib `Algorithm` that trains on from it; None: there is none."""
    trains_many: bool = False
    """Whether it is a `PackEngine`."""
    lacks: Mapping[Need, str] = field(default_factory=dict)
    """What it cannot give a trial, and why not, as the end of a sentence that begins with the setting that needs it; it
    is empty where that beginning says all."""
    can_be_asked_for: bool = True
    """Whether the sweep file's `engine` may name it."""
    gives_way: bool = False
    """Whether a sweep that names it though it does not train the algorithm is no error, but trained by another."""
    old_state: str | None = None
    """A file or folder that tells its checkpoints, where a manifest is from before manifests named engines; None: there
    were none then."""

    def why_not(self, need: Need, setting: str) -> str | None:
        """Why it cannot train what has a need, as a sentence without its full stop, or None if it can.

        Args:
            need: What is needed.
            setting: What needs it, as "rl_module is nets:Net": the sentence begins so.
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
            "convolutions": "and packs have no convolutions",
            "env_runners": "and packs have no env runners",
            "copies": "whose trials go on from copies of each other",
            "pauses": "which pauses trials until others have come as far",
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
        # It is asked for as "not packed", which baselines never are.
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
"""In the order in which a trial is offered to them. The last one that trains an algorithm takes what no other can."""


def find_engine(name: str) -> Engine | None:
    """The engine of a name, or None."""
    return next((engine for engine in ENGINES if engine.name == name), None)


def engine_named(name: str, where: str = "A record") -> Engine:
    """The engine of a name that was read from a file.

    Args:
        name: Its name.
        where: What the file is called in the message.

    Raises:
        CheckpointError: There is none of this name.
    """
    engine = find_engine(name)
    if engine is None:
        known = ", ".join(each.name for each in ENGINES)
        raise CheckpointError(
            f"{where} names the engine {name[:80]!r}, which this tune-jobs does not have; it has {known}.",
            "Upgrade tune-jobs: `pip install --upgrade tune-jobs`.",
        )
    return engine


def engines_for(algorithm: str) -> tuple[Engine, ...]:
    """Those that train an algorithm, in the order in which trials are offered to them."""
    return tuple(engine for engine in ENGINES if algorithm in engine.algorithms)


def engine_on_record(name: str, algorithm: str) -> Engine:
    """The engine that goes on with a trial whose record names one.

    Args:
        name: As the record says; one of before engines were named reads as rllib, whatever the algorithm is.
        algorithm: Of the trial.

    Raises:
        CheckpointError: There is no such engine.
    """
    engine = engine_named(name, "A trial's record")
    return engine if algorithm in engine.algorithms else engines_for(algorithm)[-1]
