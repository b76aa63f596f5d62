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
from policies.envs.tallies import Reached, evaluating, tally_of
from policies.errors import NonFiniteWeightsError, TuneJobsError, said_by
from policies.packed.envs.sub_envs import HostDiedError
from tune_jobs.store.contract import Ownership
from tune_jobs.store.logs import built_from
from tune_jobs.store.opening import open_sweep
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.progress import Progress
from tune_jobs.training.pack_member import MemberEngine, TrialInPack
from tune_jobs.training.protocol import PackEngine, TrialTask
from tune_jobs.training.trial_steps import TrialSteps

_NUM_WRITERS = 8
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.002, 0.1
"""How long a pack that has nothing to train waits before it asks again: twice as long each time."""

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
    counts: bool = True
    """Whether the failure counts against its retries; not if another member may be what ended a process of both."""
    lost: bool = False
    """Whether another process has taken it over; it has not failed, and nothing more about it is known here."""
    waits: bool = False
    """Whether it is saved, and waits at its progress for other trials."""


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
        wait: Waits for so many seconds, where every member waits for trials of other packs.
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
        wait: Callable[[float], object] = time.sleep,
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
        self._wait = wait
        self._waits_s = _FIRST_WAIT_S
        self._members: dict[str, TrialInPack] = {}
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
        self._members[task.trial_id] = TrialInPack(task, num_failures)

    def hold(self, hold_at: Mapping[str, int]) -> None:
        """Set from which env steps on each member saves and waits, at its next evaluation; the others never wait.

        A member that waits is not trained, and goes on when its number is raised.
        """
        for trial_id, member in self._members.items():
            member.hold(hold_at.get(trial_id))

    def num_changes(self, trial_id: str) -> int:
        """Return how many changes of a member are known here; see `TrialTask.changes`."""
        return len(self._members[trial_id].task.changes)

    def reopen(self, task: TrialTask) -> None:
        """Open a member again, as its record has changed: it goes on with other values, from another's checkpoint."""
        before = self._members[task.trial_id]
        self._members[task.trial_id] = member = TrialInPack(task, before.num_failures)
        member.hold(before.hold_at)
        if before.loop is not None:
            with self._watch(task.iteration_timeout_s):
                before.close()

    def end(self, trial_id: str) -> None:
        """Save a member and remove it; it is reported as stopped. One that waits is saved, and nothing is reported."""
        member = self._members[trial_id]
        with self._watch(member.task.iteration_timeout_s):
            if member.loop is None or member.waits:
                del self._members[trial_id]
                if member.loop is not None:
                    # It may be trained by another pack already.
                    with contextlib.suppress(OwnershipLostError):
                        member.close()
            else:
                leave = {member: lambda: member.trial.leave("stopped")}
                self._attempt(leave, saves=False, leaves=True)

    def save(self) -> None:
        """Save every member that has trained, as this process is about to end."""
        with self._watch(max((member.task.iteration_timeout_s for member in self._all), default=1.0)):
            self._attempt({member: member.trial.pause for member in self._all if member.loop}, saves=True)

    def advance(self, max_s: float, *, until_evaluated: bool) -> list[MemberReport]:
        """Train until there is something to decide, or for `max_s` seconds.

        It returns as soon as a member has come to where it waits. Where nothing is left to train, it waits a moment.

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
        self._idle()
        try:
            while self._members:
                was_evaluated = self._one_iteration()
                if (until_evaluated and was_evaluated) or len(self._members) <= few or self._clock() >= deadline:
                    break
                if any(report.waits for report in self._reports) or all(member.waits for member in self._all):
                    break
        finally:
            self._flush()
        for member in self._members.values():
            if member.unreported is not None:
                self._reports.append(MemberReport(member.task.trial_id, member.trial.told(member.unreported)))
                member.unreported = None
        reports, self._reports = self._reports, []
        return reports

    def _flush(self) -> None:
        acts = {member: member.trial.flush for member in self._all if member.loop}
        if acts:
            # Where it fails, the member is closed.
            with self._watch(max(member.task.iteration_timeout_s for member in acts)):
                self._attempt(acts, saves=False)

    def _idle(self) -> None:
        """Wait a moment if there is nothing to train, and longer each time."""
        if any(not member.waits for member in self._all):
            self._waits_s = _FIRST_WAIT_S
            return
        self._wait(self._waits_s)
        self._waits_s = min(2 * self._waits_s, _LONGEST_WAIT_S)

    def _one_iteration(self) -> bool:
        """Train all members once and evaluate those that are due; return whether any was."""
        while new := [member for member in self._members.values() if member.loop is None]:
            self._open(new)
        if not self._members:
            return False
        due: list[TrialInPack] = []
        with self._watch(max(member.task.iteration_timeout_s for member in self._members.values())):
            stop = self._stop_requested()
            acts = {member: functools.partial(member.trial.before_iteration, stop=stop) for member in self._all}
            self._attempt(acts, saves=stop, leaves=stop)
            if not self._members:
                return False
            # One that has failed is closed, and opened again before the next iteration.
            trained = [member for member in self._all if member.loop is not None and not member.waits]
            if not trained:
                return False
            results = self._engine.train_iteration({member.task.trial_id for member in self._all if member.waits})
            self._note_moved()
            evaluations: dict[TrialInPack, Episodes | Exception | None] = {}
            for member in trained:
                stats = results[member.task.trial_id]
                if isinstance(stats, Exception):
                    self._failed(member, stats)
                elif member.take(stats):
                    due.append(member)
                else:
                    evaluations[member] = None
            if due:
                policies = [member.trial.policy() for member in due]
                with evaluating(member.task.trial_id for member in due):
                    evaluations.update(zip(due, self._evaluate(self._evaluator, policies), strict=True))
            self._conclude(evaluations)
        return bool(due)

    def _note_moved(self) -> None:
        """Write to the logs of members that wait which of them will go on in new episodes, as from a checkpoint."""
        acts = {}
        for member in map(self._members.__getitem__, self._engine.moved):
            line = built_from(member.task.seed, Path(f"{member.trial.iteration:06d}"))
            acts[member] = functools.partial(_log, member.task, line)
        self._attempt(acts, saves=False)

    @property
    def _all(self) -> list[TrialInPack]:
        return list(self._members.values())

    def _conclude(self, evaluations: Mapping[TrialInPack, Episodes | Exception | None]) -> None:
        acts = {}
        for member, evaluation in evaluations.items():
            if isinstance(evaluation, Exception) and not isinstance(evaluation, NonFiniteWeightsError):
                self._failed(member, evaluation)
            else:
                acts[member] = functools.partial(member.trial.conclude, evaluation)
        self._attempt(acts, saves=any(member.may_save for member in acts))

    def _attempt(
        self, acts: Mapping[TrialInPack, Callable[[], Progress | None]], *, saves: bool, leaves: bool = False
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

    def _told(self, member: TrialInPack, progress: Progress) -> None:
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
        waits = progress.status == "running" and member.waits
        self._reports.append(MemberReport(member.task.trial_id, member.trial.told(progress), waits=waits))
        if progress.status != "running":
            self._let_go(member)

    def _let_go(self, member: TrialInPack) -> None:
        member.close()
        del self._members[member.task.trial_id]

    def _open(self, new: Sequence[TrialInPack]) -> None:
        for member in new:
            member.engine = MemberEngine(self._engine, member.task.trial_id, self._lock)
            member.loop = TrialSteps(member.task, member.engine, self._evaluator, self._clock, self._under)
            member.loop.hold_at = member.hold_at
        with self._watch(max(member.task.iteration_timeout_s for member in new)):
            # Side by side, as the store may be far away; they are built one after the other, in their order.
            taken = list(self._writers.map(_outcome, [member.trial.take_over for member in new]))
        for member, outcome in zip(new, taken, strict=True):
            # What fails is closed, which may hang as well.
            with self._watch(member.task.iteration_timeout_s):
                try:
                    if isinstance(outcome, Exception):
                        raise outcome  # noqa: TRY301 (told as what `build` raises)
                    member.trial.build()
                    if member.waits:
                        # Its process died while it waited.
                        self._told(member, member.trial.where())
                except Exception as error:  # noqa: BLE001 (it must not end the others)
                    self._failed(member, error)

    def _failed(self, member: TrialInPack, error: Exception, *, leaves: bool = False) -> None:
        """Report a failure; the member is opened again if it may be retried and need not leave."""
        if _is_lost(member, error):
            _log(member.task, "another process trains this trial by now, so this process stops training it")
            self._reports.append(MemberReport(member.task.trial_id, lost=True))
            with contextlib.suppress(OwnershipLostError):
                member.close()
            del self._members[member.task.trial_id]
            return
        _log(member.task, "".join(traceback.format_exception(error)).rstrip())
        # Each of them is given a process of its own now, so that the next death there is that of one alone.
        counts = not (isinstance(error, HostDiedError) and error.in_company)
        member.num_failures += counts
        retried = leaves or not counts or member.num_failures <= self._max_retries
        trial_id, tally = member.task.trial_id, tally_of(member.task.trial_id)
        reached = None if tally is None else tally.reached
        message = _describe(member.task, error)
        self._reports.append(MemberReport(trial_id, error=message, reached=reached, retried=retried, counts=counts))
        if leaves or not retried:
            self._let_go(member)
        else:
            member.close()


def _is_lost(member: TrialInPack, error: Exception) -> bool:
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
