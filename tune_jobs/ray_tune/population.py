"""Population based training as a Ray Tune scheduler (Jaderberg et al. 2017).

Every so many env steps a trial is compared with the others. One of the worst goes on from a copy of the latest
checkpoint of one of the best, with the better one's searched values mutated. What changed is written into the trial's
record before anything acts on it, so a sweep that is killed goes on with it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ray.tune.schedulers import PopulationBasedTraining

from analysis.records import ChangeRecord, TrialRecord
from policies import random_streams
from policies.errors import CheckpointError, SpecError
from tune_jobs.plan.sweep_plan import point_hyperparams
from tune_jobs.ray_tune.early_stopping import METRIC, OnEvaluations
from tune_jobs.ray_tune.scheduling import WORST_SCORE
from tune_jobs.search.mutation import mutate
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.copies import copy_latest_checkpoint

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController
    from ray.tune.experiment import Trial

_LOG = logging.getLogger(__name__)
_ATTEMPTS = 20

ReadRecord = Callable[[str], TrialRecord]
Change = Callable[..., None]


class PopulationScheduler(OnEvaluations, PopulationBasedTraining):  # type: ignore[misc]
    """Ray Tune's population based training, on evaluation returns and on the records of the sweep folder.

    Args:
        spec: The sweep.
        store: Its folder.
        read: The newest record of a trial.
        change: Changes fields of a trial's record, on disk too.
    """

    def __init__(self, spec: SweepSpec, store: Sweep, read: ReadRecord, change: Change) -> None:
        super().__init__(
            time_attr="num_env_steps",
            metric=METRIC,
            mode="max",
            perturbation_interval=spec.perturb_every_env_steps,
            quantile_fraction=spec.scheduler.quantile_fraction,
            # Tune's config of a trial holds its name alone and never changes.
            custom_explore_fn=lambda config: config,
            log_config=False,
        )
        self._spec = spec
        self._store = store
        self._read = read
        self._change = change

    def on_trial_add(self, tune_controller: TuneController, trial: Trial) -> None:
        """Take a trial into the population, at the place it has by its record: a resumed one is half-way."""
        super().on_trial_add(tune_controller, trial)
        record, state = self._read(_name(trial)), self._trial_state[trial]
        interval = self._spec.perturb_every_env_steps
        state.last_perturbation_time = record.num_env_steps // interval * interval
        state.last_train_time = record.num_env_steps
        if record.num_env_steps:
            state.last_score = WORST_SCORE if record.evaluation_return is None else record.evaluation_return

    def _checkpoint_or_exploit(
        self, trial: Trial, tune_controller: TuneController, upper_quantile: list[Trial], lower_quantile: list[Trial]
    ) -> None:
        # In Ray's own way a trial can be copied only after it was compared a second time, as one of the best.
        scores = {other: self._trial_state[other].last_score for other in upper_quantile}
        better = [other for other, score in scores.items() if score > self._trial_state[trial].last_score]
        if trial in lower_quantile and better:
            record = self._read(_name(trial))
            rng = random_streams.mutation(self._spec.seed, record.index, len(record.changes))
            chosen = better[int(rng.integers(len(better)))]
            try:
                point = self._mutated(self._read(_name(chosen)).point, rng)
                self._take_over(trial, chosen, point, tune_controller)
            except CheckpointError as error:
                _LOG.warning("%s goes on as it is: %s", _name(trial), error)
            else:
                return
        state = self._trial_state[trial]
        # Saved by the trial's process before it trains on; Tune keeps a pointer.
        state.last_checkpoint = tune_controller._schedule_trial_save(trial, result=state.last_result)  # noqa: SLF001

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

    def _take_over(self, trial: Trial, better: Trial, point: dict[str, Any], controller: TuneController) -> None:
        """Let a trial go on from a copy of a better one's checkpoint.

        Raises:
            CheckpointError: The better one has none, or it is damaged.
        """
        source, state = self._trial_state[better], self._trial_state[trial]
        # Tune's pointer to it, which the trial's next start is given; its absence would mean a start from nothing.
        pointer = source.last_checkpoint
        if hasattr(pointer, "resolve"):
            saved = pointer.resolve()
            pointer = source.last_checkpoint = None if saved is None else saved.checkpoint
        if pointer is None:
            raise CheckpointError(f"Trial {_name(better)} has not saved a checkpoint yet.")
        record, other = self._read(_name(trial)), self._read(_name(better))
        # The record is of the report before this one: Tune asks its scheduler first.
        iteration, num_env_steps = state.last_result["progress/iteration"], state.last_result["num_env_steps"]
        copied = copy_latest_checkpoint(
            self._store.trial(other.trial_id), self._store.trial(record.trial_id), iteration
        )
        entry = ChangeRecord(
            iteration=iteration,
            num_env_steps=num_env_steps,
            source_trial_id=other.trial_id,
            source_iteration=copied.iteration,
            before=record.point,
            after=point,
            time=time.time(),
        )
        hyperparams = point_hyperparams(self._spec, point, record.point_index).model_dump(mode="json")
        # This makes the copy count; see tune_jobs.store.copies.
        self._change(record.trial_id, point=point, hyperparams=hyperparams, changes=(*record.changes, entry))
        times = state.last_perturbation_time, state.last_train_time
        self._exploit(controller, trial, better)
        # A trial's env steps stay its own; in Ray's way they become those of the copied checkpoint.
        state.last_perturbation_time, state.last_train_time = times

    def _get_new_config(
        self,
        trial: Trial,
        trial_to_clone: Trial,  # noqa: ARG002 - Ray's signature
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        # What changed is in the record; Tune's config says which trial this is.
        return dict(trial.config), {}


def _name(trial: Trial) -> str:
    return str(trial.config["trial_id"])
