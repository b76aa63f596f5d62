"""What the sections of a report are made from, of sweeps that look like real ones."""

from typing import Any

from synthetic_sweep import Synthetic

from analysis.best_records import SettingRecord, SettingsRecord
from analysis.page.source import Source
from analysis.report_data import goal_of


def source_of(synthetic: Synthetic, settings: SettingsRecord | None = None) -> Source:
    best = synthetic.best
    if settings is None and best is not None:
        settings = best.settings
    goal = goal_of(synthetic.sweep, best)
    return Source("sweep", synthetic.sweep, synthetic.trials, synthetic.results, best, goal, None, settings)


def setting(index: int, seeds: list[str], num_solved: int | None, **fields: Any) -> SettingRecord:
    return SettingRecord.model_validate(
        {
            "point_index": index,
            "point": {"lr": 10.0**-index},
            "trial_ids": seeds,
            "scores": [190.0 - index] * len(seeds),
            "num_failed": 0,
            "num_solved": num_solved,
            "score": 190.0 - index,
            "expected": 190.0 - index,
            "lower": 180.0,
            "upper": 200.0,
        }
        | fields
    )


def settings_of(*items: SettingRecord, num_settings: int = 9, **fields: Any) -> SettingsRecord:
    return SettingsRecord.model_validate(
        {
            "objective": "final",
            "threshold": 195.0,
            "num_settings": num_settings,
            "num_may_be_best": sum(item.may_be_best for item in items),
            "ranking": items,
        }
        | fields
    )
