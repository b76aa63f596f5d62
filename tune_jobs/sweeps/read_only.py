"""The policy of a sweep that this user may perhaps read and not write: then it is chosen, and kept nowhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from policies.acting.load import load_policy, policy_from_portable
from policies.acting.policy import Policy
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.candidates import read_trials
from tune_jobs.store.contract import Sweep
from tune_jobs.store.writable import may_write_best
from tune_jobs.sweeps.current_best import has_current_best
from tune_jobs.sweeps.drive import cpus_for_episodes
from tune_jobs.sweeps.policy_choice import choose_policy


class Choose(Protocol):
    """Chooses the policy to deploy, and writes it; `conclude.choose_best` does."""

    def __call__(self, store: Sweep, *, say: Callable[[str], None]) -> object:
        """Do it; `say` is told how far it is."""
        ...


def policy_to_deploy(store: Sweep, choose: Choose, say: Callable[[str], None]) -> Policy:
    """Return a sweep's best policy, which is chosen now if it has not been, or was before the sweep was trained on.

    Args:
        store: The sweep; in one that may only be read, what is chosen is neither confirmed nor written.
        choose: Chooses it.
        say: Told how far it is.

    Raises:
        NoUsableTrialError: No trial can win; the message says why.
        CheckpointError: The record of the sweep or of a trial is damaged.
        EnvError: The environment raised an error, hung, or ended its process.
    """
    if not has_current_best(store):
        if not may_write_best(store):
            return _chosen(store, say)
        choose(store, say=say)
    return load_policy(store.best_folder)


def _chosen(store: Sweep, say: Callable[[str], None]) -> Policy:
    with store.reading():
        sweep = store.read_record()
        # Of a sweep with a damaged trial nothing is chosen: the trial may be the one that would win.
        store.read_trials()
        trials = read_trials(store)
    chosen = choose_policy(store, stored_spec(sweep), trials, cpus_for_episodes(sweep.address), say)
    return policy_from_portable(chosen.policy, description=f"{store.name}/{chosen.trial.trial_id}")
