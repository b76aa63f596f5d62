"""Train the leading settings of a sweep again, as its `confirm` asks: a race within a share of the search's env steps.

Which round comes next follows from the sweep's records alone, so a sweep that was interrupted goes on with the same
race, and an equal spec and seed give an equal one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence

from analysis.objectives import SettingScores, reached_goal
from analysis.racing import Race, race_within
from analysis.records import IterationRecord, ReplicationRecord, SweepRecord, TrialRecord
from policies.portable.file import BASELINE_KINDS
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.candidates import read_results, read_trials
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.forecast import caps_of
from tune_jobs.sweeps.settings import ranked, threshold_for


def may_confirm(spec: SweepSpec) -> bool:
    """Whether a sweep's `confirm` can act: it is on, and trials keep a setting by which a policy is trained."""
    return spec.confirm.max_share > 0 and not spec.scheduler.is_population and spec.algorithm not in BASELINE_KINDS


def points_to_confirm(store: Sweep) -> tuple[int, ...]:
    """Return the points that get one more seed each in the next round of a sweep's `confirm`; none: it is over.

    All trials have ended. A sweep that somebody has replicated since its last sample is left alone.

    Raises:
        CheckpointError: A record is damaged.
        EnvError: The objective is about the env's threshold, and the env cannot be made.
        EnvFailedError: As for EnvError, and it failed.
    """
    record = store.read_record()
    spec = stored_spec(record)
    rounds = recent_rounds(record)
    if not may_confirm(spec) or any(item.by != "confirm" for item in rounds):
        return ()
    threshold = threshold_for(spec)
    with store.reading():
        trials, results = read_trials(store), read_results(store)

    def ranked_of(known: Sequence[TrialRecord]) -> list[SettingScores]:
        return ranked(spec, known, results, threshold)

    race, before, num_done = race_under_way(spec, trials, rounds, ranked_of)
    if race is None or are_all_alike(line for trial in before for line in results.get(trial.trial_id, ())):
        return ()
    return race.next_points(_scores(ranked_of(trials)), num_done)


def race_under_way(
    spec: SweepSpec,
    trials: Sequence[TrialRecord],
    rounds: Sequence[ReplicationRecord],
    ranked_of: Callable[[Sequence[TrialRecord]], Sequence[SettingScores]],
) -> tuple[Race | None, list[TrialRecord], int]:
    """Return the race that goes on or begins, the trials that were there before it, and how many rounds are over.

    A trial that failed and was trained again may have come to lead. Rounds in which its setting did not race are
    another race's, which is given up as when points are added: their seeds count as spent.

    Args:
        spec: The sweep.
        trials: All of its trials.
        rounds: Those since the last points came, oldest first.
        ranked_of: Ranks settings, by those trials of them that it is given.
    """
    for first in range(len(rounds) + 1):
        own = rounds[first:]
        before = trials_before(trials, own)
        settings = ranked_of(before)
        race = confirming_race(spec, different_points(settings), before)
        if race is None or not own or set() < set(race.next_points(_scores(settings), 0)) <= set(own[0].points):
            break
    return race, before, len(own)


def _scores(settings: Sequence[SettingScores]) -> dict[int, Sequence[float]]:
    return {item.point_index: item.scores for item in settings}


def are_all_alike(results: Iterable[IterationRecord]) -> bool:
    """Whether trials were evaluated and all episodes of all of them, those of training too, had the same return.

    That is how it looks where nothing was learned, as on MountainCar in too short a training: no setting leads, and to
    train some of them again would cost up to half as much as the search and decide nothing.

    Args:
        results: Of all trials of the search.
    """
    first: float | None = None
    is_evaluated = False
    # Most end with the second of them: nothing is gathered, as there may be millions.
    for line in results:
        is_evaluated = is_evaluated or line.evaluation_return is not None
        for value in (line.evaluation_return, *line.episode_returns):
            if first is None:
                first = value
            elif value is not None and value != first:
                return False
    return is_evaluated


def different_points(settings: Sequence[SettingScores]) -> list[int]:
    """Return the points of settings in their order, of equal values only the first: no setting races with itself."""
    first: dict[str, int] = {}
    for item in settings:
        first.setdefault(json.dumps(item.point, sort_keys=True), item.point_index)
    return list(first.values())


def recent_rounds(record: SweepRecord) -> list[ReplicationRecord]:
    """Return the replications since the last points came to a sweep."""
    last = max((item.num_points for item in record.replications), default=0)
    spec = stored_spec(record)
    seeds = spec.seeds_per_point
    num_replicas = sum(len(item.points) for item in record.replications)
    if record.num_trials - num_replicas > last * seeds:
        return []
    return [item for item in record.replications if item.num_points == last]


def trials_before(trials: Sequence[TrialRecord], rounds: Sequence[ReplicationRecord]) -> list[TrialRecord]:
    """Return the trials that there were before these rounds, which were the last ones."""
    num_added = sum(len(item.points) for item in rounds)
    ordered = sorted(trials, key=lambda trial: trial.index)
    return ordered[: len(ordered) - num_added]


def confirming_race(spec: SweepSpec, contenders: Sequence[int], trials: Sequence[TrialRecord]) -> Race | None:
    """Return the race that fits in the share of the search's env steps; None: none does.

    Args:
        spec: The sweep.
        contenders: The indices of its points, best first.
        trials: Its trials before the race. Seeds that earlier races gave count as spent.
    """
    searched = sum(trial.num_env_steps for trial in trials if trial.seed_index < spec.seeds_per_point)
    spent = sum(trial.num_env_steps for trial in trials) - searched
    # The race is not to exceed the share, so each training counts with the most that it may take: as far as the longest
    # of the search, or to the cap if all of them ended before they had to.
    whole = [trial for trial in trials if trial.status == "completed" and not reached_goal(trial)]
    steps = [trial.num_env_steps for trial in whole] if whole else caps_of(spec, trials).values()
    most = max(steps, default=0)
    if not most:
        return None
    allowed = int((spec.confirm.max_share * searched - spent) // most)
    return race_within(contenders, top=spec.confirm.top, num_seeds=spec.confirm.seeds, max_trainings=allowed)


def largest_race(spec: SweepSpec, num_points: int) -> Race | None:
    """Return the race that a new sweep has if all of its trials train to their caps; None: none."""
    if not may_confirm(spec):
        return None
    allowed = int(spec.confirm.max_share * num_points * spec.seeds_per_point)
    confirm = spec.confirm
    return race_within(range(num_points), top=confirm.top, num_seeds=confirm.seeds, max_trainings=allowed)
