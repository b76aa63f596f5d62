"""A pack with fakes for its engine, its evaluator and its clock: each member does as its own script says."""

import dataclasses

from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task

from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.pack_loop import PackLoop


class FakePackEngine:
    """Members are `FakeEngine`s; `make(trial_id)` gives the script of one.

    Args:
        make: Trial id -> the engine of that member.
    """

    def __init__(self, make=lambda trial_id: FakeEngine()):
        self._make = make
        self.members, self.builds, self.num_iterations, self.closed = {}, [], 0, False

    def add(self, task, checkpoint):
        assert task.trial_id not in self.members
        engine = self._make(task.trial_id)
        self.builds.append((task.trial_id, None if checkpoint is None else int(checkpoint.name)))
        engine.build(task, checkpoint)
        self.members[task.trial_id] = engine

    def train_iteration(self):
        self.num_iterations += 1
        results = {}
        for trial_id, engine in self.members.items():
            try:
                results[trial_id] = engine.train_iteration()
            except Exception as error:  # noqa: BLE001
                results[trial_id] = error
        return results

    def policy(self, trial_id):
        return self.members[trial_id].policy()

    def save(self, trial_id, folder):
        self.members[trial_id].save(folder)

    def remove(self, trial_id):
        del self.members[trial_id]

    def close(self):
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
        folder,
        make=lambda trial_id: FakeEngine(),
        *,
        scores=float,
        max_retries=0,
        clock=None,
        watch=None,
        under=None,
        **task,
    ):
        self.folder, self.task, self.stop = folder, task, False
        self.engine = FakePackEngine(make)
        self.evaluator = FakeEvaluator(scores)
        self.batches = []
        self.loop = PackLoop(
            self.engine,
            self.evaluator,
            self._evaluate,
            stop_requested=lambda: self.stop,
            max_retries=max_retries,
            clock=clock or FakeClock(),
            under=under,
            **({} if watch is None else {"watch": watch}),
        )
        self.reports = []

    def _evaluate(self, evaluator, policies):
        self.batches.append(len(policies))
        results = []
        for policy in policies:
            try:
                results.append(evaluator.run(policy))
            except Exception as error:  # noqa: BLE001
                results.append(error)
        return results

    def add(self, *trial_ids, num_failures=0):
        for trial_id in trial_ids:
            task = dataclasses.replace(make_task(self.folder, **self.task), trial_id=trial_id)
            self.loop.add(task, num_failures)
        return self

    def advance(self, max_s=0.0, *, until_evaluated=False):
        reports = self.loop.advance(max_s, until_evaluated=until_evaluated)
        self.reports += reports
        return reports

    def run(self, max_reports=1_000):
        """Until no member is left."""
        for _ in range(max_reports):
            if not self.loop.trial_ids:
                break
            self.advance()
        return self

    def of(self, trial_id):
        """The reports of a member."""
        return [report for report in self.reports if report.trial_id == trial_id]

    def last(self, trial_id):
        """Where a member was last."""
        return self.of(trial_id)[-1].progress

    def store(self, trial_id):
        return TrialStore(self.folder, trial_id)
