"""Population based training (Jaderberg et al. 2017), and how it is done with Ray Tune's trials.

At regular numbers of env steps a trial is compared with the others. One of the worst continues from a copy of the
latest checkpoint of one of the best, with mutated values of the better one. The change is written into the trial's
record before it takes effect, so that a sweep that is killed continues with it.

With several frequencies the trials are as many sub-populations; see `tune_jobs.search.subpopulations`.
"""

from __future__ import annotations

import copy
import logging
import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from ray.tune.experiment import Trial
from ray.tune.schedulers import TrialScheduler
from typing_extensions import override

from analysis.records import ChangeRecord, TrialRecord
from policies import random_streams
from policies.errors import CheckpointError, SpecError
from tune_jobs.plan.points import point_hyperparams
from tune_jobs.ray_tune.pointers import latest_iteration, pointer_to, result_of
from tune_jobs.ray_tune.scheduling import WORST_SCORE, CopyFrom, Decision, Others, Standing
from tune_jobs.ray_tune.tune_scheduler import OfTune, TuneScheduler, is_starting, name_of, standing_of
from tune_jobs.search.bandit import Gain, Next, propose
from tune_jobs.search.comparisons import Comparison, last_over, made_together
from tune_jobs.search.gains import Curves, Evaluations, gains_of
from tune_jobs.search.mutation import mutate
from tune_jobs.search.subpopulations import Migration, Ranked, migrations, subpopulation_of
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.copies import copy_latest_checkpoint
from tune_jobs.store.transitions import with_change

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController

_LOG = logging.getLogger(__name__)
_ATTEMPTS = 20

ReadRecord = Callable[[str], TrialRecord]
ReadRecords = Callable[[], Sequence[TrialRecord]]
ReadCurves = Callable[[Sequence[str]], Curves]
Change = Callable[[str, Callable[[TrialRecord], TrialRecord]], None]


@dataclass
class _Compared:
    """A trial's standing when it was compared last."""

    num_env_steps: int
    """Env steps of the last comparison."""
    due_from: int
    """Env steps from which the interval to the next comparison counts."""
    score: float | None
    """The score of the last comparison; None: there was none."""
    subpopulation: int
    """The number of the sub-population with which it is compared."""
    selected_from: int
    """Env steps from which the interval to the next selection of its sub-population counts."""
    before: Sequence[int] = ()
    """Env steps of its comparisons before the sweep was resumed."""


@dataclass(frozen=True)
class _Ranking:
    """All trials that may be compared now."""

    subpopulations: Sequence[Ranked]
    migrations: Mapping[str, Migration]


class Population:
    """A `Scheduler` with the rule of Ray Tune's `PopulationBasedTraining`, except for two things.

    A trial is copied from only if it is better, and already at its first comparison. Ray copies from a trial only after
    it was compared a second time as one of the best.

    Args:
        spec: The sweep.
        read: Returns the newest record of a trial.
        curves: Returns the evaluations of trials, by which pb2 chooses values; None: values are mutated.
        all_records: Returns the newest record of every trial of the sweep, including those of earlier runs, which don't
            begin again but are what pb2 knows; None: all trials begin in this run.
        before: The comparisons of trials that have trained already, before the sweep was resumed; of one that lacks,
            they are taken to have been at the multiples of the interval.
    """

    def __init__(
        self,
        spec: SweepSpec,
        read: ReadRecord,
        curves: ReadCurves | None = None,
        all_records: ReadRecords | None = None,
        *,
        before: Mapping[str, Sequence[Comparison]] = MappingProxyType({}),
    ) -> None:
        self._spec = spec
        self._read = read
        self._before = before
        self._curves = curves
        self._all_records = all_records
        self._frequencies = spec.scheduler.frequencies
        self._members: dict[str, _Compared] = {}
        self._ended: Collection[str] = ()
        """The trials that had ended when this comparison began."""
        self._chosen: dict[str, dict[str, Any]] = {}
        """The points of trials that are copied to in this comparison, which their records may not have yet."""
        self._gains: Sequence[Gain] | None = None
        """What is known at this comparison of what intervals have gained; None: nothing was read of it yet."""

    def begins(self, trial_id: str) -> None:
        """Add a trial to the population, with what it has trained already in a sweep that is resumed."""
        record, interval = self._read(trial_id), self._spec.perturb_every_env_steps
        own = subpopulation_of(record.index, len(self._frequencies))
        member = self._members[trial_id] = _Compared(record.num_env_steps, 0, None, own, 0)
        known = self._before.get(trial_id)
        if known is not None:
            self._count_from(member, [each.num_env_steps for each in known])
            member.score = _score_of(known[-1].score) if known else None
        elif record.num_env_steps:
            self._count_from(member, range(interval, record.num_env_steps + 1, interval))
            member.score = _score_of(record.evaluation_return)

    def _count_from(self, member: _Compared, before: Sequence[int]) -> None:
        """Let a member have been compared at these env steps."""
        member.before, member.due_from = before, before[-1] if before else 0
        own = self._frequencies[member.subpopulation] * self._spec.perturb_every_env_steps
        member.selected_from = last_over(before, own)

    def in_step(self) -> None:
        """Let trials that are where they wait for the others be compared there, in a sweep that is resumed."""
        places = {name: member.before for name, member in self._members.items()}
        changes = {name: self._read(name).changes for name in places}
        made = made_together(places, {name: known[-1].num_env_steps for name, known in changes.items() if known})
        # Some may have been added, and are compared when they have come as far as they have to.
        for name, own in ({} if made is None else made).items():
            self._count_from(self._members[name], own)

    def compared_at(self, trial_id: str) -> int:
        """Return the env steps at which a trial was compared last, or at which it began if it never was."""
        return self._members[trial_id].num_env_steps

    def reached(self, standing: Standing, others: Others) -> Decision | CopyFrom:
        """Compare a trial with the others when its interval is over, and copy a better one if it is among the worst."""
        if not standing.evaluated or standing.num_env_steps < self.due_at(standing.trial_id):
            return Decision.GO_ON
        return self.compared([standing], others)[standing.trial_id]

    def due_at(self, trial_id: str) -> int:
        """Return the env steps from which a trial is compared, at its next evaluation."""
        return self._members[trial_id].due_from + self._spec.perturb_every_env_steps

    def compared(self, standings: Sequence[Standing], others: Others) -> dict[str, Decision | CopyFrom]:
        """Compare trials whose interval is over with each other, and with what the others had at their last comparison.

        Args:
            standings: Of these trials, in the order in which they are decided about.
            others: What is known of the others.
        """
        selected = set()
        for standing in standings:
            member = self._members[standing.trial_id]
            member.num_env_steps = member.due_from = standing.num_env_steps
            member.score = standing.score
            interval = self._frequencies[member.subpopulation] * self._spec.perturb_every_env_steps
            if standing.num_env_steps >= member.selected_from + interval:
                member.selected_from = standing.num_env_steps
                selected.add(standing.trial_id)
        self._chosen, self._gains = {}, None
        self._ended = others.ended()
        ranking = self._ranking()
        return {
            standing.trial_id: self._decision(standing, ranking) if standing.trial_id in selected else Decision.SAVE
            for standing in standings
        }

    def _decision(self, standing: Standing, ranking: _Ranking) -> Decision | CopyFrom:
        migration = ranking.migrations.get(standing.trial_id)
        if migration is not None:
            point = self._read(migration.values_of).point
            return CopyFrom(migration.weights_of, point, values_of=migration.values_of)
        ranked = ranking.subpopulations[self._members[standing.trial_id].subpopulation]
        better = [other for other in ranked.best if _score(self._members[other]) > standing.score]
        if standing.trial_id not in ranked.worst or not better:
            return Decision.SAVE
        record = self._read(standing.trial_id)
        rng = random_streams.mutation(self._spec.seed, record.index, len(record.changes))
        chosen = better[int(rng.integers(len(better)))]
        point = self._chosen[standing.trial_id] = self._changed(standing, chosen, rng)
        return CopyFrom(chosen, point)

    def ended(self, standing: Standing) -> None:
        """Do nothing: `Others` tells which trials have ended, including those that failed."""

    def _ranking(self) -> _Ranking:
        """Rank the running trials that have a score, in each sub-population."""
        known = {
            name: member for name, member in self._members.items() if name not in self._ended and _is_scored(member)
        }
        scores = {name: _score(member) for name, member in known.items()}
        numbers = range(len(self._frequencies))
        ranked = [
            Ranked.of(
                {name: scores[name] for name, member in known.items() if member.subpopulation == number},
                self._spec.scheduler.quantile_fraction,
            )
            for number in numbers
        ]
        found = [migrations(number, ranked, scores) for number in numbers]
        return _Ranking(ranked, {name: migration for each in found for name, migration in each.items()})

    def _changed(self, standing: Standing, chosen: str, rng: np.random.Generator) -> dict[str, Any]:
        """Return the point with which a trial goes on from a copy of a better one."""
        point, space = self._read(chosen).point, self._spec.space
        resample_probability = self._spec.scheduler.resample_probability
        if self._curves is None:
            return self._valid(point, lambda: mutate(point, space, rng, resample_probability))
        interval, score = self._spec.perturb_every_env_steps, _score(self._members[chosen])
        others = [name for name in self._members if name != standing.trial_id and name not in self._ended]
        meanwhile = [self._chosen.get(name) or self._read(name).point for name in others]
        coming = Next(standing.num_env_steps / interval + 1, score, point, meanwhile)
        if self._gains is None:
            records = list(map(self._read, self._members)) if self._all_records is None else self._all_records()
            self._gains = gains_of(records, self._curves([record.trial_id for record in records]), interval)
        gains = self._gains
        return self._valid(point, lambda: propose(coming, space, gains, rng, resample_probability))

    def _valid(self, point: dict[str, Any], draw: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return what is drawn if its values are valid together, or the point itself if none is found."""
        for _ in range(_ATTEMPTS):
            mutated = draw()
            try:
                point_hyperparams(self._spec, mutated, 0)
            except SpecError:
                continue
            return mutated
        return point


def _score_of(evaluation_return: float | None) -> float:
    return WORST_SCORE if evaluation_return is None else evaluation_return


def _score(member: _Compared) -> float:
    assert member.score is not None
    return member.score


def _is_scored(member: _Compared) -> bool:
    return member.score is not None and not math.isnan(member.score)


def take_over(spec: SweepSpec, store: Sweep, record: TrialRecord, decision: CopyFrom, change: Change) -> None:
    """Let a trial continue from a copy of a better one's latest checkpoint, with other values, when it is opened next.

    Args:
        spec: The sweep.
        store: The sweep's files.
        record: The trial, with the iterations and env steps that it has done; no process trains it now.
        decision: From which one, and with which values.
        change: Changes the trial's record, on disk too.

    Raises:
        CheckpointError: The better one has no checkpoint, or a damaged one.
    """
    source, target = store.trial(decision.trial_id), store.trial(record.trial_id)
    copied = copy_latest_checkpoint(source, target, record.num_iterations)
    entry = ChangeRecord(
        iteration=record.num_iterations,
        num_env_steps=record.num_env_steps,
        source_trial_id=decision.trial_id,
        source_iteration=copied.iteration,
        values_trial_id=decision.values_of,
        before=record.point,
        after=decision.point,
        time=time.time(),
    )
    hyperparams = point_hyperparams(spec, decision.point, record.point_index).model_dump(mode="json")
    # This makes the copy take effect; see tune_jobs.store.copies.
    change(record.trial_id, lambda known: with_change(known, entry, hyperparams))


class PopulationScheduler(TuneScheduler):
    """Applies the decisions of a `Population` to Ray Tune's trials, and lets those with the fewest env steps go first.

    Two private members of Ray are used (2.60). `_schedule_trial_save` makes a running trial save, and returns Tune's
    pointer to the checkpoint. `_latest_checkpoint_result` is passed to a paused trial's next start; without it Tune
    would start the trial from nothing. Ray's own scheduler uses both, and there is no public way to either.

    Args:
        spec: The sweep.
        store: The sweep's files.
        read: Returns the newest record of a trial.
        change: Changes a trial's record, on disk too.
        all_records: As for `Population`.
        before: As for `Population`.
    """

    def __init__(
        self,
        spec: SweepSpec,
        store: Sweep,
        read: ReadRecord,
        change: Change,
        *,
        all_records: ReadRecords | None = None,
        before: Mapping[str, Sequence[Comparison]] = MappingProxyType({}),
    ) -> None:
        curves = Evaluations(store) if spec.scheduler.type == "pb2" else None
        self._population = Population(spec, read, curves, all_records, before=before)
        super().__init__(self._population)
        self._spec = spec
        self._store = store
        self._read = read
        self._change = change
        self._saved: dict[str, Any] = {}
        """Tune's pointer to what each trial saved at its last comparison in this run, or a future of it.

        None: nothing was saved there, or the trial went on from a copy.
        """

    @override
    def on_trial_result(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> str:
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
        # The trial's process saves it before it trains on.
        self._saved[name_of(trial)] = tune_controller._schedule_trial_save(trial, result=result)  # noqa: SLF001
        return str(TrialScheduler.PAUSE if gives_way else TrialScheduler.CONTINUE)

    @override
    def choose_trial_to_run(self, tune_controller: TuneController) -> Trial | None:
        waiting = [
            trial
            for trial in tune_controller.get_trials()
            if trial.status == Trial.PAUSED
            or (trial.status == Trial.PENDING and not is_starting(tune_controller, trial))
        ]
        return min(waiting, key=lambda trial: self._population.compared_at(name_of(trial)), default=None)

    def _take_over(self, trial: Trial, decision: CopyFrom, result: dict[str, Any], controller: TuneController) -> None:
        """Let a trial continue from a copy of a better one's checkpoint.

        Raises:
            CheckpointError: The better one has no checkpoint, or a damaged one.
        """
        pointer = self._pointer(decision.trial_id)
        # The record is that of the previous report, because Tune asks its scheduler first.
        reached = {
            "num_iterations": result["progress"].report.num_iterations,
            "num_env_steps": result["num_env_steps"],
        }
        record = self._read(name_of(trial)).model_copy(update=reached)
        take_over(self._spec, self._store, record, decision, self._change)
        # Its own checkpoints are those of before the copy.
        self._saved.setdefault(name_of(trial), None)
        controller.pause_trial(trial, should_checkpoint=False)
        trial.run_metadata.checkpoint_manager._latest_checkpoint_result = pointer  # noqa: SLF001

    def _pointer(self, trial_id: str) -> Any:
        """Return Tune's pointer to what a trial saved at its last comparison.

        Of one that was compared last before the sweep was resumed, that is its latest checkpoint on disk.

        Raises:
            CheckpointError: There is none.
        """
        if trial_id not in self._saved:
            trial = self._store.trial(trial_id)
            if not latest_iteration(trial):
                raise CheckpointError(f"Trial {trial_id} has no checkpoint yet.")
            return result_of(pointer_to(self._store.place, trial))
        saved = self._saved[trial_id]
        if hasattr(saved, "resolve"):
            saved = self._saved[trial_id] = saved.resolve()
        if saved is None or saved.checkpoint is None:
            raise CheckpointError(f"Trial {trial_id} saved no checkpoint when it was compared last.")
        return copy.copy(saved)
