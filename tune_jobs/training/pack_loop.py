"""Run the trials of one pack from start to end, trained and evaluated together.

Each follows the rules of `tune_jobs.training.trial_steps`. A member that fails is retried by itself, from its latest
checkpoint, without any effect on the others.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.policy import Policy
from policies.envs.tallies import Reached, end_tally, tally_of
from policies.errors import NonFiniteWeightsError, TuneJobsError, said_by
from policies.portable.file import PortablePolicy
from tune_jobs.store.contract import Ownership
from tune_jobs.store.opening import open_sweep
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.progress import Progress
from tune_jobs.training.protocol import IterationStats, PackEngine, TrialTask
from tune_jobs.training.trial_steps import TrialSteps

_NUM_WRITERS = 8

EvaluateMany = Callable[[Evaluator, Sequence[Policy]], Sequence[Episodes | Exception]]
"""The type of `policies.packed.evaluation.evaluate_many`: it returns each policy's greedy episodes, or its error."""


@dataclasses.dataclass(frozen=True)
class MemberReport:
    """A report on one member: its progress, its failure, or that another process has taken it over."""

    trial_id: str
    progress: Progress | None = None
    error: str | None = None
    """Why it failed, and the end of its log."""
    reached: Reached | None = None
    """How far a member that failed had come; None: it is not known here."""
    retried: bool = False
    """Whether it is retried from its latest checkpoint: at once, or when the sweep is resumed if it had to leave."""
    lost: bool = False
    """Whether another process has taken it over; it has not failed, and nothing more about it is known here."""


class _MemberEngine:
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
        self._pack.add(task, checkpoint)
        self.is_built = True

    def policy(self) -> PortablePolicy:
        # The policy that is evaluated is the one that is saved.
        if self._policy is None:
            self._policy = self._pack.policy(self._trial_id)
        return self._policy

    def trained(self) -> None:
        self._policy = None

    def save(self, folder: Path) -> None:
        with self._lock:
            self._pack.save(self._trial_id, folder)

    def close(self) -> None:
        if self.is_built:
            self._pack.remove(self._trial_id)
            self.is_built = False


class _TrialInPack:
    """A trial of the pack; every attempt has an engine and a loop of its own."""

    def __init__(self, task: TrialTask, num_failures: int) -> None:
        self.task = task
        self.num_failures = num_failures
        self.loop: TrialSteps | None = None
        self.engine: _MemberEngine | None = None
        self.unreported: Progress | None = None
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


class PackLoop:
    """Runs the trials of one pack; they can be added and removed at any time.

    Args:
        engine: Trains the trials.
        evaluator: The sweep's environment and evaluation seeds.
        evaluate: Evaluates several policies with the evaluator.
        stop_requested: Returns whether all trials have to save and pause.
        max_retries: How often a member that fails is retried.
        watch: Takes a time limit in seconds and returns a context manager, entered around everything that may hang.
        clock: A monotonic clock, in seconds.
        under: The ownership of the pack; its members are taken only while it holds.
    """

    def __init__(
        self,
        engine: PackEngine,
        evaluator: Evaluator,
        evaluate: EvaluateMany,
        *,
        stop_requested: Callable[[], bool],
        max_retries: int,
        watch: Callable[[float], AbstractContextManager[Any]] = contextlib.nullcontext,
        clock: Callable[[], float] = time.perf_counter,
        under: Ownership | None = None,
    ) -> None:
        self._engine = engine
        self._evaluator = evaluator
        self._evaluate = evaluate
        self._under = under
        self._stop_requested = stop_requested
        self._max_retries = max_retries
        self._watch = watch
        self._clock = clock
        self._members: dict[str, _TrialInPack] = {}
        self._reports: list[MemberReport] = []
        self._lock = threading.Lock()
        # Saving mostly waits for the disk, so several members save at once.
        self._writers = ThreadPoolExecutor(_NUM_WRITERS, "checkpoints")

    @property
    def trial_ids(self) -> tuple[str, ...]:
        """The trials that are trained now, in the order in which they were added."""
        return tuple(self._members)

    def add(self, task: TrialTask, num_failures: int = 0) -> None:
        """Add a trial; it is built before the next iteration.

        Args:
            task: The trial.
            num_failures: How often it has failed before.
        """
        self._members[task.trial_id] = _TrialInPack(task, num_failures)

    def end(self, trial_id: str) -> None:
        """Save a member and remove it; it is reported as stopped."""
        member = self._members[trial_id]
        if member.loop is None:
            del self._members[trial_id]
        else:
            leave = {member: lambda: member.trial.leave("stopped")}
            self._attempt(leave, saves=False, leaves=True)

    def save(self) -> None:
        """Save every member that has trained, as this process is about to end."""
        with self._watch(max((member.task.iteration_timeout_s for member in self._all), default=1.0)):
            self._attempt({member: member.trial.pause for member in self._all if member.loop}, saves=True)

    def advance(self, max_s: float, *, until_evaluated: bool) -> list[MemberReport]:
        """Train until there is something to decide, or for `max_s` seconds.

        Args:
            max_s: Seconds; at least one iteration is made.
            until_evaluated: Whether to return as soon as a member was evaluated.

        Returns:
            Reports on each evaluation, end and failure since the last call, and on the progress of the other members.

        Raises:
            Exception: An error that concerns no single member.
        """
        deadline = self._clock() + max_s
        # With so few members left, other trials could use the slots of those that ended.
        few = 3 * len(self._members) // 4
        try:
            while self._members:
                was_evaluated = self._one_iteration()
                if (until_evaluated and was_evaluated) or len(self._members) <= few or self._clock() >= deadline:
                    break
        finally:
            self._attempt({member: member.trial.flush for member in self._all if member.loop}, saves=False)
        for member in self._members.values():
            if member.unreported is not None:
                self._reports.append(MemberReport(member.task.trial_id, member.trial.told(member.unreported)))
                member.unreported = None
        reports, self._reports = self._reports, []
        return reports

    def _one_iteration(self) -> bool:
        """Train all members once and evaluate those that are due; return whether there were any members."""
        while new := [member for member in self._members.values() if member.loop is None]:
            self._open(new)
        if not self._members:
            return False
        due: list[_TrialInPack] = []
        with self._watch(max(member.task.iteration_timeout_s for member in self._members.values())):
            stop = self._stop_requested()
            acts = {member: functools.partial(member.trial.before_iteration, stop=stop) for member in self._all}
            self._attempt(acts, saves=stop, leaves=stop)
            if not self._members:
                return False
            results = self._engine.train_iteration()
            evaluations: dict[_TrialInPack, Episodes | Exception | None] = {}
            for member in self._all:
                stats = results[member.task.trial_id]
                if isinstance(stats, Exception):
                    self._failed(member, stats)
                elif member.take(stats):
                    due.append(member)
                else:
                    evaluations[member] = None
            if due:
                policies = [member.trial.policy() for member in due]
                evaluations.update(zip(due, self._evaluate(self._evaluator, policies), strict=True))
            self._conclude(evaluations)
        return bool(due)

    @property
    def _all(self) -> list[_TrialInPack]:
        return list(self._members.values())

    def _conclude(self, evaluations: Mapping[_TrialInPack, Episodes | Exception | None]) -> None:
        acts = {}
        for member, evaluation in evaluations.items():
            if isinstance(evaluation, Exception) and not isinstance(evaluation, NonFiniteWeightsError):
                self._failed(member, evaluation)
            else:
                acts[member] = functools.partial(member.trial.conclude, evaluation)
        self._attempt(acts, saves=any(member.may_save for member in acts))

    def _attempt(
        self, acts: Mapping[_TrialInPack, Callable[[], Progress | None]], *, saves: bool, leaves: bool = False
    ) -> None:
        """Do something for each of some members; an error is a failure of that member only.

        Args:
            acts: The function to call for each member.
            saves: Whether the functions may write checkpoints.
            leaves: Whether members that fail have to leave the pack.
        """
        outcomes = self._writers.map(_outcome, acts.values()) if saves else map(_outcome, acts.values())
        for member, outcome in zip(acts, outcomes, strict=True):
            if isinstance(outcome, Exception):
                self._failed(member, outcome, leaves=leaves)
            elif outcome is not None:
                self._told(member, outcome)

    def _told(self, member: _TrialInPack, progress: Progress) -> None:
        if progress.status == "running" and not progress.evaluated:
            member.unreported = progress
            return
        if progress.status != "running":
            try:
                member.trial.flush()
            except Exception as error:  # noqa: BLE001 (it must not end the others)
                self._failed(member, error)
                return
        member.unreported = None
        self._reports.append(MemberReport(member.task.trial_id, member.trial.told(progress)))
        if progress.status != "running":
            self._let_go(member)

    def _let_go(self, member: _TrialInPack) -> None:
        member.close()
        del self._members[member.task.trial_id]

    def _open(self, new: Sequence[_TrialInPack]) -> None:
        for member in new:
            member.engine = _MemberEngine(self._engine, member.task.trial_id, self._lock)
            member.loop = TrialSteps(member.task, member.engine, self._evaluator, self._clock, self._under)
        with self._watch(max(member.task.iteration_timeout_s for member in new)):
            # Side by side, as the store may be far away; they are built one after the other, in their order.
            taken = list(self._writers.map(_outcome, [member.trial.take_over for member in new]))
        for member, outcome in zip(new, taken, strict=True):
            try:
                if isinstance(outcome, Exception):
                    raise outcome  # noqa: TRY301 (told as what `build` raises)
                with self._watch(member.task.iteration_timeout_s):
                    member.trial.build()
            except Exception as error:  # noqa: BLE001 (it must not end the others)
                self._failed(member, error)

    def _failed(self, member: _TrialInPack, error: Exception, *, leaves: bool = False) -> None:
        """Report a failure; the member is opened again if it may be retried and need not leave."""
        if _is_lost(member, error):
            _log(member.task, "another process trains this trial by now, so this process stops training it")
            self._reports.append(MemberReport(member.task.trial_id, lost=True))
            with contextlib.suppress(OwnershipLostError):
                member.close()
            del self._members[member.task.trial_id]
            return
        _log(member.task, "".join(traceback.format_exception(error)).rstrip())
        member.num_failures += 1
        retried = leaves or member.num_failures <= self._max_retries
        trial_id, tally = member.task.trial_id, tally_of(member.task.trial_id)
        reached = None if tally is None else tally.reached
        message = _describe(member.task, error)
        self._reports.append(MemberReport(trial_id, error=message, reached=reached, retried=retried))
        if leaves or not retried:
            self._let_go(member)
        else:
            member.close()


def _is_lost(member: _TrialInPack, error: Exception) -> bool:
    """Whether an error says, or may be caused by, that another process has taken the member over."""
    if isinstance(error, OwnershipLostError):
        return True
    try:
        if member.loop is not None:
            member.loop.check_owned()
    except OwnershipLostError:
        return True
    except OSError:
        pass
    return False


def _outcome(act: Callable[[], Progress | None]) -> Progress | Exception | None:
    try:
        return act()
    except Exception as error:  # noqa: BLE001 (it must not end the other members)
        return error


def _describe(task: TrialTask, error: Exception) -> str:
    message = str(error) if isinstance(error, TuneJobsError) else f"{type(error).__name__}: {said_by(error)}"
    return f"{message}\n{open_sweep(task.sweep_place).trial(task.trial_id).log_tail()}".strip()


def _log(task: TrialTask, text: str) -> None:
    """Append to a member's own log; the output of the process goes to the pack's log."""
    open_sweep(task.sweep_place).trial(task.trial_id).write_log(text)
