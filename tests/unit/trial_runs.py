"""A trial with fakes for its engine, its evaluator and its clock."""

import math

from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task

from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.trial_loop import TrialLoop


class Trial:
    """A loop and its fakes; `open` is called."""

    def __init__(self, folder, *, engine=None, scores=float, clock=None, **task):
        self.engine = engine or FakeEngine()
        self.evaluator = FakeEvaluator(scores)
        self.store = TrialStore(folder, "t0000")
        self.loop = TrialLoop(make_task(folder, **task), self.engine, self.evaluator, clock or FakeClock())
        self.loop.open()

    def run(self, max_reports=1_000):
        """To the end; returns the last report."""
        for _ in range(max_reports):
            progress = self.loop.advance(math.inf)
            if progress.status != "running":
                break
        return progress

    def run_to(self, iteration):
        """Until so many iterations are done, evaluated each."""
        while self.loop.iteration < iteration:
            progress = self.loop.advance(math.inf)
        return progress

    @property
    def kept(self):
        return [record.iteration for record in self.store.checkpoints()]

    @property
    def results(self):
        return self.store.read_iterations()
