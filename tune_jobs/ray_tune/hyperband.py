"""HyperBand (Li et al. 2018): trials wait for each other at milestones, and the better ones of a bracket continue.

A *bracket* has a number of places, a first milestone and a number of halvings. At each halving, one in
`reduction_factor` of its trials continues, to a milestone that many times as far; after the last halving they continue
to their end. A *band* has one bracket of each number of halvings. Trials fill one bracket after another, and the first
is the one that ends the most trials. Milestones are counted in grace periods: counted in env steps, brackets would need
50,000 trials for 50,000 steps.

The rule is Ray Tune's, except that no trial waits forever. With Ray's, all trials of a bracket wait forever if
evaluations are further apart than milestones, because those that are to continue have passed the next milestone
already; and, after the first halving, if the last trial that others wait for fails or reaches a stop rule.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from ray.tune.experiment import Trial
from typing_extensions import override

from analysis.records import TrialRecord
from tune_jobs.ray_tune.scheduling import Decision, Others, Standing, is_unscored
from tune_jobs.ray_tune.tune_scheduler import TuneScheduler, is_starting, name_of

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController


@dataclass
class _Bracket:
    num_places: int
    milestone: int
    """The next milestone, at which its trials are compared, in grace periods."""
    num_halvings: int
    """The halvings still to come."""
    total_work: int
    """Grace periods of all its trials together, if all places are taken."""
    work: float = 0.0
    """Grace periods trained so far."""
    live: dict[str, Standing | None] = field(default_factory=dict)
    """The trials that have not ended, in the order in which they came; None: the trial has not been compared yet."""
    waiting: set[str] = field(default_factory=set)
    """The trials that wait for the others."""
    was_halved: bool = False

    @property
    def is_full(self) -> bool:
        return len(self.live) == self.num_places

    @property
    def share_done(self) -> float:
        return min(self.work / self.total_work, 1.0)


class HyperBand:
    """A `Scheduler` that also decides about the trials that wait.

    Args:
        grace_env_steps: The grace period: env steps before which no trial is ended.
        max_env_steps: The cap of a trial, `stop.num_env_steps`.
        reduction_factor: One trial in this many continues at each milestone.
    """

    def __init__(self, grace_env_steps: int, max_env_steps: int, reduction_factor: float) -> None:
        self._grace_env_steps = grace_env_steps
        self._factor = reduction_factor
        self._max_periods = max(1, math.ceil(max_env_steps / grace_env_steps))
        self._num_kinds = int(np.round(np.log(self._max_periods) / np.log(reduction_factor))) + 1
        self._bands: list[list[_Bracket]] = [[]]
        self._bracket_of: dict[str, _Bracket] = {}
        self._to_end: list[str] = []

    def begin(self, records: Sequence[TrialRecord], todo: Collection[str]) -> None:
        """Add the trials of a run, in the order of the records, which have those that ended before it, too.

        Nobody waits for these, but they had places: without them, the others of a sweep that is resumed would be in
        other brackets than they began in, and the best of a bracket compared with each other as if none had ended.
        """
        for record in records:
            self.begins(record.trial_id)
        for record in records:
            if record.trial_id not in todo:
                self.gone(record.trial_id)

    def begins(self, trial_id: str) -> None:
        """Add a trial to the newest bracket, or to a new one if that is full; one that was added has its place."""
        if trial_id in self._bracket_of:
            return
        band = self._bands[-1]
        if not band or band[-1].is_full:
            if len(band) == self._num_kinds:
                band = []
                self._bands.append(band)
            # The one with the most halvings comes first, since small sweeps would never reach it otherwise.
            band.append(self._bracket(self._num_kinds - 1 - len(band)))
        band[-1].live[trial_id] = None
        self._bracket_of[trial_id] = band[-1]

    def _bracket(self, num_halvings: int) -> _Bracket:
        num_places = math.ceil(self._num_kinds / (num_halvings + 1) * self._factor**num_halvings)
        # Rounded down, it may be 0, which is before a trial's first evaluation.
        first = max(1, int(self._max_periods * self._factor**-num_halvings))
        total, places, periods = 0, num_places, first
        for _ in range(num_halvings + 1):
            total += places * periods
            places = math.ceil(places / self._factor)
            periods = int(min(periods * self._factor, self._max_periods - first))
        return _Bracket(num_places, first, num_halvings, total)

    def reached(self, standing: Standing, others: Others) -> Decision:  # noqa: ARG002 (it knows the others itself)
        """Decide what the trial does next; other trials that are to end now are given by `take_ended`."""
        if not standing.evaluated:
            return Decision.GO_ON
        if is_unscored(standing.score) and standing.num_env_steps >= self._grace_env_steps:
            return Decision.STOP
        name, bracket = standing.trial_id, self._bracket_of[standing.trial_id]
        bracket.work += self._periods(standing) - self._periods(bracket.live[name])
        bracket.live[name] = standing
        if self._goes_on(bracket, name):
            return Decision.GO_ON
        bracket.waiting.add(name)
        self._halve_if_due(bracket)
        if name in self._to_end:
            self._to_end.remove(name)
            return Decision.STOP
        return Decision.WAIT if name in bracket.waiting else Decision.GO_ON

    def ended(self, standing: Standing) -> None:
        """Take a trial out that ended by itself or was stopped."""
        self.gone(standing.trial_id)

    def gone(self, trial_id: str) -> None:
        """Take a trial out, however it ended: the others wait for it no longer, and some may end; see `take_ended`."""
        bracket = self._bracket_of[trial_id]
        if trial_id in bracket.live:
            self._remove(bracket, trial_id)
            if bracket.live or not bracket.was_halved:
                self._halve_if_due(bracket)

    def take_ended(self) -> list[str]:
        """Return the waiting trials that are to end, the worst first; each is returned once."""
        ended, self._to_end = self._to_end, []
        return ended

    def waits(self, trial_id: str) -> bool:
        """Whether a trial waits for other trials."""
        return trial_id in self._bracket_of[trial_id].waiting

    def next_milestone(self, trial_id: str) -> int | None:
        """Return the env steps at which a trial is compared next; None: it goes on to its end."""
        bracket = self._bracket_of[trial_id]
        return bracket.milestone * self._grace_env_steps if bracket.num_halvings else None

    def in_turn(self) -> Iterator[str]:
        """Yield the trials that have not ended, in the order in which they get a place."""
        for band in self._bands:
            for bracket in sorted(band, key=lambda bracket: bracket.share_done):
                yield from bracket.live

    def _periods(self, standing: Standing | None) -> float:
        return 0.0 if standing is None else standing.num_env_steps / self._grace_env_steps

    def _goes_on(self, bracket: _Bracket, name: str) -> bool:
        return not bracket.num_halvings or self._periods(bracket.live[name]) < bracket.milestone

    def _remove(self, bracket: _Bracket, name: str) -> None:
        del bracket.live[name]
        bracket.waiting.discard(name)

    def _halve_if_due(self, bracket: _Bracket) -> None:
        """If all trials of a bracket have reached its milestone, end the worse ones and let the others continue."""
        while all(self._periods(standing) >= bracket.milestone for standing in bracket.live.values()):
            bracket.was_halved = True
            if bracket.num_halvings:
                bracket.num_halvings -= 1
                bracket.num_places = math.ceil(bracket.num_places / self._factor)
                # Rounded down, 1.5 grace periods would be 1 again, at which all halvings would be made at once.
                later = max(int(bracket.milestone * self._factor), bracket.milestone + 1)
                bracket.milestone = min(later, self._max_periods)
                ranked = sorted(bracket.live, key=lambda name: _score(bracket.live[name]))
                for name in ranked[: -bracket.num_places]:
                    self._remove(bracket, name)
                    self._to_end.append(name)
            bracket.waiting -= {name for name in bracket.waiting if self._goes_on(bracket, name)}
            if not bracket.waiting or len(bracket.waiting) < len(bracket.live):
                return


def _score(standing: Standing | None) -> float:
    assert standing is not None
    return standing.score


class HyperBandScheduler(TuneScheduler):
    """Connects `HyperBand` to Ray Tune; but for `is_starting`, only public methods of Tune's controller are used."""

    def __init__(self, scheduler: HyperBand) -> None:
        super().__init__(scheduler)
        self._band = scheduler

    def begin(self, records: Sequence[TrialRecord], todo: Collection[str]) -> None:
        """Add the trials of a run before Tune does; see `HyperBand.begin`."""
        self._band.begin(records, todo)

    @override
    def on_trial_result(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> str:
        decision = super().on_trial_result(tune_controller, trial, result)
        self._end_others(tune_controller)
        return decision

    @override
    def on_trial_complete(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> None:
        self.on_trial_remove(tune_controller, trial)

    @override
    def on_trial_error(self, tune_controller: TuneController, trial: Trial) -> None:
        # One with this status goes on: Tune (2.60) calls this for each retry, too. It stays in its bracket, whose other
        # trials wait for it. That of one that has failed for good follows later.
        if trial.status != Trial.ERROR:
            self.on_trial_remove(tune_controller, trial)

    @override
    def on_trial_remove(self, tune_controller: TuneController, trial: Trial) -> None:
        self._band.gone(name_of(trial))
        self._end_others(tune_controller)

    @override
    def choose_trial_to_run(self, tune_controller: TuneController) -> Trial | None:
        idle = {
            name_of(trial): trial
            for trial in tune_controller.get_trials()
            # A trial whose process died while it saved is pending, although it waits.
            if (trial.status == Trial.PENDING and not is_starting(tune_controller, trial))
            or (trial.status == Trial.PAUSED and not self._band.waits(name_of(trial)))
        }
        return next((idle[name] for name in self._band.in_turn() if name in idle), None)

    def _end_others(self, controller: TuneController) -> None:
        names = self._band.take_ended()
        if names:
            known = {name_of(trial): trial for trial in controller.get_trials()}
            for name in names:
                controller.stop_trial(known[name])
