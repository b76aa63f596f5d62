"""Ray Tune's median stopping rule, in a time that does not grow with all evaluations of a sweep."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from typing import Any

import numpy as np
from ray.tune.schedulers import MedianStoppingRule
from typing_extensions import override


class MedianStopping(MedianStoppingRule):  # type: ignore[misc]
    """Ray's rule, with equal decisions: the means that it compares are the same floats, and each is found once.

    At each evaluation Ray's goes through all those of every trial that has come as far. Private members of it
    are used (2.60): `_results`, what was reported of each trial, to which it only appends, `_running_mean`, and its
    settings `_grace_period`, `_time_attr` and `_metric`.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self._curves: dict[Any, _Curve] = {}

    @override
    def _running_mean(self, trial: Any, time: float) -> Any:
        curve = self._curves.get(trial)
        if curve is None:
            curve = self._curves[trial] = _Curve(self._grace_period)
        for result in self._results[trial][curve.num_known :]:
            curve.add(result[self._time_attr], result[self._metric])
        return curve.mean_until(time) if curve.is_in_order else super()._running_mean(trial, time)


class _Curve:
    """The scores of a trial, and the means of their beginnings.

    Args:
        begin: The time from which scores count.
    """

    def __init__(self, begin: float) -> None:
        self._begin = begin
        self._times: list[float] = []
        self._scores = array("d")
        self._means: dict[int, Any] = {}
        self.is_in_order = True
        """Whether times never fall; those of a trial that was retried from a checkpoint may."""

    @property
    def num_known(self) -> int:
        """How many scores were added."""
        return len(self._times)

    def add(self, time: float, score: float) -> None:
        """Add the next score."""
        self.is_in_order = self.is_in_order and (not self._times or time >= self._times[-1])
        self._times.append(time)
        self._scores.append(score)

    def mean_until(self, time: float) -> Any:
        """Return the mean of the scores up to a time, as NumPy sums them up; nan: there is none."""
        end = bisect_right(self._times, time)
        if end not in self._means:
            first = bisect_left(self._times, self._begin)
            self._means[end] = np.frombuffer(self._scores)[first:end].mean() if first < end else np.nan
        return self._means[end]
