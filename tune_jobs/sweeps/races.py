"""Races of settings that somebody asked for: which round of one comes next.

Each round is in the sweep's record, with the race that it belongs to: one that was interrupted goes on where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from analysis.objectives import SettingScores
from analysis.racing import Race
from analysis.records import ReplicationRecord, SweepRecord
from tune_jobs.plan.points import num_points_of
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.candidates import read_results, read_trials
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.confirm import recent_rounds
from tune_jobs.sweeps.settings import ranked, threshold_for


@dataclass(frozen=True)
class NamedRace:
    """A race, and how far it is."""

    name: str
    race: Race
    num_done: int = 0
    """Its rounds so far, the last of which may not be trained yet."""

    def next_points(self, ranking: Sequence[SettingScores]) -> tuple[int, ...]:
        """Return the points that get one more seed each; none: the race is over, or lost one that raced."""
        scores = {item.point_index: item.scores for item in ranking}
        if not scores.keys() >= set(self.race.contenders):
            return ()
        return self.race.next_points(scores, self.num_done)


def race_named(record: SweepRecord, name: str) -> NamedRace | None:
    """Return a race by its name; None: no round of it was begun."""
    rounds = [item for item in record.replications if item.race == name]
    if not rounds:
        return None
    return NamedRace(name, Race(rounds[0].contenders, rounds[0].num_seeds), len(rounds))


def last_race(record: SweepRecord) -> NamedRace | None:
    """Return the race that a sweep had last; None: it had none since the last points came to it."""
    rounds = recent_rounds(record)
    return race_named(record, rounds[-1].race) if rounds and rounds[-1].race else None


def round_of(record: SweepRecord, race: NamedRace, points: tuple[int, ...]) -> ReplicationRecord | None:
    """Return the record of a race's next round; None: no points are in it."""
    if not points:
        return None
    num_points = num_points_of(stored_spec(record), record.chosen_points)
    return ReplicationRecord(
        num_points=num_points, points=points, race=race.name, contenders=race.race.contenders,
        num_seeds=race.race.num_seeds,
    )  # fmt: skip


def next_round(store: Sweep) -> ReplicationRecord | None:
    """Return the next round of a sweep's last race; None: the race is over, or there is none.

    All trials have ended.

    Raises:
        CheckpointError: A record is damaged.
        EnvError: The objective is about the env's threshold, and the env cannot be made.
        EnvFailedError: As for EnvError, and it failed.
    """
    record = store.read_record()
    race = last_race(record)
    return None if race is None else round_of(record, race, race.next_points(ranking_of(store)))


def ranking_of(store: Sweep) -> list[SettingScores]:
    """Return a sweep's settings, best first.

    Raises:
        CheckpointError: As for `next_round`.
        EnvError: As for `next_round`.
        EnvFailedError: As for `next_round`.
    """
    spec = stored_spec(store.read_record())
    return ranked(spec, read_trials(store), read_results(store), threshold_for(spec))
