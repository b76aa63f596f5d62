"""What a setting is judged by: one score a training seed, from all that its trial showed.

A *setting* is a point of the sweep: values to train with. That is another question than which checkpoint is the best
*policy* (`analysis.selection`): a setting is good if training with it goes well again, on seeds nobody has seen. So its
score is never the best of many evaluations, which is mostly luck, unless that is asked for.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.records import IterationRecord, Objective, TrialRecord, TrialState, longest_length, whole_length
from analysis.statistics import area_under_curve, moderated_means
from analysis.statistics.estimate import exponent_of

_LEAST_BETWEEN = 1e-3
_NUM_LAST_EPISODES = 100
"""What a trial that ended early is taken to go on with, where `final` looks at training episodes."""
_SHARE_OF_EVALUATIONS = 0.75
"""How much of `final` is greedy evaluations; the rest is training episodes."""
_GOALS = ("training_return", "evaluation_return")
"""The stop rules that are goals; the others say how long a trial trains."""


@dataclass(frozen=True)
class SettingScores:
    """A point of a sweep, and the scores of its trials."""

    point_index: int
    point: dict[str, Any]
    scores: tuple[float, ...]
    """One a training seed, higher is better; what a seed that failed counts as is said at `failed_score`."""
    trial_ids: tuple[str, ...]
    """The trials, in the order of the scores."""
    num_failed: int
    expected: float
    """What its mean over many seeds is expected to be, see `expected_means`; settings are ranked by this."""
    env_steps: tuple[int, ...]
    """What a training takes, one a seed, in the order of the scores; see `env_steps_of`."""
    num_unscored: int = 0
    """Seeds whose score is not their own: they failed, or ended without anything to be scored."""

    @property
    def mean(self) -> float:
        """Mean over the seeds."""
        return _weighted_mean([(score, 1.0) for score in self.scores])

    @property
    def cost(self) -> float:
        """Mean env steps that a training takes."""
        return sum(self.env_steps) / len(self.env_steps)


def rank_settings(
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    objective: Objective = "final",
    *,
    num_env_steps: int,
    num_iterations: int | None = None,
    threshold: float | None = None,
    worst: float | None = None,
    longest: int | None = None,
) -> list[SettingScores]:
    """Return the settings of a sweep, the one with the best expected mean first.

    Of equal ones, first come those with fewer trials that failed or have no score, then those of lower index.

    Trials that have not ended are left out, and so are settings that have no others. A trial that failed, or ended
    without any whole episode, counts as the worst of all (`failed_score`): to leave it out would raise the mean of its
    setting.

    Args:
        trials: The trials of one sweep.
        results: Iterations by trial id, oldest first.
        objective: What a trial is judged by.
        num_env_steps: The env steps that a trial has at most, `stop.num_env_steps`.
        num_iterations: The iterations that it has at most, `stop.num_iterations`; None: any number.
        threshold: The return to reach, for `steps_to_threshold`.
        worst: What a failed trial counts as, where other sweeps are looked at too; None: what this one says.
        longest: As for `score_of`, where other sweeps are looked at too; None: that of these trials.

    Raises:
        ValueError: `steps_to_threshold` without a threshold.
    """
    if longest is None:
        longest = longest_length(trials, num_env_steps=num_env_steps, num_iterations=num_iterations)
    shown: dict[str, float | None] = {}
    for trial in trials:
        if trial.status == "failed":
            shown[trial.trial_id] = None
        elif trial.status in ("completed", "stopped"):
            items = results.get(trial.trial_id, ())
            shown[trial.trial_id] = score_of(
                trial, items, objective, num_env_steps=num_env_steps, num_iterations=num_iterations,
                threshold=threshold, longest=longest,
            )  # fmt: skip
    known = {trial_id: score for trial_id, score in shown.items() if score is not None}
    if not known:
        return []
    if worst is None:
        worst = failed_score(known.values(), objective, num_env_steps=longest)
    members: defaultdict[int, list[TrialRecord]] = defaultdict(list)
    for trial in sorted(trials, key=lambda item: item.index):
        if trial.trial_id in shown:
            members[trial.point_index].append(trial)
    scores = {index: tuple(known.get(seed.trial_id, worst) for seed in seeds) for index, seeds in members.items()}
    expected = expected_means(list(scores.values()))
    settings = [
        SettingScores(
            point_index=index,
            point=seeds[0].point,
            scores=scores[index],
            trial_ids=tuple(seed.trial_id for seed in seeds),
            num_failed=sum(seed.status == "failed" for seed in seeds),
            expected=value,
            env_steps=tuple(env_steps_of(seed, num_env_steps, num_iterations) for seed in seeds),
            num_unscored=sum(seed.trial_id not in known for seed in seeds),
        )
        for (index, seeds), value in zip(members.items(), expected, strict=True)
    ]

    def order(item: SettingScores) -> tuple[float, float, int, int]:
        # Where the worst score is the best too, who has it for a failure comes behind who has earned it.
        return -item.expected, -item.mean, item.num_unscored, item.point_index

    return sorted(settings, key=order)


def failed_score(scores: Iterable[float], objective: Objective, *, num_env_steps: int) -> float:
    """Return what a training that failed counts as: the worst of all.

    For `steps_to_threshold` that is one that never reaches the threshold, be there one or not: were it the slowest of
    those that did, to fail would be as good as to reach it.

    Args:
        scores: The scores that there are, one at least.
        objective: What they are of.
        num_env_steps: The env steps that the longest training has.
    """
    worst = min(scores)
    return min(worst, never_reached(num_env_steps)) if objective == "steps_to_threshold" else worst


def never_reached(num_env_steps: int) -> float:
    """Return the score by `steps_to_threshold` of one that never does, where the longest training has so many steps."""
    return -2.0 * num_env_steps


def reached_goal(trial: TrialState) -> bool:
    """Whether a trial ended because it reached the return that its sweep stops at."""
    return (trial.stop_reason or "").startswith(_GOALS)


def _ended_itself(trial: TrialState) -> bool:
    return trial.status == "completed" and trial.stop_reason is not None and not reached_goal(trial)


def env_steps_of(trial: TrialRecord, num_env_steps: int, num_iterations: int | None = None) -> int:
    """Return what a training as this trial's takes, in env steps, which is its cost.

    One that ended by itself took what it takes, less where it reached its goal early. One that a scheduler ended, or
    that failed, counts with the length that it was to have: its score is that of the whole length too, and to fail is
    not cheap. That length may be a short one of its point, see `analysis.front` for settings that only failed.

    Args:
        trial: A trial that has ended.
        num_env_steps: The env steps that a trial of the sweep has at most.
        num_iterations: The iterations that it has at most, `stop.num_iterations`; None: any number.
    """
    if trial.status == "completed":
        return trial.num_env_steps
    length = whole_length(trial.point, trial.hyperparams, num_env_steps=num_env_steps, num_iterations=num_iterations)
    return max(trial.num_env_steps, length)


def score_of(
    trial: TrialRecord,
    iterations: Sequence[IterationRecord],
    objective: Objective,
    *,
    num_env_steps: int,
    num_iterations: int | None = None,
    threshold: float | None = None,
    longest: int | None = None,
) -> float | None:
    """Return what a trial scored, see `trial_score`, over the env steps that it was to have.

    Those are its own where it ended by a number of episodes or iterations, or by time: it trained as long as it was to.
    One that reached its goal, or that a scheduler ended, was to have `num_env_steps`, or less where its point or
    `num_iterations` says so.

    Args:
        trial: The trial.
        iterations: Its iterations, oldest first.
        objective: What it is judged by.
        num_env_steps: The env steps that a trial has at most.
        num_iterations: The iterations that it has at most, `stop.num_iterations`; None: any number.
        threshold: The return to reach, for `steps_to_threshold`.
        longest: The env steps of the sweep's longest training, see `longest_length`: by `steps_to_threshold` one that
            never reaches it counts as twice these, however long it was to be itself; None: `num_env_steps`.

    Raises:
        ValueError: `steps_to_threshold` without a threshold.
    """
    if objective == "steps_to_threshold":
        num_env_steps = num_env_steps if longest is None else longest
    else:
        most = None if _ended_itself(trial) else num_iterations
        num_env_steps = whole_length(trial.point, trial.hyperparams, num_env_steps=num_env_steps, num_iterations=most)
    return score_so_far(trial, iterations, objective, num_env_steps=num_env_steps, threshold=threshold)


def score_so_far(
    trial: TrialState,
    iterations: Sequence[IterationRecord],
    objective: Objective,
    *,
    num_env_steps: int,
    threshold: float | None = None,
) -> float | None:
    """Return what a trial scores if it ends where it stands; see `score_of`.

    Args:
        trial: Where it stands.
        iterations: Its iterations, oldest first.
        objective: What it is judged by.
        num_env_steps: The env steps that it is to have itself; for `steps_to_threshold` those of the longest.
        threshold: The return to reach, for `steps_to_threshold`.

    Raises:
        ValueError: `steps_to_threshold` without a threshold.
    """
    # What never reached the threshold counts as the same number of env steps, however long it tried.
    if _ended_itself(trial) and trial.num_env_steps and objective != "steps_to_threshold":
        num_env_steps = min(num_env_steps, trial.num_env_steps)
    return trial_score(iterations, objective, num_env_steps=num_env_steps, threshold=threshold)


def trial_score(
    iterations: Sequence[IterationRecord],
    objective: Objective,
    *,
    num_env_steps: int,
    threshold: float | None = None,
) -> float | None:
    """Return what a trial scored; None: it showed nothing that can be scored.

    - `final`: how well it does in the later half of `num_env_steps`: three parts mean greedy evaluation, one part mean
      return of the training episodes. Evaluations are of the policy that one gets, but few; training episodes explore,
      but there are many (decision 29). A trial that ended earlier, as it reached its goal or as a scheduler ended it,
      is taken to go on as it was at last: its last evaluation, and its last 100 or more training episodes (whole
      iterations of them).
    - `area`: the mean evaluation return over all its env steps, `statistics.area_under_curve`.
    - `best`: its best evaluation.
    - `steps_to_threshold`: minus the env steps to the first evaluation that reaches the threshold, and minus twice
      those of the longest training if none does, as in PAR2, the penalised run time of algorithm configuration (Hutter
      et al. 2009, "ParamILS", section 2).

    Args:
        iterations: Its iterations, oldest first.
        objective: What it is judged by.
        num_env_steps: The env steps that the trial is to have; for `steps_to_threshold` those of the longest.
        threshold: The return to reach, for `steps_to_threshold`.

    Raises:
        ValueError: `steps_to_threshold` without a threshold.
    """
    evaluated = [(item.num_env_steps, item.evaluation_return) for item in iterations]
    evaluations = [(steps, value) for steps, value in evaluated if value is not None and math.isfinite(value)]
    if objective == "steps_to_threshold":
        if threshold is None:
            raise ValueError("steps_to_threshold needs a threshold")
        reached = (-float(steps) for steps, value in evaluations if value >= threshold)
        return next(reached, never_reached(num_env_steps)) if iterations else None
    if objective == "final":
        return _final(iterations, evaluations, num_env_steps)
    if not evaluations:
        return None
    if objective == "best":
        return max(value for _, value in evaluations)
    steps, values = zip(*evaluations, strict=True)
    return area_under_curve(steps, values, num_env_steps=max(num_env_steps, steps[-1]))


def _final(
    iterations: Sequence[IterationRecord], evaluations: Sequence[tuple[int, float]], num_env_steps: int
) -> float | None:
    greedy = _greedy_of_later_half(evaluations, num_env_steps)
    exploring = _exploring_of_later_half(iterations, num_env_steps)
    if greedy is None or exploring is None:
        return exploring if greedy is None else greedy
    return _SHARE_OF_EVALUATIONS * greedy + (1.0 - _SHARE_OF_EVALUATIONS) * exploring


def _greedy_of_later_half(evaluations: Sequence[tuple[int, float]], num_env_steps: int) -> float | None:
    """Return the mean evaluation of the later half; each counts for the env steps since the one before, the last on."""
    if not evaluations:
        return None
    begin, last = num_env_steps / 2, evaluations[-1][1]
    end = max(num_env_steps, evaluations[-1][0])
    parts, before = [], begin
    for steps, value in evaluations:
        if steps > before:
            parts.append((value, steps - before))
            before = steps
    return _weighted_mean([*parts, (last, end - before)])


def _exploring_of_later_half(iterations: Sequence[IterationRecord], num_env_steps: int) -> float | None:
    """Return the mean return of the episodes of the later half; after a trial's end its last hundred go on."""
    later = [item for item in iterations if item.num_env_steps > num_env_steps / 2]
    mean = _mean_return(later)
    trained = iterations[-1].num_env_steps if iterations else 0
    if mean is not None and trained >= num_env_steps:
        return mean
    last = _last_episodes(iterations)
    if mean is None or last is None:
        return last
    known = (trained - num_env_steps / 2) / (num_env_steps / 2)
    return known * mean + (1.0 - known) * last


def _last_episodes(iterations: Sequence[IterationRecord]) -> float | None:
    """Return the mean return of the last hundred episodes, in whole iterations, or of all that there are."""
    count = 0
    for index in range(len(iterations) - 1, -1, -1):
        count += sum(map(math.isfinite, iterations[index].episode_returns))
        if count >= _NUM_LAST_EPISODES:
            return _mean_return(iterations[index:])
    return _mean_return(iterations)


def _mean_return(iterations: Sequence[IterationRecord]) -> float | None:
    values = [value for item in iterations for value in item.episode_returns if math.isfinite(value)]
    return _weighted_mean([(value, 1.0) for value in values]) if values else None


def _weighted_mean(values: Sequence[tuple[float, float]]) -> float:
    """Return the mean of pairs of value and weight; of equal values it is that value, to the bit."""
    weight = math.fsum(weight for _, weight in values)
    try:
        mean = math.fsum(value * weight for value, weight in values) / weight
    except OverflowError:
        mean = math.inf
    # The sum of returns near the largest number that there is would be no number.
    return mean if math.isfinite(mean) else math.fsum(value * (part / weight) for value, part in values)


def expected_means(settings: Sequence[Sequence[float]]) -> list[float]:
    """Return what each setting's mean over many seeds is expected to be: its mean, drawn back to that of all.

    The fewer seeds a setting has, and the less settings differ beside how much seeds do, the further: the best of many
    means over one seed is mostly a lucky one. It is the posterior mean where settings come from a normal distribution.
    With one seed a setting nothing is known of how seeds differ, and the means are returned as they are.

    Args:
        settings: For each setting one score a training seed.

    Source:
        DerSimonian & Laird 1986, "Meta-Analysis in Clinical Trials", for the variance between settings; Morris 1983,
        "Parametric Empirical Bayes Inference", for the means.
    """
    if not settings:
        return []
    # In units of a power of two, by which nothing is rounded, as the squares of large or small scores are lost.
    exponent = exponent_of([score for scores in settings for score in scores])
    units = [[math.ldexp(score, -exponent) for score in scores] for scores in settings]
    plain = [math.fsum(scores) / len(scores) for scores in units]
    return [math.ldexp(mean, exponent) for mean in _drawn_back(units, plain)]


def _drawn_back(settings: Sequence[Sequence[float]], plain: list[float]) -> list[float]:
    """Return the means of settings, drawn back; scores are at most 1."""
    if len(plain) < 2 or max(map(len, settings)) < 2:
        return plain
    means = np.array(plain)
    try:
        variances = moderated_means(settings).standard_errors ** 2
    except ValueError:  # not finite
        return plain
    if not variances.all():
        return plain
    weights = 1.0 / variances
    centre = float((weights * means).sum() / weights.sum())
    excess = float((weights * (means - centre) ** 2).sum()) - (len(means) - 1)
    between = excess / float(weights.sum() - (weights**2).sum() / weights.sum())
    # Where settings differ no more than chance would make them, they differ a little all the same: the better ones come
    # first, those with more seeds further than a lucky one.
    between = max(between, _LEAST_BETWEEN * float(variances.mean()))
    weights = 1.0 / (variances + between)
    centre = float((weights * means).sum() / weights.sum())
    drawn: list[float] = (centre + (means - centre) * between / (variances + between)).tolist()
    return drawn
