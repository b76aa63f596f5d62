"""Write the winner of a sweep that may have gone on, ended or been removed since its trials were read.

Policies play for minutes, and no lock is held then: the process that runs the sweep may choose its winner meanwhile.
"""

from __future__ import annotations

from analysis.best_records import BestRecord
from analysis.records import SweepRecord
from policies.errors import NotFoundError
from policies.portable.file import PortablePolicy
from tune_jobs.store.candidates import readable_trials
from tune_jobs.store.contract import Sweep
from tune_jobs.store.removal import removed_meanwhile
from tune_jobs.sweeps.current_best import is_outdated


def write_unless_outdated(store: Sweep, sweep: SweepRecord, best: BestRecord, policy: PortablePolicy) -> BestRecord:
    """Write the winner, unless another process has chosen one since that is current while this one is not any more.

    Args:
        store: The sweep.
        sweep: Its record, as it was before the winner was chosen.
        best: The winner.
        policy: Its policy.

    Returns:
        The winner that is in the store now.

    Raises:
        NotFoundError: The sweep was removed since; there may be another one of its name.
        CannotRunError: It cannot be written.
    """
    check_same(store, sweep)
    if (newer := _newer(store, best)) is not None:
        return newer
    store.write_best(best, policy)
    return best


def check_same(store: Sweep, sweep: SweepRecord) -> None:
    """Check that a sweep is the one whose record was read before.

    Raises:
        NotFoundError: It was removed since; there may be another one of its name.
        CheckpointError: Its record is damaged.
    """
    if store.read_record().created_at != sweep.created_at:
        raise removed_meanwhile(store.name)


def _newer(store: Sweep, best: BestRecord) -> BestRecord | None:
    """Return what another process has chosen, if it is current and `best` is not."""
    try:
        stored = store.read_best()
    except NotFoundError:
        # A damaged one is replaced, too.
        return None
    trials = readable_trials(store)
    return stored if is_outdated(store, best, trials) and not is_outdated(store, stored, trials) else None
