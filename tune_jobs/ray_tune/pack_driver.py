"""Assign trials to packs, end those that the scheduler ends, and restart the members of a pack that died.

For Ray Tune, each pack is one trial. Tune calls its scheduler with a pack's reports before it lets the pack continue,
so a decision takes effect in the pack's next step. The sweep's own scheduler (`tune_jobs.ray_tune.scheduling`)
compares the members, whichever pack they are in.

On a cluster there may be more packs than the nodes hold, which Tune starts on nodes that join: they train trials that
wait, and those of a pack that has lost its node and got no other. A trial that a process trains stays with it. Where
trials wait for each other, those of such a pack are given places of those that wait for them, after a while.

A pack whose process died is started again, and its members go on from their latest checkpoints. One of them may be
the cause: a member that was twice in a pack that died continues alone, and only its failures alone count against its
retries.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.ray_tune.meetings import assignment_of, compared_with, goes_on_from, meeting_of
from tune_jobs.ray_tune.pack_failures import PackFailures
from tune_jobs.ray_tune.pack_state import PackState, Tell
from tune_jobs.ray_tune.scheduling import CopyFrom, Decision, NobodyWaits, Scheduler, Standing
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store import transitions
from tune_jobs.store.candidates import candidates
from tune_jobs.store.contract import Sweep
from tune_jobs.store.progress import Progress
from tune_jobs.store.record_keeper import RecordKeeper
from tune_jobs.training.pack_loop import MemberReport


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
        self._spec = spec
        self._meeting = meeting_of(scheduler)
        self._scheduler = self._meeting or scheduler
        self._keeper = keeper
        self._choose = choose
        self._waiting = deque(trial_ids)
        self._alone: deque[str] = deque()
        self._known: set[str] = set()
        self._failures = PackFailures(spec.max_retries)
        self._arrived: set[str] = set()
        """The trials that are saved and wait for others: their packs don't train them."""
        self._outside: set[str] = set()
        """Those of them that have given their place to a trial that had none."""
        if self._meeting is not None:
            # The order in which they get places must not decide whom a trial is compared with.
            todo = set(trial_ids)
            self._meeting.begin(compared_with(todo, keeper.all_records(), spec.seeds_per_point), todo)
        num_packs = min(plan.num_packs, len(trial_ids))
        num_waiting = max(0, len(trial_ids) - num_packs * self._slots)
        num_more = min(more_packs, math.ceil(num_waiting / self._slots))
        self._packs = {f"p{i:02d}": PackState(store.pack(f"p{i:02d}")) for i in range(num_packs + num_more)}
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
        return not any(pack.members for pack in self._packs.values()) and self._nobody_comes_back

    def log_tail(self, pack_id: str) -> str:
        """Return the end of a pack's log."""
        return self._packs[pack_id].files.log_tail()

    def started(self, pack_id: str) -> None:
        """Note that a pack's process runs; one that has no trials yet is given some."""
        pack = self._packs[pack_id]
        if not pack.members:
            self._begin(pack)
        pack.began()
        for trial_id in pack.members:
            self._keeper.started(trial_id)

    def is_of_no_use(self, pack_id: str) -> bool:
        """Whether a pack would have nothing to do if it got a node: all trials have one, or have ended."""
        if self._waiting or self._alone or self._outside:
            return False
        pack = self._packs[pack_id]
        return not pack.members and all(other.is_up for other in self._packs.values() if other.members)

    def _begin(self, pack: PackState) -> None:
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
            if report.trial_id not in pack.members:
                # It was told in the same moment in which it gave its place away, or was ended, as it waited.
                continue
            if report.progress is not None:
                self._progressed(pack, report, report.progress, node, pid)
            elif report.lost:
                self._lost(pack, report.trial_id)
            else:
                self._failed(pack, report)
        self._decide()
        self._fill(pack, self._slots)
        self._write(pack)
        return not pack.members and self._nobody_comes_back

    @property
    def _nobody_comes_back(self) -> bool:
        """Whether no trial will need a place again that has given its own away."""
        return not self._outside or self._keeper.stop_requested()

    def died(self, pack_id: str, error: str) -> None:
        """Handle the death of a pack's process, or an error of no single member; the pack is started again."""
        pack = self._packs[pack_id]
        pack.ended()
        in_company = len(pack.members) > 1
        for trial_id in list(pack.ending):
            self._stopped(pack, trial_id)
        for trial_id in list(pack.members):
            is_over = self._failures.died(trial_id, in_company=in_company)
            self._keeper.failed(trial_id, error, retried=not is_over)
            self._left(trial_id, for_good=is_over)
            if is_over:
                self._leave(pack, trial_id)
            elif in_company and self._failures.is_alone(trial_id):
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
        pack.ended()
        for trial_id in list(pack.ending):
            # The next process is not told of them, so none would report their end.
            self._stopped(pack, trial_id)
        for trial_id in pack.members:
            note(trial_id)
            self._left(trial_id)
        self._fill(pack, self._slots)
        self._write(pack)

    def closed(self, pack_id: str) -> None:
        """Handle a pack that Tune has ended: it has nothing to do, or the sweep stops and it did not save in time."""
        pack = self._packs[pack_id]
        pack.ended()
        for trial_id in list(pack.members):
            self._keeper.ended(trial_id)
            self._left(trial_id, for_good=True)
            self._leave(pack, trial_id)

    def _progressed(self, pack: PackState, report: MemberReport, progress: Progress, node: str, pid: int) -> None:
        trial_id = report.trial_id
        self._keeper.progressed(trial_id, progress, node=node, pid=pid)
        standing = Standing.of(trial_id, progress)
        if progress.status == "running":
            if trial_id in pack.ending:
                if report.waits:
                    # It is saved, and its process will end it without a further report.
                    self._stopped(pack, trial_id)
                return
            if self._meeting is not None and report.waits:
                self._arrived.add(trial_id)
                self._meeting.arrives(standing)
            elif self._scheduler.reached(standing, NobodyWaits()) is Decision.STOP:
                self._scheduler.ended(standing)
                pack.ending.add(trial_id)
            return
        if progress.status in ("completed", "failed"):
            self._scheduler.ended(standing)
        self._keeper.ended(trial_id)
        self._leave(pack, trial_id)

    def _failed(self, pack: PackState, report: MemberReport) -> None:
        """Handle the failure of a single member; unless it is not retried, the pack has opened it again."""
        trial_id = report.trial_id
        if trial_id in pack.ending:
            self._stopped(pack, trial_id)
            return
        if report.counts:
            self._failures.failed(trial_id)
        self._left(trial_id, for_good=not report.retried)
        self._keeper.failed(trial_id, report.error or "", retried=report.retried, reached=report.reached)
        if not report.retried or self._keeper.stop_requested():
            self._leave(pack, trial_id)
        else:
            self._keeper.started(trial_id)

    def _lost(self, pack: PackState, trial_id: str) -> None:
        """Handle a member that another process took over: it has not failed, and that process's results are on disk."""
        if trial_id in pack.ending:
            self._stopped(pack, trial_id)
            return
        self._keeper.lost(trial_id)
        self._left(trial_id)
        self._leave(pack, trial_id)
        self._waiting.append(trial_id)

    def _stopped(self, pack: PackState | None, trial_id: str) -> None:
        """Handle a member that was to be ended and is gone without a report: its checkpoints are those on disk."""
        checkpoints = candidates(self._store.trial(trial_id))
        self._keeper.change(trial_id, lambda record: transitions.with_checkpoints(record, checkpoints))
        self._keeper.ended(trial_id)
        self._leave(pack, trial_id)

    def _left(self, trial_id: str, *, for_good: bool = False) -> None:
        """Note that no process holds a trial where it may have waited: it will come there again, or has failed."""
        self._arrived.discard(trial_id)
        if self._meeting is not None:
            (self._meeting.gone if for_good else self._meeting.leaves)(trial_id)

    def _decide(self) -> None:
        """Do what the scheduler has decided about trials that waited, in all packs."""
        if self._meeting is None or not (outcomes := self._meeting.take_outcomes()):
            return
        places = {trial_id: pack for pack in self._packs.values() for trial_id in pack.members}
        for trial_id, outcome in outcomes.items():
            pack = places.get(trial_id)
            if outcome is Decision.STOP:
                self._end(pack, trial_id)
            else:
                if isinstance(outcome, CopyFrom):
                    goes_on_from(outcome, self._spec, self._store, self._keeper.record(trial_id), self._keeper.change)
                self._goes_on(trial_id)
        for pack in self._packs.values():
            if pack.is_up:
                self._fill(pack, self._slots)
            self._write(pack)

    def _end(self, pack: PackState | None, trial_id: str) -> None:
        if pack is not None and pack.tell is not None and trial_id not in self._arrived:
            pack.ending.add(trial_id)
            return
        # No process trains it, or one that has told nothing yet, and would not tell its end either.
        for others in (self._waiting, self._alone):
            if trial_id in others:
                others.remove(trial_id)
        self._outside.discard(trial_id)
        if trial_id not in self._keeper.running:
            self._keeper.started(trial_id)  # as in the next process, where it would end
        self._stopped(pack, trial_id)

    def _goes_on(self, trial_id: str) -> None:
        self._arrived.discard(trial_id)
        if trial_id in self._outside:
            self._outside.discard(trial_id)
            (self._alone if self._failures.is_alone(trial_id) else self._waiting).append(trial_id)

    def _take_in(self, pack: PackState) -> None:
        """Let trials whose pack gets no process have places in one where all wait, maybe for them."""
        if self._waiting or self._alone or not all(trial_id in self._arrived for trial_id in pack.staying):
            return
        for other in self._packs.values():
            if other.is_given_up:
                for trial_id in tuple(other.members):
                    self._leave(other, trial_id)
                    # Nobody trains it, as if it had given its place away.
                    self._outside.add(trial_id)
                    self._goes_on(trial_id)
                self._write(other)

    def _make_room(self, pack: PackState) -> None:
        """Let members that wait for others give their places to trials that have none; they are saved."""
        arrived = [trial_id for trial_id in pack.staying if trial_id in self._arrived]
        num_wanted = len(self._waiting) + len(pack.staying) - self._slots
        is_for_one = bool(self._alone) or any(map(self._failures.is_alone, arrived))
        if is_for_one and (self._alone or self._waiting) and len(arrived) == len(pack.staying):
            num_wanted = len(arrived)
        for trial_id in arrived[: max(0, num_wanted)]:
            del pack.members[trial_id]
            self._outside.add(trial_id)
            self._keeper.paused(trial_id)

    def _leave(self, pack: PackState | None, trial_id: str) -> None:
        self._arrived.discard(trial_id)
        if pack is not None:
            pack.members.pop(trial_id, None)
            pack.ending.discard(trial_id)

    def _fill(self, pack: PackState, num_members: int) -> None:
        """Assign more trials to a pack; a trial that has to run alone is assigned only to an empty pack."""
        if self._keeper.stop_requested():
            return
        if self._meeting is not None and pack.is_up:
            self._take_in(pack)
        if self._arrived:
            self._make_room(pack)
        staying = pack.staying
        if self._alone and not staying:
            self._give(pack, self._alone.popleft())
            return
        if any(map(self._failures.is_alone, staying)):
            return
        for _ in range(num_members - len(staying)):
            if self._waiting:
                self._give(pack, self._waiting.popleft())

    def _give(self, pack: PackState, trial_id: str) -> None:
        if trial_id not in self._known:
            self._known.add(trial_id)
            if self._choose is not None:
                self._choose(trial_id)
            if self._meeting is None:
                self._scheduler.begins(trial_id)
        pack.members[trial_id] = None
        if pack.is_up:
            self._keeper.started(trial_id)

    def _write(self, pack: PackState, *, soon: bool = False) -> None:
        records = [self._keeper.record(trial_id) for trial_id in pack.staying]
        assignment = assignment_of(records, self._failures.of(pack.staying), self._meeting)
        pack.assign(assignment, self._keeper.owned, soon=soon)
