"""The answer in two or three sentences: which setting to train with, how sure that is, and which policy to load."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass

from analysis.answers import certainty, setting_score, why_unsure
from analysis.best_records import EvaluationRecord, SettingRecord, SettingsRecord
from analysis.page.estimates import replicate_takes
from analysis.page.scores import score_text
from analysis.page.source import Source, point_text
from analysis.records import FINISHED
from analysis.selection import NoUsableTrialError, score_trial, select_best
from analysis.statistics import episodes_interval, median_steps
from analysis.wording import counted, interval_text, known_return_text, number, return_text
from policies import random_streams

_MAX_AVERAGED = 1e150
_NO_SETTING_IN_A_POPULATION = (
    "The trials of a population change their hyperparameters while they train, so no setting can be named that would "
    "give the same again."
)


@dataclass(frozen=True)
class Answer:
    """What the section shows."""

    sentences: list[str]
    command: str = ""
    """What decides between the settings; empty: nothing is left to decide."""
    takes: str = ""
    """How long that takes, about; empty: it is not known."""


def section(source: Source) -> Answer:
    """Return the answer, made from the sweep's data."""
    settings = source.settings
    if not source.trials:
        return Answer(["The sweep has no trials yet."])
    sentences = [*_progress(source), *_about_setting(source), *_about_policy(source)]
    # Of one setting there is nothing to decide; a sweep that goes on decides more by itself.
    open_question = settings is not None and settings.num_settings > 1 and settings.num_may_be_best > 1
    if source.nothing_learned:
        # More seeds of settings that have led nowhere would decide nothing.
        return Answer([source.nothing_learned, *sentences])
    if not open_question or not source.is_trained or source.is_population:
        return Answer(sentences)
    return Answer(sentences, replicate_command(source), replicate_takes(source))


def replicate_command(source: Source) -> str:
    """Return the command that trains the leading settings with more seeds."""
    return f"tune-jobs replicate {shlex.quote(source.path)}"


def _progress(source: Source) -> list[str]:
    ended = sum(trial.status in FINISHED for trial in source.trials)
    if source.sweep.state == "completed" or ended == len(source.trials):
        return []
    return [f"So far {ended:,} of {counted(len(source.trials), 'trial')} have ended."]


def _about_setting(source: Source) -> list[str]:
    settings = source.settings
    if not source.is_trained:
        return []
    if source.is_population:
        return [_NO_SETTING_IN_A_POPULATION]
    if settings is None:
        return ["No setting can be named: no trial has ended with anything that it could be judged by."]
    return _of_settings(source, settings)


def _of_settings(source: Source, settings: SettingsRecord) -> list[str]:
    if settings.num_settings == 1:
        who = point_text(settings.best.point)
        told = f"The sweep has one setting{f', {who}' if who else ''}: {_outcome(source, settings, settings.best)}."
        # How others would do is not known of one.
        return [told] if len(settings.best.scores) > 1 else [told, "One seed says nothing of how others would do."]
    if _all_equal(settings):
        score = score_text(settings, settings.best.score)
        return [f"All {settings.num_settings:,} settings scored {score}: the data can't order them."]
    if settings.best.probability_best is None:
        return _unsure(source, settings) if settings.several_seeds else _one_seed(source, settings)
    return [*_use(source, settings), *_runner_up(source, settings)]


def _all_equal(settings: SettingsRecord) -> bool:
    """Whether all seeds of all settings have reached one score; where not all settings are listed, it is not known."""
    scores = {score for item in settings.ranking for score in item.scores}
    has_failures = any(item.num_failed for item in settings.ranking)
    return settings.num_settings == len(settings.ranking) and len(scores) == 1 and not has_failures


def _one_seed(source: Source, settings: SettingsRecord) -> list[str]:
    known = [scored.score for trial in source.trials if (scored := score_trial(trial)) is not None]
    most = max(known, default=None)
    tied = known.count(most) if most is not None else 0
    ties = f"; {tied:,} of {len(source.trials):,} trials tie at {return_text(most)}" if tied > 1 else ""
    if tied == len(source.trials) and len({item.score for item in settings.ranking}) == 1:
        # Nobody did best.
        return [f"One seed a setting names a good policy, not a good setting{ties}."]
    best = settings.best.model_copy(update={"num_solved": None})
    text = setting_score(settings.model_copy(update={"ranking": (best,)}))
    leader = f"{point_text(best.point)} did best with its one seed: {text}."
    return [f"One seed a setting names a good policy, not a good setting{ties}.", leader]


def _unsure(source: Source, settings: SettingsRecord) -> list[str]:
    """Say who leads where settings have several seeds, and nothing is known of how much these differ."""
    best = settings.best
    tied = sum(item.score == best.score for item in settings.ranking)
    # More may tie than are listed.
    least = "at least " if tied == len(settings.ranking) else ""
    ties = f"; {least}{tied:,} of {settings.num_settings:,} settings tie" if tied > 1 else ""
    leads = f"{point_text(best.point)} leads: {_outcome(source, settings, best)}{ties}."
    return [f"{why_unsure(settings).capitalize()}; {leads}"]


def _use(source: Source, settings: SettingsRecord) -> list[str]:
    best = settings.best
    if settings.num_may_be_best == settings.num_settings:
        leads = f"{point_text(best.point)} leads: {_outcome(source, settings, best)}."
        return [f"So far nothing tells the settings apart; {leads}"]
    return [f"Use {point_text(best.point)}: {_outcome(source, settings, best)}."]


def _runner_up(source: Source, settings: SettingsRecord) -> list[str]:
    """Say how sure the best is, and how the next one is that may be as good."""
    best = settings.best
    second = next((item for item in settings.ranking[1:] if item.may_be_best), None)
    sure = f"It is {certainty(settings)}."
    if second is None:
        return [sure]
    one, two = _median(source, settings, best), _median(source, settings, second)
    if _as_reliable(best, second) and one is not None and two is not None and one != two:
        # Settings are ranked by what is to be expected of them: one of fewer seeds may have scored more.
        less = ", though it scored less" if second.score < best.score else ""
        how = "but slower" if two > one else f"and faster{less}"
        return [sure, f"{point_text(second.point)} is as reliable {how} ({number(round(two))} env steps)."]
    return [sure, f"Next comes {point_text(second.point)}: {_outcome(source, settings, second)}."]


def _as_reliable(best: SettingRecord, other: SettingRecord) -> bool:
    """Whether the same share of both settings' seeds reached the threshold, two of each at least.

    One seed that did says little of others: of a setting of which half of the seeds do it is met every second time.
    """
    ours, theirs = best.num_solved or 0, other.num_solved or 0
    return min(ours, theirs) > 1 and ours * len(other.scores) == theirs * len(best.scores)


def _outcome(source: Source, settings: SettingsRecord, item: SettingRecord) -> str:
    """Say how the seeds of a setting did: by the threshold where any reached it, else by the objective."""
    if not item.num_solved:
        scored = setting_score(settings.model_copy(update={"ranking": (item,)}))
        return f"it scored {scored}"
    goal, num_seeds = number(settings.threshold), len(item.scores)
    text = f"{item.num_solved:,} of {counted(num_seeds, 'seed')} reached {goal}"
    steps = [value for value in _steps(source, settings, item) if value is not None]
    median = _median(source, settings, item)
    if not steps:
        return text
    if median is None:
        return f"{text}, in {number(min(steps))} env steps at best"
    if num_seeds == 1:
        return f"{text}, after {number(steps[0])} env steps"
    spread = f" ({number(min(steps))} to {number(max(steps))})" if min(steps) < max(steps) else ""
    return f"{text}, after a median of {number(round(median))} env steps{spread}"


def _steps(source: Source, settings: SettingsRecord, item: SettingRecord) -> list[int | None]:
    return [source.env_steps_to_goal(trial_id, settings.threshold) for trial_id in item.trial_ids]


def _median(source: Source, settings: SettingsRecord, item: SettingRecord) -> float | None:
    return median_steps(_steps(source, settings, item))


def _about_policy(source: Source) -> list[str]:
    best = source.best
    if best is None:
        try:
            select_best(source.trials)
        except NoUsableTrialError as error:
            return [error.message]
        return ["No policy is confirmed on fresh seeds yet."]
    whose = f"the policy of {best.checkpoint.trial_id}" if source.is_trained else "the best policy"
    text = f"To act, load {whose}: {_confirmed(best.confirmation)}"
    settings = source.settings
    if settings is not None and settings.num_settings > 1 and source.winner not in settings.best.trial_ids:
        text += f" It was trained with another setting, {point_text(best.point)}."
    return [text]


def _confirmed(confirmation: EvaluationRecord) -> str:
    """Say what a policy scored on fresh seeds, as a sentence."""
    returns, episodes = confirmation.returns, counted(confirmation.num_episodes, "fresh episode")
    text = known_return_text(confirmation.mean_return)
    if not math.isfinite(confirmation.mean_return):
        # It can't be compared with a threshold either.
        return f"its mean return over {episodes} is {text}."
    if len(set(returns)) == 1 < len(returns):
        text += f" in each of {episodes}"
    elif len(returns) > 1 and all(abs(value) < _MAX_AVERAGED for value in returns):
        interval = interval_text(episodes_interval(returns, rng=random_streams.fixed()))
        text += f" over {episodes} ({interval} with 95 %, over episodes of this policy)"
    else:
        text += f" over {episodes}"
    if confirmation.solved is None:
        return f"{text}."
    return f"{text}, which {'solves' if confirmation.solved else 'does not solve'} the env."
