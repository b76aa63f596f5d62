"""Resume, extend or replicate a sweep, or inject a point: take it over, add what is left to run, and run it."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ParamSpec

from analysis.records import FINISHED, FORMAT_VERSION, ReplicationRecord, SweepRecord
from policies.envs.modules import allow_modules
from policies.guard.guard import guarding
from tune_jobs.plan.machine import Machine
from tune_jobs.process.ran_with import versions
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.rules import check_extendable, check_replicable
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.adding import add_what_is_missing, with_chosen_point
from tune_jobs.sweeps.changed_code import notes_on_commit
from tune_jobs.sweeps.drive import connected, forks_begun_ahead, machine_here, settled
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.own_job import note_own_job
from tune_jobs.sweeps.repeating import check_takes_more, plan_of_repetition
from tune_jobs.sweeps.stages import RACE, MoreSeeds, run_sweep
from tune_jobs.sweeps.waiting import WaitEndedError, check_wait, machine_that_fits, note_wait

_Arguments = ParamSpec("_Arguments")


def _ending_a_wait_in_order(call: Callable[_Arguments, SweepResult]) -> Callable[_Arguments, SweepResult]:
    """Decorate a function whose first argument is a sweep: an end before there were nodes is an interruption."""

    @functools.wraps(call)
    def run(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> SweepResult:
        try:
            return call(*args, **kwargs)
        except WaitEndedError:
            store: Any = args[0]
            return SweepResult(store.place, store.read_record(), store.read_trials(), interrupted=True)

    return run


@_ending_a_wait_in_order
@guarding()
def go_on(
    store: Sweep,
    address: str | None,
    *,
    num_samples: int = 0,
    point: Mapping[str, Any] | None = None,
    finish: bool,
    progress: str,
    retry_failed: bool = False,
    wait_for_nodes: float = 0.0,
) -> SweepResult:
    """Run what is missing of a sweep, `num_samples` more samples of its space, and a point that somebody chose.

    Raises:
        SpecError: The space has nothing to draw more samples from, the point is wrong or known, or the sweep repeats a
            trial of another one.
        CannotRunError: Another process runs the sweep, or it cannot run here.
    """
    more = bool(num_samples) or point is not None or retry_failed
    with _taken_over(store, address, wait_for_nodes, progress, more=more) as (machine, where, notes):
        record = store.read_record()
        spec = stored_spec(record)
        if record.repeats is not None:
            (trial,) = store.read_trials()
            plan = plan_of_repetition(spec, trial, record, where).with_notes(notes)
            if trial.status not in FINISHED:
                # As where trials are added: who goes on with it knows where it runs.
                store.write_record(record.model_copy(update={"address": address, "state": "running"}))
            return run_sweep(store, plan, address=address, machine=machine, finish=finish, progress=progress)
        if num_samples:
            check_extendable(spec, num_samples)
        spec = spec.model_copy(update={"num_samples": spec.num_samples + num_samples})
        if point is not None:
            record = with_chosen_point(record, spec, store.read_trials(), point, name_in_commands(store.place))
        plan = add_what_is_missing(store, record, spec, where, address, retry_failed=retry_failed).with_notes(notes)
        return run_sweep(store, plan, address=address, machine=machine, finish=finish, progress=progress)


@_ending_a_wait_in_order
@guarding()
def replicate(
    store: Sweep,
    address: str | None,
    next_round: Callable[[], ReplicationRecord | None],
    *,
    finish: bool,
    progress: str,
    wait_for_nodes: float = 0.0,
) -> SweepResult:
    """Run what is missing of a sweep, then train some of its points with more seeds, stage by stage.

    Args:
        store: The sweep.
        address: Ray cluster to run on; None: this machine.
        next_round: Says before each stage which points get one more seed each; None: that was all.
        finish: The same as for `launch`.
        progress: The same as for `launch`.
        wait_for_nodes: The same as for `launch`.

    Raises:
        SpecError: The sweep cannot be replicated.
        CannotRunError: Another process runs the sweep, or it cannot run here.
    """
    with _taken_over(store, address, wait_for_nodes, progress, more=True) as (machine, where, notes):
        record = store.read_record()
        spec = stored_spec(record)
        check_replicable(spec)
        plan = add_what_is_missing(store, record, spec, where, address).with_notes(notes)
        more = MoreSeeds(next_round, RACE)
        return run_sweep(store, plan, address=address, machine=machine, finish=finish, progress=progress, more=more)


@contextlib.contextmanager
def _taken_over(
    store: Sweep, address: str | None, wait_for_nodes: float, progress: str, *, more: bool
) -> Iterator[tuple[Machine | None, Machine, tuple[str, ...]]]:
    """Hold the sweep's lock for the block; `more` trials than those that are not finished may come to the sweep in it.

    It gives the machine to start Ray on, if any, what the sweep runs on, and notes on its nodes and on the versions
    of a user's own code and of this one.
    """
    check_wait(address, wait_for_nodes)
    with contextlib.ExitStack() as stack:
        stack.enter_context(store.lock())
        # Before anything is written: what this version does not accept is another's, which goes on with it.
        stored_spec(store.read_record())
        # The request was for a process that was killed.
        store.clear_stop_request()
        stack.enter_context(settled(store))
        note_own_job(store)
        if more:
            check_takes_more(store.read_record())
        allow_modules(store.read_record().allowed_modules)
        machine = machine_here() if address is None else None
        if machine is not None:
            note_wait(store, None)
            if more or any(trial.status not in FINISHED for trial in store.read_trials()):
                stack.enter_context(forks_begun_ahead(stored_spec(store.read_record()), machine))
            yield machine, machine, _notes_on_versions(store.read_record())
            return
        connection = stack.enter_context(connected(address, None))
        from tune_jobs.ray_tune.node_checks import check_nodes

        found = machine_that_fits(store, connection, wait_for_nodes, progress=progress)
        record = store.read_record()
        num_gpus = stored_spec(record).resources.num_gpus
        notes = check_nodes(store.place, record.allowed_modules, num_gpus=num_gpus)
        yield None, found, (*notes, *_notes_on_versions(record))


def _notes_on_versions(record: SweepRecord) -> tuple[str, ...]:
    """Return notes on a sweep that was begun with other code than there is here."""
    return (*_notes_on_version(record), *notes_on_commit(record))


def _notes_on_version(record: SweepRecord) -> tuple[str, ...]:
    """Return the note on a sweep that another version of tune-jobs began; empty if it was this one, or is not known."""
    began, here = (found.get("tune-jobs") for found in (record.versions, versions()))
    # What is got from a repository may have the number of the last release.
    is_earlier = record.format_version < FORMAT_VERSION
    if not is_earlier and (None in (began, here) or began == here):
        return ()
    begun_with = f"an earlier tune-jobs ({began or 'no number'})" if is_earlier else f"tune-jobs {began}"
    note = (
        f"The sweep was begun with {begun_with}, and what is left of it trains as tune-jobs {here} does: with "
        'other numbers than trials that ended before, where the changelog says so under "Changes results".'
    )
    return (note,)
