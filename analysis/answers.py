"""Say in words which setting to train with, what it scored, and how sure that is."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Literal

from analysis.best_records import BestRecord, SettingsRecord
from analysis.records import Objective, SweepRecord, TrialRecord
from analysis.wording import counted, range_text, return_text

_MEANS: dict[Objective, str] = {
    "final": "in the later half of training",
    "area": "over all of training",
    "best": "in its best evaluation",
    "steps_to_threshold": "env steps to the threshold",
}
_TOO_LARGE = "scores are too large to be squared, so it is not known how much seeds differ"
_TOLD_SHARE = 0.1
"""Of half an interval: by so much less than its score has to be expected of a setting for that to be told."""


def setting_score(settings: SettingsRecord) -> str:
    """Return what the leading setting scored, with its interval over training seeds and how many solved the env.

    Where less is to be expected of more seeds, that is said: the best of many settings led with its seeds' luck too.
    """
    best = settings.best
    # Fewer env steps are better, so that they are scored below zero.
    sign = -1.0 if settings.objective == "steps_to_threshold" else 1.0
    parts = [f"{_score_text(settings, best.score)} {_MEANS[settings.objective]}"]
    if best.lower is not None and best.upper is not None:
        low, high = sorted((sign * best.lower, sign * best.upper))
        ends = range_text(low, high) if sign > 0 else f"{_steps_text(low)} to {_steps_text(high)}"
        parts[0] += f" ({ends} with 95 %, over training seeds)"
    if less := less_expected(settings):
        parts.append(less)
    if num := settings.num_never(best):
        whose = "its seed" if len(best.scores) == 1 else f"{num} of {len(best.scores)} seeds"
        parts.append(f"{whose} never reached it, which counts as {_steps_text(settings.never_reached or 0)}")
    if best.num_solved is not None:
        parts.append(f"{best.num_solved} of {counted(len(best.scores), 'seed')} solved it in training")
    if best.num_failed:
        parts.append(f"{best.num_failed} failed")
    return "; ".join(parts)


def less_expected(settings: SettingsRecord) -> str:
    """Say what is to be expected of more seeds of the leading setting, if that is less than its score; else empty.

    Less by a tenth of half its interval is told: what is smaller says nothing beside that.
    """
    best = settings.best
    less = best.score - best.expected
    score, expected = (_score_text(settings, value) for value in (best.score, best.expected))
    if best.lower is not None and best.upper is not None:
        less -= _TOLD_SHARE * (best.upper - best.lower) / 2
    if less <= 0.0 or expected == score:
        return ""
    return f"{expected} is to be expected of more seeds"


def why_unsure(settings: SettingsRecord) -> str:
    """Return why nothing is known of how much seeds differ, where the leading setting has no interval."""
    if not settings.several_seeds:
        return "one seed a setting names a good policy, not a good setting"
    if any(len(set(item.scores)) > 1 for item in settings.ranking):
        return _TOO_LARGE
    return "no two seeds of a setting differ, so it is not known how much they may"


def certainty(settings: SettingsRecord) -> str:
    """Return how sure it is that the leading setting is the best."""
    best = settings.best
    if best.probability_best is None:
        why = why_unsure(settings)
        # More seeds would be as large.
        return why if why == _TOO_LARGE else f"{why}: see `tune-jobs replicate`"
    text = f"the best of {settings.num_settings:,} with a probability of {_percent(best.probability_best)}"
    others = settings.num_may_be_best - 1
    if others <= 0:
        return f"{text}; the data tell it from all others"
    return f"{text}; {counted(others, 'other')} can't be told from it"


def compared_with_random(best: BestRecord) -> Literal["better", "alike", "worse"] | None:
    """Return how the winner does beside random play, by the 95 % t-interval of the mean difference over episodes.

    Args:
        best: The winner, with its confirmation and random play on the same seeds.

    Returns:
        "alike" where the interval holds 0; None: it is not known, as returns are not finite, or of one episode alone.
    """
    if best.random.seeds != best.confirmation.seeds or best.confirmation.num_episodes < 2:
        return None
    gains = [ours - theirs for ours, theirs in zip(best.confirmation.returns, best.random.returns, strict=True)]
    if not all(map(math.isfinite, gains)):
        return None
    from analysis.statistics import t_interval

    gain = t_interval(gains)
    if gain.lower > 0:
        return "better"
    return "worse" if gain.upper < 0 else "alike"


def nothing_learned(best: BestRecord) -> str:
    """Say, as a sentence, that training has not led beyond random play, and what to do; empty: it has, as far as known.

    Args:
        best: The winner of a sweep whose policies learn.
    """
    told = {"alike": "can't be told from", "worse": "is worse than"}.get(compared_with_random(best) or "")
    if told is None:
        return ""
    episodes = counted(best.confirmation.num_episodes, "episode")
    advice = "train longer (stop.num_env_steps), or search other values"
    return f"The best policy {told} random play over {episodes}: {advice}."


def replicas_text(sweep: SweepRecord, trials: Sequence[TrialRecord]) -> str:
    """Return which trials gave leading settings more seeds, their cost, and what the race saved; empty: none did."""
    rounds = [item for item in sweep.replications if item.points]
    num_added = sum(len(item.points) for item in rounds)
    if not num_added:
        return ""
    seeds = Counter(index for item in rounds for index in item.points)
    added = [trial for trial in trials if trial.seed_index >= int(sweep.spec.get("seeds_per_point") or 1)]
    steps, all_steps = (sum(trial.num_env_steps for trial in group) for group in (added, trials))
    share = f" with {100 * steps / all_steps:.0f} % of the env steps" if all_steps else ""
    text = f"{counted(num_added, 'trial')} gave {counted(len(seeds), 'leading setting')} more seeds{share}"
    without = len(seeds) * max(seeds.values())
    return f"{text}; as many for each would take {without}" if without > num_added else text


def _score_text(settings: SettingsRecord, score: float) -> str:
    return _steps_text(-score) if settings.objective == "steps_to_threshold" else return_text(score)


def _steps_text(steps: float) -> str:
    return f"{max(0.0, steps):,.0f}"


def _percent(probability: float) -> str:
    """Return a probability that is computed from draws: never as certain."""
    if probability > 0.99:
        return "over 99 %"
    return "under 1 %" if probability < 0.01 else f"{100 * probability:.0f} %"
