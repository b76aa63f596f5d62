"""A pack with fakes for its engine, its evaluator and its clock: each member does as its own script says."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, cast

from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task

from analysis.records import IterationRecord
from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.policy import Policy
from policies.portable.file import PortablePolicy
from tune_jobs.store.contract import Ownership
from tune_jobs.store.progress import Progress
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.pack_loop import MemberReport, PackLoop
from tune_jobs.training.protocol import IterationStats, TrialTask


class FakePackEngine:
    """Members are `FakeEngine`s; `make(trial_id)` gives the script of one.

    Args:
        make: Trial id -> the engine of that member.
    """

    def __init__(self, make: Callable[[str], FakeEngine] = lambda trial_id: FakeEngine()) -> None:
        self._make = make
        self.members: dict[str, FakeEngine] = {}
        self.builds: list[tuple[str, int | None]] = []
        self.num_iterations, self.closed = 0, False
        self.moved: Collection[str] = ()

    def add(self, task: TrialTask, checkpoint: Path | None) -> None:
        assert task.trial_id not in self.members
        engine = self._make(task.trial_id)
        self.builds.append((task.trial_id, None if checkpoint is None else int(checkpoint.name)))
        engine.build(task, checkpoint)
        self.members[task.trial_id] = engine

    def train_iteration(self, held: Collection[str] = ()) -> dict[str, IterationStats | Exception]:
        self.num_iterations += 1
        results: dict[str, IterationStats | Exception] = {}
        for trial_id, engine in self.members.items():
            if trial_id in held:
                continue
            try:
                results[trial_id] = engine.train_iteration()
            except Exception as error:  # noqa: BLE001
                results[trial_id] = error
        return results

    def policy(self, trial_id: str) -> PortablePolicy:
        return self.members[trial_id].policy()

    def save(self, trial_id: str, folder: Path) -> None:
        self.members[trial_id].save(folder)

    def remove(self, trial_id: str) -> None:
        del self.members[trial_id]

    def close(self) -> None:
        self.closed = True


class Pack:
    """A pack loop and its fakes.

    Args:
        folder: The sweep's.
        make: Trial id -> the engine of that member.
        scores: Iteration -> evaluation return.
        max_retries: Of a member that fails.
        clock: Seconds.
        under: The owner of the pack.
        task: Sections of the members' tasks.
    """

    def __init__(
        self,
        folder: Path,
        make: Callable[[str], FakeEngine] = lambda trial_id: FakeEngine(),
        *,
        scores: Callable[[int], float] = float,
        max_retries: int = 0,
        clock: Callable[[], float] | None = None,
        watch: Callable[[float], AbstractContextManager[Any]] | None = None,
        under: Ownership | None = None,
        **task: Any,
    ) -> None:
        self.folder, self.task, self.stop = folder, task, False
        self.engine = FakePackEngine(make)
        self.evaluator = FakeEvaluator(scores)
        self.batches: list[int] = []
        self.waits: list[float] = []
        self.loop = PackLoop(
            self.engine,
            cast("Evaluator", self.evaluator),
            self._evaluate,
            stop_requested=lambda: self.stop,
            max_retries=max_retries,
            clock=clock or FakeClock(),
            wait=self.waits.append,
            under=under,
            **({} if watch is None else {"watch": watch}),
        )
        self.reports: list[MemberReport] = []

    def _evaluate(self, evaluator: Evaluator, policies: Sequence[Policy]) -> list[Episodes | Exception]:
        self.batches.append(len(policies))
        results: list[Episodes | Exception] = []
        for policy in policies:
            try:
                results.append(evaluator.run(policy))
            except Exception as error:  # noqa: BLE001
                results.append(error)
        return results

    def add(self, *trial_ids: str, num_failures: int = 0) -> Pack:
        for trial_id in trial_ids:
            task = dataclasses.replace(make_task(self.folder, **self.task), trial_id=trial_id)
            self.loop.add(task, num_failures)
        return self

    def advance(self, max_s: float = 0.0, *, until_evaluated: bool = False) -> list[MemberReport]:
        reports = self.loop.advance(max_s, until_evaluated=until_evaluated)
        self.reports += reports
        return reports

    def run(self, max_reports: int = 1_000) -> Pack:
        """Until no member is left."""
        for _ in range(max_reports):
            if not self.loop.trial_ids:
                break
            self.advance()
        return self

    def of(self, trial_id: str) -> list[MemberReport]:
        """The reports of a member."""
        return [report for report in self.reports if report.trial_id == trial_id]

    def last(self, trial_id: str) -> Progress:
        """Where a member was last."""
        progress = self.of(trial_id)[-1].progress
        assert progress is not None
        return progress

    def store(self, trial_id: str) -> TrialStore:
        return TrialStore(self.folder, trial_id)


def statuses(pack: Pack) -> dict[str, str]:
    return {report.trial_id: report.progress.status for report in pack.reports if report.progress is not None}


def without_times(progress: Progress) -> Progress:
    return progress.model_copy(update={"started_at": None, "ended_at": None})


def without_episodes(record: IterationRecord) -> IterationRecord:
    return record.model_copy(update={"episode_returns": (), "episode_lengths": ()})


def results(pack: Pack, trial_id: str) -> list[int]:
    return [record.iteration for record in pack.store(trial_id).read_iterations()]
