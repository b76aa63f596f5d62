"""Replicate a sweep: train its leading settings again with fresh seeds, until it is clear which is the best."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.racing import Race
from analysis.records import FINISHED, ReplicationRecord, SweepRecord
from policies.errors import NotFoundError, SpecError
from tune_jobs.plan.sweep_plan import MAX_TRIALS
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.confirm import different_points
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.races import NamedRace, last_race, race_named, ranking_of, round_of
from tune_jobs.sweeps.resume import replicate


def run_race(
    store: Sweep,
    address: str | None,
    *,
    top: int,
    seeds: int,
    finish: bool,
    progress: str,
    name: str | None = None,
    wait_for_nodes: float = 0.0,
) -> SweepResult:
    """Run what is missing of a sweep, then a race of its leading settings.

    A race that was interrupted goes on, if it is the sweep's last one and as large as this one is to be.

    Args:
        store: The sweep.
        address: Ray cluster to run on; None: this machine.
        top: How many of the leading settings race.
        seeds: How many more seeds a setting gets at most.
        finish: The same as for `launch`.
        progress: The same as for `launch`.
        name: The race's name: the race of this name goes on, and if it is over, none is begun. None: it has none.
        wait_for_nodes: The same as for `launch`.

    Raises:
        SpecError: The sweep cannot be replicated, or has one setting only.
        NotFoundError: It has no setting that was trained and evaluated.
        CannotRunError: Another process runs the sweep, or it cannot run here.
    """
    known = name
    # Asked before what is missing is run: the missing trials may be those of the race's last round.
    was_cut = _was_cut(store)

    def next_round() -> ReplicationRecord | None:
        nonlocal known
        record = store.read_record()
        race = race_named(record, known) if known is not None else None
        # Only now, as the modules that the sweep's environment may need are allowed by the run.
        ranking = ranking_of(store)
        contenders = different_points(ranking)
        if race is None:
            _check(store, contenders)
            last = last_race(record) if name is None else None
            if last is not None and _is_as_large(last, contenders, top, seeds):
                race = last if was_cut or last.next_points(ranking) else None
        if race is None:
            race = _new(record, contenders, top, seeds, name)
        known = race.name
        return round_of(record, race, race.next_points(ranking))

    return replicate(store, address, next_round, finish=finish, progress=progress, wait_for_nodes=wait_for_nodes)


def _check(store: Sweep, contenders: Sequence[int]) -> None:
    if not contenders:
        raise NotFoundError(
            f"No setting of sweep {store.name} can be replicated: none of its trials was evaluated.",
            f"See why with `tune-jobs trials {name_in_commands(store.place)}`.",
        )
    if len(contenders) == 1:
        raise SpecError(
            f"Sweep {store.name} has one setting that was trained: there is no other to race it with.",
            "Extend the sweep by more samples, or launch it anew with seeds_per_point for more seeds of the one.",
        )


def _was_cut(store: Sweep) -> bool:
    """Whether the last run of a sweep did not get to the end of its trials."""
    record = store.read_record()
    ended = sum(trial.status in FINISHED for trial in store.read_trials())
    return record.state != "completed" or ended < record.num_trials


def _is_as_large(race: NamedRace, contenders: Sequence[int], top: int, seeds: int) -> bool:
    return (len(race.race.contenders), race.race.num_seeds) == (min(top, len(contenders)), seeds)


def _new(record: SweepRecord, contenders: Sequence[int], top: int, seeds: int, name: str | None) -> NamedRace:
    race = Race(tuple(contenders[:top]), seeds)
    if race.max_trainings > MAX_TRIALS:
        raise SpecError(
            f"The race has up to {race.max_trainings:,} trainings (top {top:,}, seeds {seeds:,}); at most "
            f"{MAX_TRIALS:,} can be planned.",
            "Lower seeds or top.",
        )
    # No two races of a sweep begin behind equally many rounds.
    return NamedRace(f"race-{len(record.replications)}" if name is None else name, race)
