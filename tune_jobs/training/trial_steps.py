"""The steps of one trial, on any engine: stop rules, evaluation, checkpoints, results.

A trial's state is only on disk (its checkpoints and results.jsonl), so a trial that is opened again, after a kill, on
another node or in another process, continues from its latest checkpoint.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from analysis.records import CheckpointRecord, IterationRecord, TrialStatus, finite_or_none
from analysis.selection import best_checkpoint
from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.load import policy_from_portable
from policies.acting.policy import Policy
from policies.envs.tallies import Reached, begin_tally, end_tally
from policies.errors import NonFiniteWeightsError
from policies.files import write_plain
from policies.portable.file import save_policy
from tune_jobs.process.ran_with import ran_with
from tune_jobs.store.contract import Ownership
from tune_jobs.store.logs import built_from
from tune_jobs.store.names import RESULTS
from tune_jobs.store.opening import open_sweep
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.progress import Progress
from tune_jobs.store.recovery import take_up_checkpoints, take_up_copy, take_up_results
from tune_jobs.training.protocol import IterationStats, TrialEngine, TrialTask
from tune_jobs.training.scoring import RunningScore
from tune_jobs.training.stop_rules import stop_reason

TRAINING_RETURN_EPISODES = 100


class TrialSteps:
    """One trial, step by step; what trains it is not known here, so a pack does it for several of them together.

    A step calls `before_iteration`, then `take` with the results of the iteration, and then `conclude`, with an
    evaluation if `take` asked for one; `flush` is called from time to time, and `leave` ends the trial early.

    Args:
        task: The trial to run.
        engine: Holds the trial; it is reused for other trials.
        evaluator: Runs the greedy episodes on the sweep's evaluation seeds; it is reused for other trials.
        clock: A monotonic clock, in seconds.
        under: The ownership of the run or pack that opens the trial; None: the trial is not opened for any.
    """

    def __init__(
        self,
        task: TrialTask,
        engine: TrialEngine,
        evaluator: Evaluator,
        clock: Callable[[], float] = time.perf_counter,
        under: Ownership | None = None,
    ) -> None:
        self.task = task
        self._engine = engine
        self._evaluator = evaluator
        self._clock = clock
        self._under = under
        self._sweep = open_sweep(task.sweep_place)
        self._store = self._sweep.trial(task.trial_id)
        self._window: deque[float] = deque(maxlen=TRAINING_RETURN_EPISODES)
        self._last = IterationRecord(iteration=0, num_env_steps=0, num_episodes=0, time_s=0.0)
        self._evaluation_return: float | None = None
        self._checkpoints: list[CheckpointRecord] = []
        self._best: CheckpointRecord | None = None
        self._unwritten: list[IterationRecord] = []
        self._untold: list[IterationRecord] = []
        self._score = RunningScore(task.judging)
        self._notes: list[str] = []
        # The iteration that is not concluded yet, and the stop rule that applies before its evaluation.
        self._taken = self._last
        self._reason: str | None = None
        # Whether the engine has a copy of another trial's weights with which it has not trained yet.
        self._is_copy = False
        # The folder with the weights that the trial goes on from; None: it is built from its seed.
        self._built_from: Path | None = None
        self._started = self._waited_s = 0.0
        self._started_at: float | None = None
        self._evaluated_at = -1
        self.hold_at: int | None = None
        """Env steps from which it saves and waits for other trials, at its next evaluation; None: it never waits."""

    @property
    def iteration(self) -> int:
        """The number of iterations done."""
        return self._last.iteration

    @property
    def waits(self) -> bool:
        """Whether it was evaluated where it has to wait, and is saved; until `hold_at` is raised it is not trained."""
        reached = self.hold_at is not None and self._evaluated_at == self._last.num_env_steps >= self.hold_at
        return reached and not self._is_copy

    def note_wait(self) -> None:
        """Count what has come since its last iteration as a wait for others, not as training."""
        self._waited_s = self._last.waited_s + self._clock() - self._started - self._last.time_s

    def where(self) -> Progress:
        """Return where a trial stands that was opened where it waits."""
        return self._progress("running", evaluated=True)

    def check_owned(self) -> None:
        """Raise an error if another process has taken the trial, which may have caused an error here.

        Raises:
            OwnershipLostError: Another process has taken it.
        """
        if self._store.is_lost():
            raise OwnershipLostError(
                f"Another process trains trial {self.task.trial_id} by now.", "Leave the trial to that process."
            )

    def open(self) -> None:
        """Take the trial and build it: from its latest checkpoint or a newer copy of another's, else from its seed.

        A checkpoint whose files have changed since they were written is set aside, and the one before it is used.

        Raises:
            CheckpointError: The checkpoint is whole but cannot be restored, for example because it has other
                hyperparameters.
            OwnershipLostError: This process may not open the trial any more.
        """
        self.take_over()
        self.build()

    def take_over(self) -> None:
        """Do the first half of `open`: take the trial, and read what there is of it. Only the store is used here.

        Raises:
            OwnershipLostError: This process may not open the trial any more.
        """
        self._store.take(self._under)
        self._store.remove_leftovers()
        self._checkpoints, self._notes = take_up_checkpoints(self._store)
        self._best = best_checkpoint(self._checkpoints)
        latest = self._checkpoints[-1] if self._checkpoints else None
        change = self.task.changes[-1] if self.task.changes else None
        folder, notes = take_up_copy(self._store, change, latest.iteration if latest is not None else 0)
        self._notes += notes
        self._is_copy = folder is not None
        start = latest
        if folder is not None and change is not None:
            start = CheckpointRecord(
                trial_id=self.task.trial_id, iteration=change.iteration, num_env_steps=change.num_env_steps
            )
        elif latest is not None:
            folder = self._store.checkpoint_folder(latest.iteration)
        self._take_up_results(start)
        self._taken, self._built_from = self._last, folder

    def build(self) -> None:
        """Do the second half of `open`: build the trial from what was read.

        Raises:
            CheckpointError: The checkpoint is whole but cannot be restored.
            OwnershipLostError: Another process has taken the trial.
        """
        folder = self._built_from
        for note in self._notes:
            self._store.write_log(f"{self.task.trial_id}: {note}")
        with self._store.owned():
            self._tally = begin_tally(self.task.trial_id, self._store.tally_path, _reached(self._last))
        done = replace(self.task, num_env_steps=self._last.num_env_steps, num_iterations=self._last.iteration)
        self._engine.build(done, folder)
        self._store.write_log(built_from(self.task.seed, folder))
        self._started, self._waited_s = self._clock() - self._last.time_s, self._last.waited_s
        self._started_at = time.time()

    def _take_up_results(self, start: CheckpointRecord | None) -> None:
        """Keep the results up to the checkpoint that the trial starts from; later iterations are repeated.

        The training return counts episodes since the trial's last change: those before it were played by other weights.
        """
        found, notes = take_up_results(self._store)
        self._notes += notes
        iteration = start.iteration if start is not None else 0
        changed_at = max((change.iteration for change in self.task.changes if change.iteration <= iteration), default=0)
        kept = [record for record in found.records if record.iteration <= iteration]
        self._score.begin(kept)
        time_s = waited_s = 0.0
        if self._store.has_results():
            self._store.keep_iterations(kept)
        for record in kept:
            if record.iteration > changed_at:
                self._window.extend(record.episode_returns)
            if record.evaluation_return is not None:
                self._evaluation_return = record.evaluation_return
                self._evaluated_at = record.num_env_steps
            self._last = record
            # With an invalid time, the stop rule `time_s` would never end the trial, or end it at once.
            if 0 <= record.time_s < math.inf:
                time_s, waited_s = record.time_s, record.waited_s
        waited_s = waited_s if 0 <= waited_s <= time_s else 0.0
        self._last = self._last.model_copy(update={"time_s": time_s, "waited_s": waited_s})
        if start is None:
            return
        contradicts = (
            not self._is_copy and kept and self._last.iteration == iteration
            and self._last.num_env_steps != start.num_env_steps
        )  # fmt: skip
        if contradicts:
            self._notes.append(
                f"{RESULTS}: iteration {iteration} says {self._last.num_env_steps} env steps; its checkpoint says "
                f"{start.num_env_steps}, from which the trial goes on."
            )
        if contradicts or self._last.iteration < iteration:
            # The checkpoint's own line could not be read or contradicts it; the checkpoint's numbers are right.
            # The curve has a gap there; the counts continue.
            known = ("iteration", "num_env_steps", "training_return", "evaluation_return")
            self._last = self._last.model_copy(update={name: getattr(start, name) for name in known})
            if start.evaluation_return is not None:
                self._evaluation_return = start.evaluation_return
                self._evaluated_at = start.num_env_steps

    def pause(self) -> None:
        """Save a checkpoint of this iteration, so that the trial can continue elsewhere."""
        if self._is_copy:
            return  # nothing was trained since the copy, which is on disk; the last score belongs to other weights
        if self.iteration and not (self._checkpoints and self._checkpoints[-1].iteration == self.iteration):
            self._checkpoint(self._last.evaluation_return)
        # Whoever goes on with it may do so before this process has brought it to a store that is far away.
        self._store.settle()

    def before_iteration(self, *, stop: bool) -> Progress | None:
        """Return how the trial ended, or None if it continues; if asked to stop, it saves and pauses."""
        # A trial whose process was killed after the last checkpoint is at its end already when it is opened.
        reason = self._stop_reason(self._last, self._last.evaluation_return)
        if reason is not None and self._last.evaluation_return is not None:
            return self._progress("completed", evaluated=True, reason=reason)
        return self.leave() if stop else None

    def take(self, stats: IterationStats) -> bool:
        """Take the results of an iteration, and return whether `conclude` needs an evaluation of the present policy."""
        self._taken = self._record(stats)
        self._is_copy = False
        # The iteration's episodes count as whole when the iteration is concluded.
        self._tally.set(replace(_reached(self._taken), num_iterations=self._last.iteration))
        self._reason = self._stop_reason(self._taken, None)
        return self._taken.iteration % self.task.evaluation.every_iterations == 0 or self._reason is not None

    def policy(self) -> Policy:
        """Return the current policy, for its evaluation."""
        return policy_from_portable(self._engine.policy())

    def conclude(self, evaluation: Episodes | NonFiniteWeightsError | None) -> Progress:
        """End the iteration: write its record and a checkpoint if one is due, and decide whether the trial continues.

        Args:
            evaluation: Greedy episodes of the policy, or why it cannot act; None: `take` asked for none.
        """
        record, reason = self._taken, self._reason
        if isinstance(evaluation, NonFiniteWeightsError):
            # Later iterations would fail in the same way, and a retry too, so the trial is over.
            text = f"{evaluation} (iteration {self._last.iteration + 1}{self.task.learning_settings})"
            if record.iteration > self._last.iteration:  # otherwise the training raised the error
                self._unwritten.append(record)
                self._untold.append(record)
            self._last, reached = record, self._tally.reached
            progress = self._progress("failed", evaluated=False, error=text)
            counts = {"num_env_steps": reached.num_env_steps, "num_episodes": reached.num_episodes}
            return progress.model_copy(update=counts)
        # With its evaluation, which may be what takes it to `time_s`.
        record = record.model_copy(update={"time_s": self._clock() - self._started})
        if evaluation is not None:
            score = finite_or_none(sum(evaluation.returns) / len(evaluation.returns))
            record = record.model_copy(update={"evaluation_return": score})
            self._evaluation_return = score
            reason = reason or self._stop_reason(record, score)
        self._last = record
        self._unwritten.append(self._last)
        self._untold.append(self._last)
        self._score.add(self._last)
        self._tally.set(_reached(self._last))
        if evaluation is not None:
            self._evaluated_at = record.num_env_steps
        if (
            self._improves(record.evaluation_return)
            or reason is not None
            or self.waits
            or record.iteration % self.task.checkpoints.every_iterations == 0
        ):
            self._checkpoint(record.evaluation_return)
        if self.waits:
            # Others may go on from this checkpoint as soon as it is told.
            self._store.settle()
        status: TrialStatus = "running" if reason is None else "completed"
        return self._progress(status, evaluated=evaluation is not None, reason=reason)

    def told(self, progress: Progress) -> Progress:
        """Return a progress that is reported now, with the iterations since the last one that was."""
        untold, self._untold = self._untold, []
        return progress.with_iterations(untold)

    def flush(self) -> None:
        """Write the concluded iterations to results.jsonl."""
        self._store.append_iterations(self._unwritten)
        self._unwritten = []

    def leave(self, status: TrialStatus = "paused") -> Progress:
        """Save and stop here; the trial can continue elsewhere."""
        self.pause()
        return self._progress(status, evaluated=False)

    def _record(self, stats: IterationStats) -> IterationRecord:
        returns = tuple(episode_return for episode_return, _ in stats.episodes)
        self._window.extend(returns)
        return IterationRecord(
            iteration=self._last.iteration + 1,
            num_env_steps=stats.num_env_steps,
            num_episodes=self._last.num_episodes + len(returns),
            time_s=self._clock() - self._started,
            waited_s=self._waited_s,
            training_return=sum(self._window) / len(self._window) if self._window else None,
            episode_returns=returns,
            episode_lengths=tuple(length for _, length in stats.episodes),
            learner=dict(stats.learner),
        )

    def _stop_reason(self, record: IterationRecord, evaluation_return: float | None) -> str | None:
        is_full = len(self._window) == TRAINING_RETURN_EPISODES
        return stop_reason(self.task.stop, record, evaluation_return, is_full=is_full)

    def _improves(self, score: float | None) -> bool:
        best = self._best.evaluation_return if self._best is not None else None
        return score is not None and (best is None or score > best)

    def _checkpoint(self, score: float | None) -> None:
        record = CheckpointRecord(
            trial_id=self.task.trial_id,
            iteration=self._last.iteration,
            num_env_steps=self._last.num_env_steps,
            training_return=self._last.training_return,
            evaluation_return=score,
        )
        # Results come first: a checkpoint whose iterations are not in results.jsonl would leave a gap in the curve.
        self.flush()

        def write(folder: Path) -> None:
            self._engine.save(folder)
            save_policy(self._engine.policy(), folder, write=write_plain)

        self._store.write_checkpoint(record, write, self.task.engine)
        self._checkpoints = [known for known in self._checkpoints if known.iteration != record.iteration] + [record]
        self._best = best_checkpoint(self._checkpoints)
        if self.task.changes:
            self._store.remove_copies()
        self._prune()

    def _prune(self) -> None:
        """Delete all checkpoints but the latest, the best by `analysis.selection`, and the newest as the spec says."""
        newest = self._checkpoints[-max(1, self.task.checkpoints.keep) :]
        for record in list(self._checkpoints):
            if record not in newest and record != self._best:
                self._store.delete_checkpoint(record)
                self._checkpoints.remove(record)

    def _progress(
        self, status: TrialStatus, *, evaluated: bool, reason: str | None = None, error: str | None = None
    ) -> Progress:
        if status != "running":
            # Before anybody hears that it has ended: what is told of it is there.
            self.flush()
            self._store.settle()
            end_tally(self.task.trial_id)
            self._store.forget_tally()
        progress = Progress(
            num_iterations=self._last.iteration,
            num_env_steps=self._last.num_env_steps,
            num_episodes=self._last.num_episodes,
            time_s=self._last.time_s,
            training_return=self._last.training_return,
            evaluation_return=self._evaluation_return,
            best_evaluation_return=self._best.evaluation_return if self._best else None,
            best_iteration=self._best.iteration if self._best else None,
            evaluated=evaluated,
            status=status,
            stop_reason=reason,
            error=error,
            notes=tuple(self._notes),
            checkpoints=tuple(self._checkpoints),
            ran_with=ran_with(),
            started_at=self._started_at,
            ended_at=None if status == "running" else time.time(),
        )
        return self._score.told(progress)


def _reached(record: IterationRecord) -> Reached:
    return Reached(record.iteration, record.num_env_steps, record.num_episodes, record.time_s)
