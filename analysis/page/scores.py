"""The scores of settings as the page shows them, one by one; `analysis.answers` says them in sentences."""

from __future__ import annotations

from analysis.best_records import SettingRecord, SettingsRecord
from analysis.wording import number, range_text, return_text

_MEANS = {
    "final": "in the later half of training",
    "area": "over all of training",
    "best": "in the best evaluation",
    "steps_to_threshold": "env steps to the threshold",
}


def score_means(settings: SettingsRecord) -> str:
    """Return what a score is about: "in the later half of training"."""
    return _MEANS.get(settings.objective, settings.objective)


def counts_env_steps(settings: SettingsRecord) -> bool:
    """Whether scores are env steps, written as negative numbers, as fewer are better."""
    return settings.objective == "steps_to_threshold"


def score_text(settings: SettingsRecord, score: float) -> str:
    """Return a score as a reader expects it."""
    return number(round(max(0.0, -score))) if counts_env_steps(settings) else return_text(score)


def interval_of(settings: SettingsRecord, item: SettingRecord) -> str | None:
    """Return the interval of a setting's score over training seeds: "185.4 to 199.0"; None: it has none."""
    if item.lower is None or item.upper is None:
        return None
    if counts_env_steps(settings):
        return f"{score_text(settings, item.upper)} to {score_text(settings, item.lower)}"
    return range_text(item.lower, item.upper)
