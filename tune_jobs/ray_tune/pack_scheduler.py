"""Assign trials to packs, end those that the scheduler ends, and restart the members of a pack that died.

For Ray Tune, each pack is one trial. Tune calls its scheduler with a pack's reports before it lets the pack continue,
so a decision takes effect in the pack's next step. The sweep's own scheduler (`tune_jobs.ray_tune.scheduling`)
compares the members, whichever pack they are in.

On a cluster there may be more packs than the nodes hold, which Tune starts on nodes that join: they train trials that
wait, and those of a pack that has lost its node and got no other. A trial that a process trains stays with it.

A pack whose process died is started again, and its members go on from their latest checkpoints. One of them may be
the cause: a member that was twice in a pack that died continues alone, and only its failures alone count against its
retries.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from ray.tune.schedulers import FIFOScheduler, TrialScheduler

from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.ray_tune.scheduling import Decision, NobodyWaits, Scheduler, Standing
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store import transitions
from tune_jobs.store.candidates import candidates
from tune_jobs.store.contract import Assignment, Pack, Sweep
from tune_jobs.store.progress import Progress
from tune_jobs.store.record_keeper import RecordKeeper
from tune_jobs.training.pack_loop import MemberReport

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController
    from ray.tune.experiment import Trial

Tell = Callable[[Assignment], object]
"""Tells the process of a pack which trials it has to train, before it trains on."""
_DEATHS_IN_COMPANY = 2
"""How many times a member may be in a pack that dies before it continues alone."""


class _Pack:
    def __init__(self, files: Pack) -> None:
        self.files = files
        self.members: dict[str, None] = {}
        self.ending: set[str] = set()
        """Members that the scheduler has ended; the pack removes them before it trains on."""
        self.is_up = False
        self.tell: Tell | None = None
        """Tells its process; None: there is none, or it has not reported yet, and reads in the storage."""
        self.told: Assignment | None = None
        """What it was told last; None: nothing yet."""

    @property
    def staying(self) -> tuple[str, ...]:
        """The members that the pack keeps training."""
        return tuple(trial_id for trial_id in self.members if trial_id not in self.ending)


class PackDriver:
    """Drives the packs of a run.

    Args:
        store: The sweep.
        spec: The sweep's spec.
        plan: The number of packs, and how many trials each trains at once.
        trial_ids: The trials to run, in the order in which they are assigned.
        scheduler: Compares the trials and ends the worse.
        keeper: Keeps their records.
        choose: Called with a trial that is being assigned, to choose its point; None: all points are known.
        more_packs: The most packs beside those of the plan, for nodes that join.
    """

    def __init__(
        self,
        store: Sweep,
        spec: SweepSpec,
        plan: PackPlan,
        trial_ids: Sequence[str],
        *,
        scheduler: Scheduler,
        keeper: RecordKeeper,
        choose: Callable[[str], None] | None = None,
        more_packs: int = 0,
    ) -> None:
        self._store = store
        self._slots = plan.slots
        self._max_retries = spec.max_retries
        self._scheduler = scheduler
        self._keeper = keeper
        self._choose = choose
        self._waiting = deque(trial_ids)
        self._alone: deque[str] = deque()
        self._known: set[str] = set()
        self._num_failures: Counter[str] = Counter()
        self._num_deaths: Counter[str] = Counter()
        num_packs = min(plan.num_packs, len(trial_ids))
        num_waiting = max(0, len(trial_ids) - num_packs * self._slots)
        num_more = min(more_packs, math.ceil(num_waiting / self._slots))
        self._packs = {f"p{i:02d}": _Pack(store.pack(f"p{i:02d}")) for i in range(num_packs + num_more)}
        for index, pack in enumerate(self._packs.values()):
            if index < num_packs:
                # If there are fewer trials than room, they are spread evenly.
                self._fill(pack, min(self._slots, math.ceil(len(self._waiting) / (num_packs - index))))
            self._write(pack, soon=True)
        # Before any of their processes is started.
        store.settle()

    def __getstate__(self) -> dict[str, Any]:
        # As for `RecordKeeper`, Tune's pickle of this object is never read back.
        return {}

    @property
    def pack_ids(self) -> tuple[str, ...]:
        """The packs' names."""
        return tuple(self._packs)

    @property
    def is_finished(self) -> bool:
        """Whether there is nothing left to do."""
        # As long as trials wait, no pack is empty, unless the sweep is asked to stop.
        return not any(pack.members for pack in self._packs.values())

    def log_tail(self, pack_id: str) -> str:
        """Return the end of a pack's log."""
        return self._packs[pack_id].files.log_tail()

    def started(self, pack_id: str) -> None:
        """Note that a pack's process runs; one that has no trials yet is given some."""
        pack = self._packs[pack_id]
        if not pack.members:
            self._begin(pack)
        pack.is_up = True
        for trial_id in pack.members:
            self._keeper.started(trial_id)

    def is_of_no_use(self, pack_id: str) -> bool:
        """Whether a pack would have nothing to do if it got a node: all trials have one, or have ended."""
        if self._waiting or self._alone:
            return False
        pack = self._packs[pack_id]
        return not pack.members and all(other.is_up for other in self._packs.values() if other.members)

    def _begin(self, pack: _Pack) -> None:
        """Give trials to a pack that has a node and none: those of one that has none, else those that wait."""
        others = (other for other in self._packs.values() if other.members and not other.is_up)
        if (other := next(others, None)) is not None:
            # The other one is up later, and then in the place of this one.
            pack.members, other.members = other.members, pack.members
            self._write(other)
        else:
            self._fill(pack, self._slots)
        self._write(pack)

    def take(
        self, pack_id: str, reports: Sequence[MemberReport], *, node: str, pid: int, tell: Tell | None = None
    ) -> bool:
        """Take a pack's reports and decide what it does next; return whether it has nothing left to do.

        Args:
            pack_id: The pack.
            reports: What it reports.
            node: Where its process is.
            pid: Its process.
            tell: Tells its process what it has to train from now on; None: it reads that in the storage.
        """
        pack = self._packs[pack_id]
        if pack.tell is None:
            # What it has read in the storage it is told, too, so that it looks there no more.
            pack.told = None
        pack.tell = tell
        for report in reports:
            if report.progress is not None:
                self._progressed(pack, report.trial_id, report.progress, node, pid)
            elif report.lost:
                self._lost(pack, report.trial_id)
            else:
                self._failed(pack, report)
        self._fill(pack, self._slots)
        self._write(pack)
        return not pack.members

    def died(self, pack_id: str, error: str) -> None:
        """Handle the death of a pack's process, or an error of no single member; the pack is started again."""
        pack = self._packs[pack_id]
        pack.is_up, pack.tell = False, None
        in_company = len(pack.members) > 1
        for trial_id in list(pack.ending):
            self._stopped(pack, trial_id)
        for trial_id in list(pack.members):
            if in_company:
                self._num_deaths[trial_id] += 1
            else:
                self._num_failures[trial_id] += 1
            is_over = self._num_failures[trial_id] > self._max_retries
            self._keeper.failed(trial_id, error, retried=not is_over)
            if is_over:
                self._leave(pack, trial_id)
            elif in_company and self._num_deaths[trial_id] >= _DEATHS_IN_COMPANY:
                self._leave(pack, trial_id)
                self._alone.append(trial_id)
        self._fill(pack, self._slots)
        self._write(pack)

    def lost(self, pack_id: str) -> None:
        """Handle the end of a process that lost its pack to another one: no member has failed; it is started again."""
        self._restarts(pack_id, self._keeper.lost)

    def moved(self, pack_id: str, left: str) -> None:
        """Handle the loss of a pack's node: no member has failed; the pack is started again elsewhere.

        Args:
            pack_id: The pack.
            left: What became of the node, a sentence.
        """
        self._restarts(pack_id, lambda trial_id: self._keeper.moved(trial_id, left))

    def reached(self, pack_id: str) -> tuple[tuple[str, int], ...]:
        """Return the members of a pack, and the latest checkpoint that each has on disk."""
        members = self._packs[pack_id].members
        return tuple((name, max(self._store.trial(name).checkpoint_iterations(), default=0)) for name in members)

    def _restarts(self, pack_id: str, note: Callable[[str], None]) -> None:
        pack = self._packs[pack_id]
        pack.is_up, pack.tell = False, None
        for trial_id in list(pack.ending):
            # The next process is not told of them, so none would report their end.
            self._stopped(pack, trial_id)
        for trial_id in pack.members:
            note(trial_id)
        self._fill(pack, self._slots)
        self._write(pack)

    def closed(self, pack_id: str) -> None:
        """Handle a pack that Tune has ended: it has nothing to do, or the sweep stops and it did not save in time."""
        pack = self._packs[pack_id]
        pack.is_up, pack.tell = False, None
        for trial_id in list(pack.members):
            self._keeper.ended(trial_id)
            self._leave(pack, trial_id)

    def _progressed(self, pack: _Pack, trial_id: str, progress: Progress, node: str, pid: int) -> None:
        self._keeper.progressed(trial_id, progress, node=node, pid=pid)
        standing = Standing.of(trial_id, progress)
        if progress.status == "running":
            if trial_id in pack.ending:
                return
            if self._scheduler.reached(standing, NobodyWaits()) is Decision.STOP:
                self._scheduler.ended(standing)
                pack.ending.add(trial_id)
            return
        if progress.status in ("completed", "failed"):
            self._scheduler.ended(standing)
        self._keeper.ended(trial_id)
        self._leave(pack, trial_id)

    def _failed(self, pack: _Pack, report: MemberReport) -> None:
        """Handle the failure of a single member; unless it is not retried, the pack has opened it again."""
        trial_id = report.trial_id
        if trial_id in pack.ending:
            self._stopped(pack, trial_id)
            return
        self._num_failures[trial_id] += 1
        self._keeper.failed(trial_id, report.error or "", retried=report.retried, reached=report.reached)
        if not report.retried or self._store.stop_requested():
            self._leave(pack, trial_id)
        else:
            self._keeper.started(trial_id)

    def _lost(self, pack: _Pack, trial_id: str) -> None:
        """Handle a member that another process took over: it has not failed, and that process's results are on disk."""
        if trial_id in pack.ending:
            self._stopped(pack, trial_id)
            return
        self._keeper.lost(trial_id)
        self._leave(pack, trial_id)
        self._waiting.append(trial_id)

    def _stopped(self, pack: _Pack, trial_id: str) -> None:
        """Handle a member that was to be ended and is gone without a report: its checkpoints are those on disk."""
        checkpoints = candidates(self._store.trial(trial_id))
        self._keeper.change(trial_id, lambda record: transitions.with_checkpoints(record, checkpoints))
        self._keeper.ended(trial_id)
        self._leave(pack, trial_id)

    def _leave(self, pack: _Pack, trial_id: str) -> None:
        pack.members.pop(trial_id, None)
        pack.ending.discard(trial_id)

    def _fill(self, pack: _Pack, num_members: int) -> None:
        """Assign more trials to a pack; a trial that has to run alone is assigned only to an empty pack."""
        if self._store.stop_requested():
            return
        staying = pack.staying
        if self._alone and not staying:
            self._give(pack, self._alone.popleft())
            return
        if any(self._num_deaths[trial_id] >= _DEATHS_IN_COMPANY for trial_id in staying):
            return
        for _ in range(num_members - len(staying)):
            if self._waiting:
                self._give(pack, self._waiting.popleft())

    def _give(self, pack: _Pack, trial_id: str) -> None:
        if trial_id not in self._known:
            self._known.add(trial_id)
            if self._choose is not None:
                self._choose(trial_id)
            self._scheduler.begins(trial_id)
        pack.members[trial_id] = None
        if pack.is_up:
            self._keeper.started(trial_id)

    def _write(self, pack: _Pack, *, soon: bool = False) -> None:
        failures = {name: self._num_failures[name] for name in pack.staying if self._num_failures[name]}
        assignment = Assignment(pack.staying, failures)
        with self._keeper.owned():
            # A process that is told does not read it; the next one of the pack is begun after another write.
            pack.files.write(assignment, soon=soon or pack.tell is not None)
        if pack.tell is not None and assignment != pack.told:
            # In the storage it may see it late, and train members on that have ended.
            pack.tell(assignment)
            pack.told = assignment


class PackScheduler(FIFOScheduler):  # type: ignore[misc]
    """The Tune scheduler that asks the driver of the packs what a pack does next."""

    def __init__(self, driver: PackDriver) -> None:
        super().__init__()
        self._driver = driver

    def on_trial_result(
        self,
        tune_controller: TuneController,
        trial: Trial,
        result: dict[str, Any],
    ) -> str:
        """Pass the reports to the driver, and return its decision; packs that would have nothing to do ask no more."""
        reports: Sequence[MemberReport] = result["reports"].report
        process = result["process"].report
        is_done = self._driver.take(
            str(trial.config["pack_id"]),
            reports,
            node=result["node"],
            pid=result["pid"],
            # Ray runs a process's calls in the order in which they were made: this one before the next step.
            tell=process.assign.remote,
        )
        for other in tune_controller.get_trials():
            # An autoscaler adds nodes for those that wait for one.
            if other.status == other.PENDING and self._driver.is_of_no_use(str(other.config["pack_id"])):
                tune_controller.stop_trial(other)
        return str(TrialScheduler.STOP if is_done else TrialScheduler.CONTINUE)
