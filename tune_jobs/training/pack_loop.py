"""The trials of one pack from start to end, trained and evaluated together.

Each goes by the rules of `tune_jobs.training.trial_loop`.
A member that fails is tried again by itself, from its latest checkpoint; the others do not notice.
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
from tune_jobs.store.local_storage import open_sweep
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.progress import Progress
from tune_jobs.training.protocol import IterationStats, PackEngine, TrialTask
from tune_jobs.training.trial_loop import TrialLoop

_NUM_WRITERS = 8

EvaluateMany = Callable[[Evaluator, Sequence[Policy]], Sequence[Episodes | Exception]]
"""`policies.packed.evaluation.evaluate_many`: of each policy its greedy episodes, or why there are none."""


@dataclasses.dataclass(frozen=True)
class MemberReport:
    """News of one member: how far it is, that it failed, or that another process has it by now."""

    trial_id: str
    progress: Progress | None = None
    error: str | None = None
    """What made it fail, and the end of its log."""
    reached: Reached | None = None
    """How far one that failed was; None: it is not known here."""
    retried: bool = False
    """Whether it goes on from its latest checkpoint: at once, or if it was to leave, when the sweep is resumed."""
    lost: bool = False
    """Whether another process has taken it up: no failure of it, and nothing of it is known here any more."""


class _MemberEngine:
    """A member of a pack, as the engine of one trial; what is done together is not done here.

    Args:
        pack: Trains it.
        trial_id: Of the member.
        lock: Held while the pack's engine is asked to save; checkpoints are written by several threads.
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
        source = f"seed {task.seed}" if checkpoint is None else f"checkpoint {checkpoint.name}"
        _log(task, f"built from {source}")

    def train_iteration(self) -> IterationStats:
        raise NotImplementedError("The members of a pack are trained together.")

    def policy(self) -> PortablePolicy:
        # Evaluated and saved it is the same one.
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
    """A trial of the pack; every try of it has an engine and a loop of its own."""

    def __init__(self, task: TrialTask, num_failures: int) -> None:
        self.task = task
        self.num_failures = num_failures
        self.loop: TrialLoop | None = None
        self.engine: _MemberEngine | None = None
        self.unreported: Progress | None = None
        self.may_save = False
        """Whether the end of this iteration may write a checkpoint."""

    @property
    def trial(self) -> TrialLoop:
        """Its loop, once it is open."""
        assert self.loop is not None
        return self.loop

    def take(self, stats: IterationStats) -> bool:
        """Take what an iteration gave; whether it is to be evaluated."""
        assert self.engine is not None
        self.engine.trained()
        is_due = self.trial.take(stats)
        is_checkpoint = (self.trial.iteration + 1) % self.task.checkpoints.every_iterations == 0
        if is_checkpoint:
            # The pack's weights are looked at by this thread; others only write what it has found.
            self.engine.policy()
        self.may_save = is_due or is_checkpoint
        return is_due

    def close(self) -> None:
        """Free it; what it did is written."""
        try:
            if self.loop is not None:
                self.loop.flush()
        finally:
            end_tally(self.task.trial_id)
            if self.engine is not None:
                self.engine.close()
            self.loop = self.engine = self.unreported = None


class PackLoop:
    """Runs the trials of one pack; they come and go.

    Args:
        engine: Trains them.
        evaluator: The sweep's environment and evaluation seeds.
        evaluate: Evaluates several policies with it.
        stop_requested: Whether all are to save and pause.
        max_retries: How often a member that fails is tried again.
        watch: Makes what is entered around everything that may hang, for the seconds it may take.
        clock: Seconds, monotonic.
        under: The pack, as long as it is run: its members are taken up under it.
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
        # Saving is waiting for the disk, for which one need not wait for the other.
        self._writers = ThreadPoolExecutor(_NUM_WRITERS, "checkpoints")

    @property
    def trial_ids(self) -> tuple[str, ...]:
        """Those that are trained now, in the order in which they came."""
        return tuple(self._members)

    def add(self, task: TrialTask, num_failures: int = 0) -> None:
        """Take a trial in; it is built before the next iteration.

        Args:
            task: The trial.
            num_failures: How often it has failed before.
        """
        self._members[task.trial_id] = _TrialInPack(task, num_failures)

    def end(self, trial_id: str) -> None:
        """Save a member and let it go; it is reported as stopped."""
        member = self._members[trial_id]
        if member.loop is None:
            del self._members[trial_id]
        else:
            leave = {member: lambda: member.trial.leave("stopped")}
            self._attempt(leave, saves=False, leaves=True)

    def advance(self, max_s: float, *, until_evaluated: bool) -> list[MemberReport]:
        """Train until there is something to decide, or for max_s seconds.

        Args:
            max_s: Seconds, at least one iteration.
            until_evaluated: Whether to return as soon as a member was evaluated.

        Returns:
            Each evaluation, each end and each failure since the last call, and where the other members stand.

        Raises:
            Exception: What concerns no single member.
        """
        deadline = self._clock() + max_s
        # When so few are left, others could have had the slots of those that ended.
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
                self._reports.append(MemberReport(member.task.trial_id, member.unreported))
                member.unreported = None
        reports, self._reports = self._reports, []
        return reports

    def _one_iteration(self) -> bool:
        """Train all once and evaluate those whose turn it is; whether there were any."""
        while new := [member for member in self._members.values() if member.loop is None]:
            for member in new:
                self._open(member)
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
        """Do what concerns single members: what goes wrong with one is its own failure.

        Args:
            acts: What to do for each.
            saves: Whether that may write checkpoints.
            leaves: Whether those that go wrong are to leave.
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
        self._reports.append(MemberReport(member.task.trial_id, progress))
        if progress.status != "running":
            self._let_go(member)

    def _let_go(self, member: _TrialInPack) -> None:
        member.close()
        del self._members[member.task.trial_id]

    def _open(self, member: _TrialInPack) -> None:
        member.engine = _MemberEngine(self._engine, member.task.trial_id, self._lock)
        member.loop = TrialLoop(member.task, member.engine, self._evaluator, self._clock, self._under)
        try:
            with self._watch(member.task.iteration_timeout_s):
                member.loop.open()
        except Exception as error:  # noqa: BLE001 (it must not end the others)
            self._failed(member, error)

    def _failed(self, member: _TrialInPack, error: Exception, *, leaves: bool = False) -> None:
        """Report a failure; the member is opened again, if it may be and was not to leave."""
        if _is_lost(member, error):
            _log(member.task, "another process trains this trial by now; this one leaves it")
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
    """Whether what went wrong is that another process has the member, or may come from that."""
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
    return f"{message}\n{open_sweep(task.sweep_folder).trial(task.trial_id).log_tail()}".strip()


def _log(task: TrialTask, text: str) -> None:
    """Append to a member's own log; the output of the process goes to the pack's."""
    open_sweep(task.sweep_folder).trial(task.trial_id).write_log(text)
