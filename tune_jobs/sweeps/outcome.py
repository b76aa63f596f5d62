"""The result of a launch, resume or extend."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from analysis.records import BestRecord, SweepRecord, TrialRecord


@dataclass(frozen=True)
class SweepResult:
    """The result of a launch, resume or extend: the trials' records, and the paths of what was made."""

    folder: Path
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
    def exit_code(self) -> int:
        """130 if it was interrupted, 3 if a trial or what comes after the trials failed, else 0."""
        if self.interrupted:
            return 130
        return 3 if self.finish_failed or any(trial.status == "failed" for trial in self.trials) else 0
