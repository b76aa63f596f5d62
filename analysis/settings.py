"""Which setting to train with: the settings of a sweep ranked over their training seeds, and how sure that is.

Nothing here looks at checkpoints: which policy to deploy is another question (`analysis.selection`), and its answer may
come from another setting.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from analysis.best_records import SettingRecord, SettingsRecord
from analysis.front import front_of, untrained_return
from analysis.objectives import SettingScores, never_reached, rank_settings
from analysis.records import Cost, IterationRecord, Objective, TrialRecord, longest_length
from analysis.statistics import known_intervals, probability_of_being_best, tell_the_best, tie_groups
from analysis.tables import env_steps_to
from policies import random_streams

NUM_LISTED = 10


def judge_settings(
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    objective: Objective = "final",
    *,
    num_env_steps: int,
    num_iterations: int | None = None,
    threshold: float | None,
    cost: Cost | None = None,
) -> SettingsRecord | None:
    """Rank the settings of a sweep; None if no trial has ended with anything to be judged by.

    Intervals, and the probability to be the best, need a setting with two seeds that differ: how much seeds differ is
    learnt from all of them (`statistics.moderated_means`).

    Args:
        trials: The trials of one sweep.
        results: Iterations by trial id, oldest first.
        objective: What they are judged by.
        num_env_steps: The env steps that a trial has at most, `stop.num_env_steps`.
        num_iterations: The iterations that it has at most, `stop.num_iterations`; None: any number.
        threshold: The return that solves the env; None: it has none.
        cost: What settings cost; None: the sweep doesn't ask for it.

    Raises:
        ValueError: In the cases of `objectives.rank_settings`.
    """
    ranking = rank_settings(
        trials, results, objective, num_env_steps=num_env_steps, num_iterations=num_iterations, threshold=threshold
    )
    if not ranking:
        return None
    known = _known(ranking)
    longest = longest_length(trials, num_env_steps=num_env_steps, num_iterations=num_iterations)
    return SettingsRecord(
        objective=objective,
        threshold=threshold,
        num_settings=len(ranking),
        num_may_be_best=sum(item.get("may_be_best", True) for item in known),
        ranking=tuple(
            SettingRecord(
                point_index=item.point_index,
                point=item.point,
                trial_ids=item.trial_ids,
                scores=item.scores,
                num_failed=item.num_failed,
                num_solved=_num_solved(item, results, threshold),
                score=item.mean,
                expected=item.expected,
                **known[index],
            )
            for index, item in enumerate(ranking[:NUM_LISTED])
        ),
        front=None if cost is None else front_of(ranking, untrained_return(results)),
        never_reached=None if objective != "steps_to_threshold" else round(-never_reached(longest)),
        most_seeds=max(len(item.scores) for item in ranking),
    )


def _known(ranking: Sequence[SettingScores]) -> list[dict[str, Any]]:
    """Return what is known of each setting beyond its mean, in the order of the ranking."""
    scores = [item.scores for item in ranking]
    if max(map(len, scores)) < 2:
        return [{} for _ in ranking]
    # The same scores always give the same answer.
    rng = random_streams.fixed()
    try:
        if not tell_the_best(scores):
            return [{} for _ in ranking]
        chances = probability_of_being_best(scores, rng=rng)
        leaders = set(tie_groups(scores, rng=rng).with_leader)
    except ValueError:  # scores so large that their squares are not finite
        return [{} for _ in ranking]
    return [
        {
            "lower": interval and interval.lower,
            "upper": interval and interval.upper,
            "probability_best": float(chances[index]),
            "may_be_best": index in leaders,
        }
        for index, interval in enumerate(known_intervals(scores))
    ]


def _num_solved(
    item: SettingScores, results: Mapping[str, Sequence[IterationRecord]], threshold: float | None
) -> int | None:
    if threshold is None:
        return None
    return sum(env_steps_to(threshold, results.get(trial_id, ())) is not None for trial_id in item.trial_ids)
