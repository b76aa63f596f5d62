"""A trial with fakes for its engine, its evaluator and its clock."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task

from analysis.records import IterationRecord
from policies.acting.evaluate import Evaluator
from tune_jobs.store.progress import Progress
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.trial_loop import TrialLoop


class Trial:
    """A loop and its fakes; `open` is called."""

    def __init__(
        self,
        folder: Path,
        *,
        engine: FakeEngine | None = None,
        scores: Callable[[int], float] = float,
        clock: Callable[[], float] | None = None,
        **task: Any,
    ) -> None:
        self.engine = engine or FakeEngine()
        self.evaluator = FakeEvaluator(scores)
        self.store = TrialStore(folder, "t0000")
        evaluator = cast("Evaluator", self.evaluator)
        self.loop = TrialLoop(make_task(folder, **task), self.engine, evaluator, clock or FakeClock())
        self.loop.open()

    def run(self, max_reports: int = 1_000) -> Progress:
        """To the end; returns the last report."""
        for _ in range(max_reports):
            progress = self.loop.advance(math.inf)
            if progress.status != "running":
                break
        return progress

    def run_to(self, iteration: int) -> Progress:
        """Until so many iterations are done, evaluated each."""
        while self.loop.iteration < iteration:
            progress = self.loop.advance(math.inf)
        return progress

    @property
    def kept(self) -> list[int]:
        return [record.iteration for record in self.store.checkpoints()]

    @property
    def results(self) -> list[IterationRecord]:
        return self.store.read_iterations()
