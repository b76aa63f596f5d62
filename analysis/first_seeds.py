"""The seeds that a sweep gave all of its settings, where those of several settings are looked at together."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.objectives import SettingScores
from analysis.records import SweepRecord


def first_seeds(settings: Sequence[SettingScores], sweep: SweepRecord) -> list[tuple[float, ...]]:
    """Return the scores of each setting's first seeds, as many as all settings have, and no fewer than the sweep gives.

    A race or a replication gives more to the settings that lead. With these, the leading ones would count several
    times; and within each setting, what was luck of those that lead is made up for, and the bad luck of the others,
    which is why they got no more, stays.

    Args:
        settings: Those of one sweep.
        sweep: The sweep. One that runs may have settings not all of whose first seeds have ended.
    """
    of_all = min((len(item.scores) for item in settings), default=0)
    count = max(of_all, int(sweep.spec.get("seeds_per_point") or 1))
    return [item.scores[:count] for item in settings]
