"""The result of a launch, resume or extend."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from analysis.answers import nothing_learned
from analysis.best_records import BestRecord
from analysis.notebook import brief_repr, facts_html
from analysis.records import SweepRecord, SweepState, TrialRecord, TrialStatus
from analysis.report_data import is_trained
from analysis.wording import counted, return_text
from tune_jobs.process.interruption import EXIT_CODE as INTERRUPTED
from tune_jobs.sweeps.storage import folder_at, shown_place

Film = Literal["before_mp4", "after_mp4", "after_gif", "before_after_mp4"]
"""What a film of a sweep's best policy is called; before is a random policy."""
Progress = Literal["auto", "none"]
"""Whether a person is shown how far something is."""


@dataclass(frozen=True)
class SweepResult:
    """The result of a launch, resume or extend: the trials' records, and the paths of what was made."""

    place: str = field(metadata={"json": "folder"})
    """Where the sweep is: its folder, or its URL in an object store."""
    sweep: SweepRecord
    trials: list[TrialRecord]
    best: BestRecord | None = None
    why_no_best: str | None = None
    artifacts: dict[str, Path] = field(default_factory=dict)
    """The path of each result: policy, before_mp4, after_mp4, after_gif, before_after_mp4, report."""
    interrupted: bool = False
    notes: tuple[str, ...] = ()
    """Notes on what could not be made, and why, such as a video of an environment that can't be drawn."""
    finish_failed: bool = False
    """Whether no winner could be confirmed, or the environment failed where it was filmed."""

    @property
    def folder(self) -> Path:
        """The sweep's folder.

        Raises:
            SpecError: The sweep is in an object store, and has none.
        """
        return folder_at(self.place)

    @property
    def state(self) -> SweepState:
        """The sweep's state, as `SweepStatus.state` has it."""
        return self.sweep.state

    @property
    def counts(self) -> dict[TrialStatus, int]:
        """The number of trials of each status, without those of which there is none."""
        return dict(Counter(trial.status for trial in self.trials))

    @property
    def exit_code(self) -> int:
        """130 if it was interrupted, 3 if a trial or what comes after the trials failed, else 0."""
        if self.interrupted:
            return INTERRUPTED
        return 3 if self.finish_failed or any(trial.status == "failed" for trial in self.trials) else 0

    def __repr__(self) -> str:
        best = self.best and f"{self.best.checkpoint.trial_id} scored {return_text(self.best.selection_score)}"
        return brief_repr(
            "SweepResult", place=self.place, state=self.state, counts=self.counts, best=best,
            why_no_best=self.why_no_best, artifacts=list(self.artifacts), exit_code=self.exit_code,
        )  # fmt: skip

    def _repr_html_(self) -> str:
        told = ", ".join(f"{number} {status}" for status, number in self.counts.items())
        steps = sum(trial.num_env_steps for trial in self.trials)
        facts: dict[str, str | Path] = {
            "trials": f"{counted(len(self.trials), 'trial')}: {told or 'none'}; {counted(steps, 'env step')}"
        }
        if self.why_no_best is not None:
            facts["no best policy"] = self.why_no_best
        failed = [trial for trial in self.trials if trial.status == "failed"]
        if failed:
            facts["first failure"] = f"{failed[0].trial_id}: {failed[0].error or 'no error recorded'}"
        facts |= {"folder": shown_place(self.place)} | {
            name.replace("_", " "): path for name, path in self.artifacts.items()
        }
        facts |= {f"note {number}": note for number, note in enumerate(self.notes, start=1)}
        state = "interrupted" if self.interrupted else self.sweep.state
        best = "" if self.best is None else self.best._repr_html_()
        return facts_html(f"Sweep {self.sweep.name}: {state}", facts) + best


def notes_on_best(sweep: SweepRecord, best: BestRecord | None) -> tuple[str, ...]:
    """Return a note where training has not led beyond random play: all else is said in the tone of a result."""
    if best is None or not is_trained(sweep):
        return ()
    told = nothing_learned(best)
    return (told,) if told else ()
