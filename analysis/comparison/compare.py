"""Compare sweeps or settings: what can be compared, on which scale, and what a reader has to know of it."""

from __future__ import annotations

import itertools
import json
import string
from collections.abc import Sequence
from dataclasses import dataclass

from analysis.comparison.entries import Entry, Wanted, judged_alike, make_entry
from analysis.comparison.pairs import Pair, make_pair
from analysis.comparison.repetition import same_numbers
from analysis.exports.frames import ranked_settings
from analysis.objectives import failed_score, never_reached
from analysis.records import FINISHED, Objective, SweepRecord, TrialRecord
from analysis.report_data import are_one_env, env_arguments_of, env_of
from analysis.wording import counted

MAX_ENTRIES = len(string.ascii_uppercase)
_MAX_ALL_PAIRS = 4


@dataclass(frozen=True)
class Comparison:
    """Sweeps or settings side by side."""

    entries: tuple[Entry, ...]
    """In the order in which they were named."""
    pairs: tuple[Pair, ...]
    """All pairs of up to four entries, else the one with the highest mean with each other; none if not comparable."""
    objective: Objective
    """What all of them are judged by."""
    not_comparable: tuple[str, ...]
    """Why their scores are on no common scale; empty if they are."""
    notes: tuple[str, ...]
    """What has to be known to read the numbers."""
    failed_score: float | None = None
    """What a failed seed counts as, the worst of all sweeps that are compared, with all of their settings; None: the
    worst of its sweep, as nothing is on one scale, or there are no scores."""
    longest_env_steps: int | None = None
    """By `steps_to_threshold`, the env steps of a training of the longest sweep: one that never reaches the threshold
    counts as twice these, in all sweeps; None: each has its own, or it is judged by something else."""


def compare(wanted: Sequence[Wanted], objective: Objective | None = None) -> Comparison:
    """Compare sweeps, or settings of them.

    Args:
        wanted: At least two.
        objective: What all are judged by; None: what they say, or `final` if they don't agree.
    """
    notes: list[str] = []
    thresholds = {item.data.threshold for item in wanted}
    shares_threshold = len(thresholds) < 2
    threshold = next(iter(thresholds), None) if shares_threshold else None
    if not shares_threshold:
        notes.append("They have other thresholds, so it is not said how many seeds solved the environment.")
    chosen, why = (objective, "") if objective else common_objective(wanted)
    notes += [why] if why else []
    named = dict(zip(string.ascii_uppercase, wanted, strict=False))
    reasons = why_not_comparable([item.sweep for item in wanted], list(named))
    alone = {letter: judged_alike(item, chosen, threshold) for letter, item in named.items()}
    failed = None if reasons else _failed_score(list(alone.values()))
    # Were it twice the length of each sweep, the shorter one would be the better for not reaching the threshold.
    by_longest = chosen == "steps_to_threshold" and not reasons
    longest = max(item.data.longest for item in wanted) if by_longest else None
    ready = {letter: judged_alike(item, chosen, threshold, failed, longest=longest) for letter, item in named.items()}
    entries = tuple(
        make_entry(item, letter, alone[letter].data, shares_threshold=shares_threshold)
        for letter, item in ready.items()
    )
    pairs = () if reasons else tuple(make_pair(one, other, ready) for one, other in _pairs(entries))
    notes += [*_told_of_each(wanted, entries), *_told_of_all(wanted, entries, longest)]
    if any(entry.num_failed for entry in entries):
        one_sweep = len({item.origin for item in wanted}) == 1
        notes.append(_told_of_failures(chosen, of_its_sweep=one_sweep or bool(reasons)))
    return Comparison(entries, pairs, chosen, tuple(reasons), tuple(notes), failed, longest)


def _failed_score(wanted: Sequence[Wanted]) -> float | None:
    """Return what a failed seed of any of them counts as, in all of their sweeps; None: none has scores.

    Were it the worst of its own sweep, one that crashed would be better than those that trained in a worse sweep.
    """
    scores = [score for item in wanted for setting in ranked_settings(item.data) for score in setting.scores]
    if not scores:
        return None
    longest = max(item.data.longest for item in wanted)
    return failed_score(scores, wanted[0].data.objective, num_env_steps=longest)


def _told_of_failures(objective: Objective, *, of_its_sweep: bool) -> str:
    if objective == "steps_to_threshold":
        return "A failed seed counts as a training that never reaches the threshold."
    # Settings that aren't compared count as well.
    of_whom = "its sweep" if of_its_sweep else "all sweeps that are compared"
    return f"A failed seed counts as the worst training of {of_whom}."


def common_objective(wanted: Sequence[Wanted]) -> tuple[Objective, str]:
    """Return what sweeps or settings are judged by where nobody asked for it, and why, if it isn't what they say."""
    objectives = list(dict.fromkeys(item.data.objective for item in wanted))
    if len(objectives) > 1:
        named = ", ".join(f"{item.name} by {item.data.objective}" for item in wanted)
        return "final", f"Their sweep files judge them differently ({named}): here all are judged by final."
    thresholds = {item.data.threshold for item in wanted}
    if objectives[0] == "steps_to_threshold" and (len(thresholds) > 1 or None in thresholds):
        return "final", "They share no threshold, so they are judged by final, not by the env steps to it."
    return objectives[0], ""


def _pairs(entries: Sequence[Entry]) -> list[tuple[Entry, Entry]]:
    if len(entries) <= _MAX_ALL_PAIRS:
        return list(itertools.combinations(entries, 2))
    leader = max(entries, key=lambda entry: -float("inf") if entry.mean is None else entry.mean)
    return [(leader, entry) for entry in entries if entry is not leader]


def why_not_comparable(sweeps: Sequence[SweepRecord], names: Sequence[str]) -> list[str]:
    """Return why returns can't be compared: they are of different environments; empty if they can.

    Args:
        sweeps: At least one.
        names: What each is called in the sentences.
    """
    first, env_id, arguments = names[0], env_of(sweeps[0]), env_arguments_of(sweeps[0])
    reasons = []
    for sweep, name in zip(sweeps[1:], names[1:], strict=True):
        if not are_one_env(env_of(sweep), env_id):
            reasons.append(
                f"{first} is on {env_id}, {name} on {env_of(sweep)}: returns of different environments are on "
                "different scales."
            )
        elif (other := env_arguments_of(sweep)) != arguments:
            reasons.append(
                f"{first} and {name} give {env_id} different arguments ({arguments} and {other}), which may change its "
                "returns."
            )
    return reasons


def _told_of_each(wanted: Sequence[Wanted], entries: Sequence[Entry]) -> list[str]:
    notes = []
    told: set[tuple[str, tuple[str, float]]] = set()
    for item, entry in zip(wanted, entries, strict=True):
        trials = item.data.trials
        left = sum(trial.status not in FINISHED for trial in trials)
        # Copies of a sweep may each go on, and others have its name.
        sweep = (entry.sweep, item.origin)
        if left and sweep not in told:
            notes.append(
                f"Sweep {entry.sweep} is {item.sweep.state}: {len(trials) - left} of {counted(len(trials), 'trial')} "
                "have ended, and the numbers are those so far."
            )
        told.add(sweep)
        if entry.is_sweep and entry.scores and entry.num_settings > 1:
            seeds = "one seed" if len(entry.scores) == 1 else f"{len(entry.scores)} seeds"
            notes.append(
                f"{entry.letter} leads {entry.num_settings} settings by the {seeds} that its mean is of: fresh seeds "
                "would likely score less."
            )
    return notes


def _told_of_all(wanted: Sequence[Wanted], entries: Sequence[Entry], longest: int | None) -> list[str]:
    notes = _same_trainings(wanted, entries)
    budgets = {entry.letter: item.data.longest for item, entry in zip(wanted, entries, strict=True)}
    if len(set(budgets.values())) > 1:
        told = ", ".join(f"{letter} {steps:,}" for letter, steps in budgets.items())
        notes.append(f"Trials may take different numbers of env steps: {told}.")
    if longest is not None and (len(set(budgets.values())) > 1 or _some_never_reach(entries, longest)):
        notes.append(f"One that never reaches the threshold counts as {2 * longest:,} env steps, twice the longest.")
    versions = [item.sweep.versions for item in wanted]
    other = sorted(
        {name for known in versions for name in known if any(each.get(name) != known[name] for each in versions)}
    )
    if other:
        told = "; ".join(
            f"{name} {', '.join(str(known.get(name, 'not recorded')) for known in versions)}" for name in other
        )
        notes.append(f"They ran with different versions: {told}.")
    return notes


def _some_never_reach(entries: Sequence[Entry], longest: int) -> bool:
    return any(never_reached(longest) in entry.scores for entry in entries)


def _same_trainings(wanted: Sequence[Wanted], entries: Sequence[Entry]) -> list[str]:
    """Say where two sweeps did the same training twice, which is no independent evidence."""
    notes = []
    for one, other in itertools.combinations(range(len(wanted)), 2):
        pair = (wanted[one], wanted[other])
        # What copies of a sweep have in common is told where they are read.
        of_one_sweep = pair[0].origin == pair[1].origin
        if of_one_sweep or why_not_comparable([item.sweep for item in pair], [item.name for item in pair]):
            continue
        if same := _num_same(*pair):
            notes.append(
                f"{entries[one].letter} and {entries[other].letter} have {counted(same, 'training')} with the same "
                "hyperparameters, the same training seed and the same results: these are the same numbers twice, and "
                "the intervals take them for independent ones."
            )
    return notes


def _num_same(one: Wanted, other: Wanted) -> int:
    """Return how many trainings two sweeps both did: those of one seed may still see or build something else."""
    theirs = {_training(trial): trial.trial_id for trial in _counted(other)}
    are_evaluated_alike = one.sweep.evaluation_seeds == other.sweep.evaluation_seeds
    alike = ((trial.trial_id, theirs.get(_training(trial))) for trial in _counted(one))
    return sum(
        same_numbers(
            one.data.results.get(ours, ()), other.data.results.get(twin, ()), are_evaluated_alike=are_evaluated_alike
        )
        for ours, twin in alike
        if twin is not None
    )


def _counted(item: Wanted) -> list[TrialRecord]:
    return [trial for trial in item.data.trials if item.point_index in (None, trial.point_index)]


def _training(trial: TrialRecord) -> str:
    return json.dumps([trial.engine, trial.seed, trial.hyperparams], sort_keys=True, default=str)
