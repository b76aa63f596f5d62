"""What becomes of trials, by what they reached: the question that packs and Ray Tune ask, and who answers it.

A *scheduler* here knows trials by their names, and of each what it reached. It knows nothing of processes, of Ray
Tune's trials and of its controller, so that the same one decides for members of packs and for single trials.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from tune_jobs.store.progress import Progress

WORST_SCORE = -1e300
"""Of an evaluation that is not a finite number: it must lose every comparison, and NaN loses none (`nan < cutoff` is
False)."""


@dataclass(frozen=True)
class Standing:
    """What a trial has reached."""

    trial_id: str
    num_env_steps: int
    score: float
    """Its newest evaluation return; `WORST_SCORE`: that is not a finite number, or there is none."""
    evaluated: bool
    """Whether the evaluation is of this very moment: an older score says nothing of so many env steps."""

    @classmethod
    def of(cls, trial_id: str, progress: Progress) -> Standing:
        """Of a trial, by its progress."""
        return cls(trial_id, progress.num_env_steps, score_of(progress), progress.evaluated)


def score_of(progress: Progress) -> float:
    """What a trial is compared by."""
    return WORST_SCORE if progress.evaluation_return is None else progress.evaluation_return


class Decision(Enum):
    """What becomes of a trial that has told what it reached."""

    GO_ON = "go on"
    STOP = "stop"
    GIVE_WAY = "give way"
    """It goes on when those had a place that wait for one."""
    SAVE = "save"
    """It saves and goes on: others may be told to go on from it."""


@dataclass(frozen=True)
class CopyFrom:
    """It goes on from a copy of another's latest checkpoint, with other values."""

    trial_id: str
    """The other."""
    point: dict[str, Any]
    """The searched values it goes on with."""


class Others(Protocol):
    """What a scheduler may ask of the trials beside the one that tells."""

    def wait(self) -> bool:
        """Whether any of them waits for a place that this one could give up."""
        ...

    def ended(self) -> Collection[str]:
        """Those that have ended by now, however they did."""
        ...


class NobodyWaits:
    """In packs: places there are not given up for others, and no scheduler there asks who has ended."""

    def wait(self) -> bool:
        """See `Others.wait`."""
        return False

    def ended(self) -> Collection[str]:
        """See `Others.ended`."""
        return ()


class Scheduler(Protocol):
    """Compares trials, and decides which of them go on."""

    def begins(self, trial_id: str) -> None:
        """A trial will run: once, before anything else is told of it."""
        ...

    def reached(self, standing: Standing, others: Others) -> Decision | CopyFrom:
        """What becomes of a trial that runs, now that it has reached so much."""
        ...

    def ended(self, standing: Standing) -> None:
        """A trial ended there, by itself or because it was to stop: once, and nothing is told of it afterwards."""
        ...


class EveryoneGoesOn:
    """The scheduler of a sweep that compares no trials; see `Scheduler`."""

    def begins(self, trial_id: str) -> None:
        """See `Scheduler.begins`."""

    def reached(self, standing: Standing, others: Others) -> Decision:  # noqa: ARG002 (it compares nothing)
        """See `Scheduler.reached`."""
        return Decision.GO_ON

    def ended(self, standing: Standing) -> None:
        """See `Scheduler.ended`."""
