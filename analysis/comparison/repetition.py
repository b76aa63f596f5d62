"""A training beside its repetition: equal in every iteration, or from where on it differs, and what may be why."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analysis.records import IterationRecord
from analysis.wording import counted, shown_path

_COMPARED = (
    "num_env_steps", "num_episodes", "episode_returns", "episode_lengths", "training_return", "evaluation_return",
)  # fmt: skip
_NOT_SET = "not set"


@dataclass(frozen=True)
class Changed:
    """Something that was otherwise when the training ran first; texts, as they were recorded."""

    what: str
    recorded: str
    now: str


@dataclass(frozen=True)
class Repetition:
    """What came of running a trial again."""

    name: str
    """`SWEEP/TRIAL`."""
    num_iterations: int
    """Those that are recorded."""
    num_compared: int
    """How many of them could be repeated, from the first one on."""
    first_difference: int | None
    """The first iteration that differs; None: none does."""
    differences: tuple[Changed, ...]
    """What differs in that iteration."""
    num_equal_weights: int
    """Checkpoints that are kept of both and hold the same weights."""
    num_other_weights: int
    """Checkpoints that are kept of both and hold other weights."""
    causes: tuple[Changed, ...]
    """CPU, versions and the like that are others now, whether or not the numbers are."""
    notes: tuple[str, ...]
    knows_cpu: bool = True
    """Whether CPU and environment variables were recorded; False: versions alone, by an older version."""
    folder: Path | None = None
    """Where the repetition is kept; None: it was removed."""

    @property
    def equal(self) -> bool:
        """Whether everything that was compared is equal."""
        return self.first_difference is None and not self.num_other_weights

    @property
    def verdict(self) -> str:
        """The result in a sentence."""
        if self.first_difference is not None:
            return f"{self.name} differs from iteration {self.first_difference:,} of {self.num_iterations:,} on."
        if self.num_other_weights:
            return (
                f"{self.name} has the same numbers, but other weights in "
                f"{counted(self.num_other_weights, 'checkpoint')}."
            )
        which = "all" if self.num_compared == self.num_iterations else f"the first {self.num_compared:,} of"
        weights = self.num_equal_weights
        more = f", and the weights of {counted(weights, 'kept checkpoint')}" if weights else ""
        return f"{self.name}: {which} {counted(self.num_iterations, 'iteration')} are equal{more}."

    def lines(self) -> list[str]:
        """Return what follows the verdict: what differs, what may be the cause, and the notes."""
        lines = [f"{item.what}: {item.recorded} was recorded, now {item.now}" for item in self.differences]
        if self.causes:
            lines.append("What is other than it was:" if self.equal else "What is other than it was, and may be why:")
            lines += [f"  {item.what}: {item.recorded}; now {item.now}" for item in self.causes]
        elif not self.equal:
            known = "CPU, versions and environment variables are" if self.knows_cpu else "Versions are"
            other = "" if self.knows_cpu else "CPU or environment variables may be others, "
            lines.append(
                f"{known} those that were recorded: {other}the environment may draw numbers that its seed does not "
                "decide, or code has changed."
            )
        lines += list(self.notes)
        return lines if self.folder is None else [*lines, f"The repetition is in {shown_path(self.folder)}."]


def first_difference(
    recorded: Sequence[IterationRecord], repeated: Sequence[IterationRecord], *, may_lack_evaluation: bool
) -> tuple[int, tuple[Changed, ...]] | None:
    """Return the first iteration that differs, and how; None: all recorded ones are equal, but for the time they took.

    Args:
        recorded: Iterations, oldest first.
        repeated: The same of the repetition; more than are recorded don't count.
        may_lack_evaluation: Whether the last recorded iteration need not have been evaluated, as the trial was ended
            there, and the repetition ended by itself.
    """
    by_number = {item.iteration: item for item in repeated}
    learned = _learned_in_both(recorded, repeated)
    for item in recorded:
        other = by_number.get(item.iteration)
        if other is None:
            return item.iteration, (Changed("iteration", "present", "missing"),)
        names = [name for name in _COMPARED if not _same(getattr(item, name), getattr(other, name))]
        if may_lack_evaluation and item is recorded[-1] and item.evaluation_return is None:
            names = [name for name in names if name != "evaluation_return"]
        changed = [Changed(name, *_shown(getattr(item, name), getattr(other, name))) for name in names]
        changed += [
            Changed(f"learner/{name}", *_shown(item.learner.get(name), other.learner.get(name)))
            for name in sorted(learned)
            if not _same(item.learner.get(name), other.learner.get(name))
        ]
        if changed:
            return item.iteration, tuple(changed)
    return None


def same_numbers(
    one: Sequence[IterationRecord], other: Sequence[IterationRecord], *, are_evaluated_alike: bool
) -> bool:
    """Whether two trainings have the same numbers in all iterations that both have; False if that is none.

    Args:
        one: Iterations, oldest first.
        other: Those of the other.
        are_evaluated_alike: Whether both are evaluated on the same seeds; where not, evaluations say nothing.
    """
    by_number = {item.iteration: item for item in other}
    both = [(item, by_number[item.iteration]) for item in one if item.iteration in by_number]
    learned = _learned_in_both(one, other)
    return bool(both) and all(_are_same(*pair, learned, are_evaluated_alike=are_evaluated_alike) for pair in both)


def _learned_in_both(one: Sequence[IterationRecord], other: Sequence[IterationRecord]) -> set[str]:
    """Return the names of the learner's numbers in two trainings; one version may have some that another lacks."""
    ours, theirs = ({name for item in training for name in item.learner} for training in (one, other))
    return ours & theirs


def _are_same(
    one: IterationRecord, other: IterationRecord, learned: Collection[str], *, are_evaluated_alike: bool
) -> bool:
    names = [name for name in _COMPARED if name != "evaluation_return"]
    # One of them may be evaluated less often.
    if are_evaluated_alike and None not in (one.evaluation_return, other.evaluation_return):
        names.append("evaluation_return")
    return all(_same(getattr(one, name), getattr(other, name)) for name in names) and all(
        _same(one.learner.get(name), other.learner.get(name)) for name in learned
    )


def causes(recorded: Mapping[str, str], now: Mapping[str, str]) -> tuple[Changed, ...]:
    """Return what a training ran with that is other now.

    Args:
        recorded: `ran_with` of the trial's record, or what of it is known.
        now: The same of the repetition.
    """
    # Of an old record only the versions are known.
    more = [name for name in now if name not in recorded] if "cpu" in recorded else []
    return tuple(
        Changed(name, recorded.get(name, _NOT_SET), now.get(name, _NOT_SET))
        for name in (*recorded, *more)
        if recorded.get(name) != now.get(name)
    )


def _same(one: Any, other: Any) -> bool:
    """Whether two values are equal; NaN is equal to itself."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    return bool(one == other or (one != one and other != other))  # noqa: PLR0124 (NaN alone is not equal to itself)


def _shown(one: Any, other: Any) -> tuple[str, str]:
    """Return two different values as texts; of lists where they differ first."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        if len(one) != len(other):
            return f"{len(one)} episodes", f"{len(other)}"
        place = next(index for index, pair in enumerate(zip(one, other, strict=True)) if not _same(*pair))
        return f"{one[place]!r} (episode {place + 1})", f"{other[place]!r}"
    return repr(one), repr(other)
