"""Run one trial from start to end by an engine that trains one trial at a time."""

from __future__ import annotations

import time
from collections.abc import Callable

from policies.acting.evaluate import Episodes, Evaluator
from policies.envs.tallies import evaluating
from policies.errors import NonFiniteWeightsError
from tune_jobs.store.contract import Ownership
from tune_jobs.store.progress import Progress
from tune_jobs.training.protocol import TrainingEngine, TrialTask
from tune_jobs.training.trial_steps import TrialSteps


class TrialLoop(TrialSteps):
    """Runs one trial, by `advance`.

    Args:
        task: The trial to run.
        engine: Trains the trial; it is reused for other trials.
        evaluator: As for `TrialSteps`, and so are the others.
    """

    def __init__(
        self,
        task: TrialTask,
        engine: TrainingEngine,
        evaluator: Evaluator,
        clock: Callable[[], float] = time.perf_counter,
        under: Ownership | None = None,
    ) -> None:
        super().__init__(task, engine, evaluator, clock, under)
        self._trains = engine

    def advance(self, max_s: float) -> Progress:
        """Train until the next evaluation, the end, or for `max_s` seconds, whichever comes first.

        Raises:
            Exception: Any error of the engine or the environment.
        """
        deadline = self._clock() + max_s
        try:
            while True:
                progress = self._one_iteration()
                if progress.status != "running" or progress.evaluated or self._clock() >= deadline:
                    return self.told(progress)
        finally:
            self.flush()

    def _one_iteration(self) -> Progress:
        progress = self.before_iteration(stop=self._sweep.stop_requested())
        if progress is not None:
            return progress
        evaluation: Episodes | NonFiniteWeightsError | None = None
        try:
            if self.take(self._trains.train_iteration()):
                with evaluating([self.task.trial_id]):
                    evaluation = self._evaluator.run(self.policy())
        except NonFiniteWeightsError as error:
            evaluation = error
        return self.conclude(evaluation)
