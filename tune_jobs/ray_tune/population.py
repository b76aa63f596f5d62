"""Population based training (Jaderberg et al. 2017): who goes on from whom, and how Ray Tune lets them.

Every so many env steps a trial is compared with the others. One of the worst goes on from a copy of the latest
checkpoint of one of the best, with the better one's searched values mutated. What changed is written into the trial's
record before anything acts on it, so a sweep that is killed goes on with it.
"""

from __future__ import annotations

import copy
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ray.tune.experiment import Trial
from ray.tune.schedulers import TrialScheduler

from analysis.records import ChangeRecord, TrialRecord
from policies import random_streams
from policies.errors import CheckpointError, SpecError
from tune_jobs.plan.sweep_plan import point_hyperparams
from tune_jobs.ray_tune.early_stopping import OfTune, TuneScheduler, name_of, standing_of
from tune_jobs.ray_tune.scheduling import WORST_SCORE, CopyFrom, Decision, Others, Standing
from tune_jobs.search.mutation import mutate
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.copies import copy_latest_checkpoint
from tune_jobs.store.transitions import with_change

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController

_LOG = logging.getLogger(__name__)
_ATTEMPTS = 20

ReadRecord = Callable[[str], TrialRecord]
Change = Callable[[str, Callable[[TrialRecord], TrialRecord]], None]


@dataclass
class _Compared:
    """Where a trial stood when it was compared last."""

    num_env_steps: int
    """When that was."""
    due_from: int
    """Env steps from which the interval to the next time counts."""
    score: float | None
    """None: it never was."""


class Population:
    """The comparing, as a `Scheduler`; the rule is that of Ray Tune's `PopulationBasedTraining`, but for two things.

    A trial is copied from only if it is better, and may be at its very first comparison: in Ray's way, after it was
    compared a second time, as one of the best.

    Args:
        spec: The sweep.
        read: The newest record of a trial.
    """

    def __init__(self, spec: SweepSpec, read: ReadRecord) -> None:
        self._spec = spec
        self._read = read
        self._members: dict[str, _Compared] = {}

    def begins(self, trial_id: str) -> None:
        """Take a trial into the population, at the place it has by its record: a resumed one is half-way."""
        record, interval = self._read(trial_id), self._spec.perturb_every_env_steps
        score = WORST_SCORE if record.evaluation_return is None else record.evaluation_return
        steps = record.num_env_steps
        self._members[trial_id] = _Compared(steps, steps // interval * interval, score if steps else None)

    def compared_at(self, trial_id: str) -> int:
        """Env steps at which a trial was compared last; where it began, if it never was."""
        return self._members[trial_id].num_env_steps

    def reached(self, standing: Standing, others: Others) -> Decision | CopyFrom:
        """See `Scheduler.reached`."""
        member, steps = self._members[standing.trial_id], standing.num_env_steps
        if not standing.evaluated or steps - member.due_from < self._spec.perturb_every_env_steps:
            return Decision.GO_ON
        member.num_env_steps = member.due_from = steps
        member.score = standing.score
        worst, best = self._quantiles(others)
        better = [other for other in best if _score(self._members[other]) > standing.score]
        if standing.trial_id not in worst or not better:
            return Decision.SAVE
        record = self._read(standing.trial_id)
        rng = random_streams.mutation(self._spec.seed, record.index, len(record.changes))
        chosen = better[int(rng.integers(len(better)))]
        return CopyFrom(chosen, self._mutated(self._read(chosen).point, rng))

    def ended(self, standing: Standing) -> None:
        """See `Scheduler.ended`: who has ended, failed ones too, the others tell."""

    def _quantiles(self, others: Others) -> tuple[list[str], list[str]]:
        """The worst and the best of those that run and have a score; none of a population of one."""
        ended = others.ended()
        known = {name: member for name, member in self._members.items() if name not in ended and _is_scored(member)}
        ranked = sorted(known, key=lambda name: _score(known[name]))
        size = min(math.ceil(len(ranked) * self._spec.scheduler.quantile_fraction), len(ranked) // 2)
        return ranked[:size], ranked[len(ranked) - size :]

    def _mutated(self, point: dict[str, Any], rng: Any) -> dict[str, Any]:
        """A mutation whose values go together; the point itself if none is found."""
        for _ in range(_ATTEMPTS):
            mutated = mutate(point, self._spec.space, rng, self._spec.scheduler.resample_probability)
            try:
                point_hyperparams(self._spec, mutated, 0)
            except SpecError:
                continue
            return mutated
        return point


def _score(member: _Compared) -> float:
    assert member.score is not None
    return member.score


def _is_scored(member: _Compared) -> bool:
    return member.score is not None and not math.isnan(member.score)


class PopulationScheduler(TuneScheduler):
    """Does with Ray Tune's trials what a `Population` decides; those that wait and are least far go first.

    Two private members of Ray are used (2.60). `_schedule_trial_save` has a running trial save, and gives a pointer of
    Tune's to what it will have saved. `_latest_checkpoint_result` is what a paused trial's next start is given; without
    it Tune would start the trial from nothing. Ray's own scheduler uses both, and there is no public way to either.

    Args:
        spec: The sweep.
        store: Its folder.
        read: The newest record of a trial.
        change: Changes a trial's record, on disk too.
    """

    def __init__(self, spec: SweepSpec, store: Sweep, read: ReadRecord, change: Change) -> None:
        self._population = Population(spec, read)
        super().__init__(self._population)
        self._spec = spec
        self._store = store
        self._read = read
        self._change = change
        self._saved: dict[str, Any] = {}
        """Tune's pointer to what a trial saved at its last comparison, or what will be one."""

    def on_trial_result(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> str:
        """See `TrialScheduler`."""
        others = OfTune(tune_controller)
        decision = self._population.reached(standing_of(trial, result), others)
        if decision is Decision.GO_ON:
            return str(TrialScheduler.CONTINUE)
        gives_way = others.wait()
        if isinstance(decision, CopyFrom):
            try:
                self._take_over(trial, decision, result, tune_controller)
            except CheckpointError as error:
                _LOG.warning("%s goes on as it is: %s", name_of(trial), error)
            else:
                return str(TrialScheduler.NOOP)
        # Saved by the trial's process before it trains on.
        self._saved[name_of(trial)] = tune_controller._schedule_trial_save(trial, result=result)  # noqa: SLF001
        return str(TrialScheduler.PAUSE if gives_way else TrialScheduler.CONTINUE)

    def choose_trial_to_run(self, tune_controller: TuneController) -> Trial | None:
        """See `TrialScheduler`."""
        waiting = [trial for trial in tune_controller.get_trials() if trial.status in (Trial.PENDING, Trial.PAUSED)]
        return min(waiting, key=lambda trial: self._population.compared_at(name_of(trial)), default=None)

    def _take_over(self, trial: Trial, decision: CopyFrom, result: dict[str, Any], controller: TuneController) -> None:
        """Let a trial go on from a copy of a better one's checkpoint.

        Raises:
            CheckpointError: The better one has none, or it is damaged.
        """
        pointer = self._pointer(decision.trial_id)
        record = self._read(name_of(trial))
        # The record is of the report before this one: Tune asks its scheduler first.
        iteration, num_env_steps = result["progress/num_iterations"], result["num_env_steps"]
        copied = copy_latest_checkpoint(
            self._store.trial(decision.trial_id), self._store.trial(record.trial_id), iteration
        )
        entry = ChangeRecord(
            iteration=iteration,
            num_env_steps=num_env_steps,
            source_trial_id=decision.trial_id,
            source_iteration=copied.iteration,
            before=record.point,
            after=decision.point,
            time=time.time(),
        )
        hyperparams = point_hyperparams(self._spec, decision.point, record.point_index).model_dump(mode="json")
        # This makes the copy count; see tune_jobs.store.copies.
        self._change(record.trial_id, lambda known: with_change(known, entry, hyperparams))
        controller.pause_trial(trial, should_checkpoint=False)
        trial.run_metadata.checkpoint_manager._latest_checkpoint_result = pointer  # noqa: SLF001

    def _pointer(self, trial_id: str) -> Any:
        """Tune's pointer to what a trial saved at its last comparison.

        Raises:
            CheckpointError: It has not saved anything since.
        """
        saved = self._saved.get(trial_id)
        if saved is not None and hasattr(saved, "resolve"):
            saved = self._saved[trial_id] = saved.resolve()
        if saved is None or saved.checkpoint is None:
            raise CheckpointError(f"Trial {trial_id} has not saved a checkpoint yet.")
        return copy.copy(saved)
