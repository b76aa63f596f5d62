"""Compare sweeps, or settings of sweeps."""

from __future__ import annotations

import itertools
import json
import string
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

from analysis.comparison.compare import MAX_ENTRIES, Comparison, common_objective
from analysis.comparison.compare import compare as compare_all
from analysis.comparison.entries import Wanted, judged_alike, why_no_scores
from analysis.exports.frames import ranked_settings
from analysis.records import Objective
from analysis.wording import counted
from policies.arguments import PositiveInt, checked
from policies.errors import NotFoundError, SpecError
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import is_same_place
from tune_jobs.sweeps.exports import sweep_data
from tune_jobs.sweeps.sources import find_source, find_trial
from tune_jobs.sweeps.storage import local_path


@checked
def compare(
    sources: str | Path | Sequence[str | Path],
    *,
    objective: Literal["final", "area", "best", "steps_to_threshold"] | None = None,
    top: PositiveInt = 3,
    html: str | Path | None = None,
    storage: str | Path | None = None,
) -> Comparison:
    """Compare sweeps by their leading settings, or settings with each other, over training seeds.

    Args:
        sources: Each a sweep, by name or folder, or a setting, by one of its trials: `SWEEP/t0003` or the trial's
            folder. Of one sweep alone the leading settings are compared.
        objective: What all are judged by; None: what their sweep files say, or `final` where these differ.
        top: How many settings are compared of a sweep that is named alone.
        html: A file for a page with figures; None: none is written.
        storage: Folder for sweeps.

    Returns:
        Scores, intervals, costs; for each pair how probably a training of one scores more than one of the other, and
        the difference of their means. Of different environments it says why they are not comparable.

    Raises:
        NotFoundError: There is no such sweep or trial.
        SpecError: Fewer than two different things, or too many, are to be compared, or the page is a URL.
        CannotRunError: The page cannot be written.
    """
    named = [sources] if isinstance(sources, str | Path) else list(sources)
    found, wanted = compared([find_source(each, storage) for each in named], objective, top)
    if html is not None:
        from analysis.comparison.page import write_page

        write_page(local_path(html), found, wanted)
    return found


def compared(
    sources: Sequence[tuple[Sweep, str | None]], objective: Objective | None, top: int
) -> tuple[Comparison, dict[str, Wanted]]:
    """Compare what was found already; see `compare`.

    Args:
        sources: Each a sweep, and the id of one of its trials or None, as of `find_source`.
        objective: See `compare`.
        top: See `compare`.

    Returns:
        The comparison, and what it was made of, by letter.
    """
    if not sources:
        raise SpecError("Nothing was given to be compared.", f"Give from 2 to {MAX_ENTRIES} sweeps or trials.")
    wanted = _settings_of(*sources[0], objective, top) if len(sources) == 1 else [_wanted(*each) for each in sources]
    places = [sources[0][0].place] * len(wanted) if len(sources) == 1 else [store.place for store, _ in sources]
    _refuse_twice(wanted, places)
    if not 2 <= len(wanted) <= MAX_ENTRIES:
        raise SpecError(
            f"{len(wanted)} things were given to be compared.", f"Give from 2 to {MAX_ENTRIES} sweeps or trials."
        )
    named = dict(zip(string.ascii_uppercase, wanted, strict=False))
    found = compare_all(wanted, objective)
    return replace(found, notes=(*found.notes, *_told_of_copies(named, places))), named


def _wanted(store: Sweep, trial_id: str | None) -> Wanted:
    if trial_id is None:
        return wanted_sweep(store)
    trial = find_trial(store, trial_id)
    return _of(store, f"{store.name}/{trial.trial_id}", trial.point_index)


def wanted_sweep(store: Sweep) -> Wanted:
    """Return a whole sweep as one that is to be compared.

    Raises:
        NotFoundError: There is no such sweep.
        CheckpointError: The record of the sweep or of a trial is damaged.
    """
    return _of(store, store.name, None)


def _of(store: Sweep, name: str, point_index: int | None) -> Wanted:
    record = store.read_record()
    cores = float(stored_spec(record).cpus_per_trial)
    return Wanted(name, record, sweep_data(store), cores, point_index)


def _settings_of(store: Sweep, trial_id: str | None, objective: Objective | None, top: int) -> list[Wanted]:
    """Return the leading settings of a sweep by what they are compared by, each called after its first trial."""
    if trial_id is not None:
        raise SpecError(
            f"Only {store.name}/{trial_id} was given to be compared.", "Name another trial or sweep to compare it with."
        )
    if top < 2:
        raise SpecError(
            f"Of sweep {store.name} alone {top} leading setting was to be compared.", "Let `top` be 2 or more."
        )
    whole = wanted_sweep(store)
    judged = judged_alike(whole, objective or common_objective([whole])[0], whole.data.threshold)
    ranking = ranked_settings(judged.data)
    if len(ranking) < 2:
        why = "one of its settings alone has been trained and judged" if ranking else why_no_scores(judged)
        raise NotFoundError(
            f"Sweep {store.name} has no two settings that could be compared: {why}.",
            "Ask for another objective."
            if judged.data.objective == "steps_to_threshold" and judged.data.threshold is None
            else "Name another sweep to compare it with.",
        )
    return [_of(store, f"{store.name}/{item.trial_ids[0]}", item.point_index) for item in ranking[:top]]


def _refuse_twice(wanted: Sequence[Wanted], places: Sequence[str]) -> None:
    """Refuse the same sweep or setting twice; a sweep with one of its own settings may be wanted.

    A copy in another folder is the same sweep until one of both goes on.
    """
    for (one, at), (other, other_at) in itertools.combinations(zip(wanted, places, strict=True), 2):
        if one.origin != other.origin or one.point_index != other.point_index:
            continue
        # One that runs has gone on between two looks at it.
        if _trainings(one) == _trainings(other) or is_same_place(at, other_at):
            what = "the same sweep" if one.point_index is None else "seeds of the same setting, or the same trial"
            raise SpecError(
                f"{one.name} and {other.name} are {what}: there is nothing to compare.",
                "Name two different ones; `tune-jobs compare SWEEP` compares the settings of one sweep.",
            )


def _told_of_copies(wanted: Mapping[str, Wanted], places: Sequence[str]) -> list[str]:
    """Say where a sweep and a copy of it, one of which has gone on, have trainings in common."""
    notes = []
    for (one, at), (other, other_at) in itertools.combinations(zip(wanted, places, strict=True), 2):
        if wanted[one].origin != wanted[other].origin or is_same_place(at, other_at):
            continue
        if same := [each for each in _trainings(wanted[one]) & _trainings(wanted[other]) if each.num_env_steps]:
            notes.append(
                f"{one} and {other} have {counted(len(same), 'training')} in common, as one is of a copy of the "
                "other's sweep: these are the same numbers twice, and the intervals take them for independent ones."
            )
    return notes


class _Training(NamedTuple):
    """What was trained, and what of that changes when its sweep goes on."""

    trial_id: str
    status: str
    num_env_steps: int
    setting: str
    returns: tuple[float | None, ...]


def _trainings(item: Wanted) -> set[_Training]:
    return {
        _Training(
            trial.trial_id,
            trial.status,
            trial.num_env_steps,
            # Two copies may each go on with a trial of the same id.
            json.dumps([trial.engine, trial.seed, trial.hyperparams], sort_keys=True, default=str),
            (trial.evaluation_return, trial.best_evaluation_return),
        )
        for trial in item.data.trials
        if item.point_index in (None, trial.point_index)
    }
