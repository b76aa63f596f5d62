"""Whether the policy that was chosen last is still the one to deploy, or the sweep was trained on since."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.best_records import BestRecord
from analysis.records import FINISHED, CheckpointRecord, SweepRecord, TrialRecord
from analysis.selection import is_current, policy_candidates
from policies.errors import NotFoundError
from tune_jobs.store.candidates import read_trials, readable_trials
from tune_jobs.store.contract import Sweep


def has_current_best(store: Sweep, trials: Sequence[TrialRecord] | None = None) -> bool:
    """Whether a policy has been chosen that is still the one to take; if not, one has to be chosen anew.

    Args:
        store: The sweep.
        trials: What `readable_trials` gives, if they have been read.

    Raises:
        CheckpointError: The record of the sweep is damaged, or its trials cannot be listed.
    """
    if not store.has_best():
        return False
    # While trials are trained on, others lead from minute to minute: the one that was chosen last stays until the end.
    if store.is_driven():
        return True
    try:
        best = store.read_best()
    except NotFoundError:
        # It is damaged, which whoever reads it is told.
        return True
    return not is_outdated(store, best, readable_trials(store) if trials is None else trials)


def has_best_to_show(store: Sweep, record: SweepRecord, trials: Sequence[TrialRecord]) -> bool:
    """Whether there is a policy to show as a sweep's best; one that is to go on has that of before, told as such.

    Args:
        store: The sweep.
        record: Its record.
        trials: What `readable_trials` gives.

    Raises:
        CheckpointError: The record of the sweep is damaged, or its trials cannot be listed.
    """
    return store.has_best() if record.state != "completed" else has_current_best(store, trials)


def is_outdated(store: Sweep, best: BestRecord, trials: Sequence[TrialRecord]) -> bool:
    """Whether a policy would be chosen among other checkpoints now, as the sweep was extended or trained on since.

    Args:
        store: The sweep.
        best: What was chosen.
        trials: What `readable_trials` gives.

    Raises:
        CheckpointError: The record of the sweep is damaged, or its trials cannot be listed.
    """
    if is_current(best, trials):
        return False
    if len(trials) < len(store.trial_stamps()):
        # A damaged trial may be one of those it was chosen among, and nothing is chosen anew then.
        return False
    # Checkpoints that were damaged before it was chosen are in the records, and were not chosen among.
    found = read_trials(store)
    return bool(policy_candidates(found)) and not is_current(best, found)


def winner_in_best_alone(store: Sweep) -> CheckpointRecord | None:
    """Return the checkpoint that was chosen last if somebody deleted it since: of its policy best/ has the one copy.

    Its trial's record has it still then. One that the trial deleted, as it trained on and kept others, it has not.
    """
    if not store.has_best():
        return None
    try:
        best = store.read_best().checkpoint
        trial = store.trial(best.trial_id)
        if best.iteration in trial.checkpoint_iterations():
            return None
        record = trial.read_record()
    except NotFoundError:  # a record is damaged or missing
        return None
    return best if record.status in FINISHED and best in record.checkpoints else None
