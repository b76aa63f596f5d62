"""Read the earlier sweeps that the search of a new one begins with."""

from __future__ import annotations

import re
from pathlib import Path

from analysis.objectives import score_of
from analysis.records import PriorRecord, TrialRecord, longest_length
from policies.errors import CheckpointError, NotFoundError, SpecError, shortened
from tune_jobs.search.history import TOLD
from tune_jobs.search.prior import prior_record
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.sections import NAME_PATTERN
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.candidates import leave_out
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import is_same_place
from tune_jobs.sweeps.sources import find_sweep


def read_priors(spec: SweepSpec, storage: str | Path | None, *, by_name: bool = False) -> tuple[PriorRecord, ...]:
    """Return what the model of a new sweep begins with.

    Args:
        spec: The new sweep.
        storage: The storage in which names are looked up.
        by_name: Whether only names are allowed, and no places.

    Raises:
        NotFoundError: There is no such sweep.
        SpecError: One is of another algorithm or space, or tells nothing, or is named twice, or is named by its place
            where that is not allowed.
    """
    found = []
    places: dict[str, str] = {}
    for sweep in spec.prior:
        if by_name and re.fullmatch(NAME_PATTERN, sweep) is None:
            raise SpecError(
                f"prior: {shortened(sweep)} is no name of a sweep, and places are not read here.",
                "Name a sweep of this service.",
            )
        try:
            store = find_sweep(sweep, storage)
        except NotFoundError as error:
            raise NotFoundError(f"prior: {error.message}", error.hint) from error
        if same := [other for other, place in places.items() if is_same_place(place, store.place)]:
            raise SpecError(f"prior: {shortened(same[0])} and {shortened(sweep)} are the same sweep.", "Name it once.")
        places[sweep] = store.place
        record = store.read_record()
        earlier = stored_spec(record)
        found.append(prior_record(spec, store.name, earlier, _judged(store, earlier, record.env_threshold)))
    return tuple(found)


def _judged(store: Sweep, earlier: SweepSpec, env_threshold: float | None) -> list[TrialRecord]:
    """Return the trials of an earlier sweep, with their scores by its objective where a search learns of these.

    Trials that no model learned from tell none, so that these are made of their results.

    Args:
        store: The earlier sweep.
        earlier: Its spec.
        env_threshold: Its env's own threshold.
    """
    trials = store.read_trials()
    objective = earlier.objective.type
    threshold = env_threshold if earlier.objective.threshold is None else earlier.objective.threshold
    can_be_judged = objective in TOLD and (objective == "area" or threshold is not None)
    if not can_be_judged or not any(map(_lacks_score, trials)):
        return trials
    num_env_steps, num_iterations = earlier.stop.num_env_steps, earlier.stop.num_iterations
    longest = longest_length(trials, num_env_steps=num_env_steps, num_iterations=num_iterations)
    judged = []
    with store.reading():
        for trial in trials:
            score = trial.objective_score
            if _lacks_score(trial):
                try:
                    results = store.trial(trial.trial_id).read_iterations()
                except CheckpointError as error:
                    leave_out(error)
                    results = []
                score = score_of(
                    trial, results, objective, num_env_steps=num_env_steps, num_iterations=num_iterations,
                    threshold=threshold, longest=longest,
                )  # fmt: skip
            judged.append(trial.model_copy(update={"objective_score": score}))
    return judged


def _lacks_score(trial: TrialRecord) -> bool:
    return trial.status in ("completed", "stopped") and trial.has_point and trial.objective_score is None
