"""A trial of a pack, and its part of the pack's engine."""

from __future__ import annotations

import threading
from pathlib import Path

from policies.envs.tallies import end_tally
from policies.portable.file import PortablePolicy
from tune_jobs.store.progress import Progress
from tune_jobs.training.protocol import IterationStats, PackEngine, TrialTask
from tune_jobs.training.trial_steps import TrialSteps


class MemberEngine:
    """A member of a pack, as an engine that holds one trial; the pack trains it, and this does what is its alone.

    Args:
        pack: The engine that trains the member.
        trial_id: The member's id.
        lock: Held while the pack's engine saves, because several threads write checkpoints.
    """

    def __init__(self, pack: PackEngine, trial_id: str, lock: threading.Lock) -> None:
        self._pack = pack
        self._trial_id = trial_id
        self._lock = lock
        self._policy: PortablePolicy | None = None
        self.is_built = False

    def build(self, task: TrialTask, checkpoint: Path | None) -> None:
        """Add it to the pack's engine; see `PackEngine.add`."""
        self._pack.add(task, checkpoint)
        self.is_built = True

    def policy(self) -> PortablePolicy:
        """Return its current greedy policy."""
        # The policy that is evaluated is the one that is saved.
        if self._policy is None:
            self._policy = self._pack.policy(self._trial_id)
        return self._policy

    def trained(self) -> None:
        """Note that its weights have changed."""
        self._policy = None

    def save(self, folder: Path) -> None:
        """Write its state into an empty folder."""
        with self._lock:
            self._pack.save(self._trial_id, folder)

    def close(self) -> None:
        """Remove it from the pack's engine, if it is there."""
        if self.is_built:
            self._pack.remove(self._trial_id)
            self.is_built = False


class TrialInPack:
    """A trial of the pack; every attempt has an engine and a loop of its own."""

    def __init__(self, task: TrialTask, num_failures: int) -> None:
        self.task = task
        self.num_failures = num_failures
        self.loop: TrialSteps | None = None
        self.engine: MemberEngine | None = None
        self.unreported: Progress | None = None
        self.hold_at: int | None = None
        """See `TrialSteps.hold_at`."""
        self.may_save = False
        """Whether the end of this iteration may write a checkpoint."""

    @property
    def trial(self) -> TrialSteps:
        """The trial's loop, after it was opened."""
        assert self.loop is not None
        return self.loop

    def take(self, stats: IterationStats) -> bool:
        """Take the results of an iteration, and return whether the trial has to be evaluated."""
        assert self.engine is not None
        self.engine.trained()
        is_due = self.trial.take(stats)
        is_checkpoint = (self.trial.iteration + 1) % self.task.checkpoints.every_iterations == 0
        if is_checkpoint:
            # Only this thread reads the pack's weights; other threads only write what it has read.
            self.engine.policy()
        self.may_save = is_due or is_checkpoint
        return is_due

    def hold(self, hold_at: int | None) -> None:
        """Let it wait from so many env steps on, or go on if it waits at fewer; None: it never waits."""
        self.hold_at = hold_at
        if self.loop is not None:
            if self.loop.waits:
                self.loop.note_wait()
            self.loop.hold_at = hold_at

    @property
    def waits(self) -> bool:
        """Whether it is saved and waits for other trials."""
        return self.loop is not None and self.loop.waits

    def close(self) -> None:
        """Free the trial; its results are written."""
        try:
            if self.loop is not None:
                self.loop.flush()
        finally:
            end_tally(self.task.trial_id)
            if self.engine is not None:
                self.engine.close()
            self.loop = self.engine = self.unreported = None
