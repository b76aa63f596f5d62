"""The protocol of schedulers, which decide by the trials' results which of them continue.

A *scheduler* here knows trials by their ids, and what each has reached. It knows nothing of processes or of Ray Tune's
trials and controller, so that the same scheduler decides for members of packs and for single trials.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from tune_jobs.store.progress import Progress

WORST_SCORE = -1e300
"""The score for an evaluation that is not a finite number: it must lose every comparison, but NaN loses none, since
`nan < cutoff` is False."""


def is_unscored(score: float) -> bool:
    """Whether an evaluation was not a finite number."""
    return math.isnan(score) or score <= WORST_SCORE


@dataclass(frozen=True)
class Standing:
    """What a trial has reached."""

    trial_id: str
    num_env_steps: int
    score: float
    """Its newest evaluation return, or `WORST_SCORE` if that is not a finite number or there is none."""
    evaluated: bool
    """Whether the evaluation was made at `num_env_steps`; an older score says nothing about this number of steps."""

    @classmethod
    def of(cls, trial_id: str, progress: Progress) -> Standing:
        """Return a trial's standing by its progress."""
        return cls(trial_id, progress.num_env_steps, score_of(progress), progress.evaluated)


def score_of(progress: Progress) -> float:
    """Return the score that a trial is compared by."""
    return WORST_SCORE if progress.evaluation_return is None else progress.evaluation_return


class Decision(Enum):
    """What a trial does after its report."""

    GO_ON = "go on"
    STOP = "stop"
    GIVE_WAY = "give way"
    """It pauses, and continues after the trials that wait for a place."""
    WAIT = "wait"
    """It saves and waits for other trials until the scheduler lets it continue or ends it."""
    SAVE = "save"
    """It saves and continues: other trials may be told to continue from its checkpoint."""


@dataclass(frozen=True)
class CopyFrom:
    """The decision that a trial continues from a copy of another's latest checkpoint, with other values."""

    trial_id: str
    """The trial to copy from."""
    point: dict[str, Any]
    """The searched values that the trial continues with."""
    values_of: str | None = None
    """The trial whose values these are; None: they are new."""


class Others(Protocol):
    """What a scheduler may ask about the trials other than the one that reports."""

    def wait(self) -> bool:
        """Whether any of them waits for a place, which the reporting trial could give up."""
        ...

    def ended(self) -> Collection[str]:
        """Return the trials that have ended by now, for whatever reason."""
        ...


class NobodyWaits:
    """The other trials of a member of a pack, where places are not given up and no scheduler asks what has ended."""

    def wait(self) -> bool:
        """Return False: no place is given up for another trial."""
        return False

    def ended(self) -> Collection[str]:
        """Return nothing, because no scheduler asks this in packs."""
        return ()


class Scheduler(Protocol):
    """Compares trials, and decides which of them go on."""

    def begins(self, trial_id: str) -> None:
        """Note that a trial will run; it is called once per trial, before any other call about it."""
        ...

    def reached(self, standing: Standing, others: Others) -> Decision | CopyFrom:
        """Decide what a running trial does next, by what it has reached."""
        ...

    def ended(self, standing: Standing) -> None:
        """Note that a trial ended, by itself or because it was stopped; this is the last call for a trial."""
        ...


class EveryoneGoesOn:
    """The scheduler of a sweep that compares no trials; see `Scheduler`."""

    def begins(self, trial_id: str) -> None:
        """Do nothing, because trials are not compared."""

    def reached(self, standing: Standing, others: Others) -> Decision:  # noqa: ARG002 (it compares nothing)
        """Let every trial continue."""
        return Decision.GO_ON

    def ended(self, standing: Standing) -> None:
        """Do nothing, because trials are not compared."""
