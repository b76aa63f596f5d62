"""The learning curves of a sweep's trials in columns, kept up with what is appended to their results."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from math import isnan, nan
from typing import TypedDict

from analysis.records import IterationRecord
from policies.errors import CheckpointError
from tune_jobs.store.candidates import leave_out
from tune_jobs.store.contract import Sweep
from tune_jobs.store.results_tail import CurvePoint, ResultsMark

MAX_POINTS = 4_000_000
"""Points of all curves of a sweep that are kept in memory, 32 bytes each."""
_LEAST_POINTS = 64
_MOST_NEW_POINTS = 1_000


class Columns(TypedDict):
    """Points of one trial's curve, oldest first."""

    iteration: Sequence[int]
    num_env_steps: Sequence[int]
    training_return: Sequence[float | None]
    evaluation_return: Sequence[float | None]


class NewRows(Columns):
    """Points that came to one trial's curve."""

    after: int
    """The iteration that they follow: points that were known of later ones are no more."""


class Curve:
    """One trial's curve."""

    def __init__(self) -> None:
        self.mark = ResultsMark()
        self._iteration, self._num_env_steps = array("q"), array("q")
        self._training, self._evaluation = array("d"), array("d")

    def __len__(self) -> int:
        return len(self._iteration)

    @property
    def last_iteration(self) -> int:
        """The last iteration that it has; 0: none."""
        return self._iteration[-1] if self._iteration else 0

    def clear(self) -> None:
        """Remove all points."""
        self._keep([])

    def append(self, points: Iterable[CurvePoint | IterationRecord]) -> None:
        """Add points behind the others."""
        for point in points:
            self._iteration.append(point.iteration)
            self._num_env_steps.append(point.num_env_steps)
            self._training.append(nan if point.training_return is None else point.training_return)
            self._evaluation.append(nan if point.evaluation_return is None else point.evaluation_return)

    def thin(self, most: int) -> None:
        """Leave out points until there are at most so many."""
        self._keep(self._chosen(most))

    def columns(self, most: int) -> Columns:
        """Return at most so many points, at least two: the ends, the highest evaluation, and others between them."""
        chosen = self._chosen(most)
        return Columns(
            iteration=[self._iteration[index] for index in chosen],
            num_env_steps=[self._num_env_steps[index] for index in chosen],
            training_return=[_or_none(self._training[index]) for index in chosen],
            evaluation_return=[_or_none(self._evaluation[index]) for index in chosen],
        )

    def _keep(self, chosen: Sequence[int]) -> None:
        self._iteration = array("q", [self._iteration[index] for index in chosen])
        self._num_env_steps = array("q", [self._num_env_steps[index] for index in chosen])
        self._training = array("d", [self._training[index] for index in chosen])
        self._evaluation = array("d", [self._evaluation[index] for index in chosen])

    def _chosen(self, most: int) -> Sequence[int]:
        """Return the indices of at most `most` points, half of them of evaluations, which most iterations have not."""
        count = len(self)
        if count <= most:
            return range(count)
        evaluated = [index for index in range(count) if not isnan(self._evaluation[index])]
        chosen = set(_spread(evaluated, max(0, most // 2 - 1)))
        if evaluated and most > 2:
            chosen.add(max(evaluated, key=self._evaluation.__getitem__))
        chosen |= set(_spread(range(count), most - len(chosen)))
        return sorted(chosen)


class Curves:
    """The curves of a sweep's trials.

    Args:
        sweep: The sweep.
        max_points: How many points are kept of all curves together; of longer ones some are left out.
    """

    def __init__(self, sweep: Sweep, max_points: int = MAX_POINTS) -> None:
        self._sweep, self._max_points = sweep, max_points
        self._curves: dict[str, Curve] = {}

    def update(self, trial_ids: Iterable[str]) -> dict[str, NewRows]:
        """Read what was appended to the results of some trials.

        Returns:
            The new points of those that have any; trials whose results can't be read are left out with a warning.
        """
        found = {}
        for trial_id in trial_ids:
            curve = self._curves.setdefault(trial_id, Curve())
            try:
                new = self._sweep.trial(trial_id).read_new_points(curve.mark)
            except CheckpointError as error:
                leave_out(error)
                continue
            curve.mark = new.mark
            if not new.points and not new.replaced:
                continue
            after = 0 if new.replaced else curve.last_iteration
            if new.replaced:
                curve.clear()
            curve.append(new.points)
            found[trial_id] = _rows(after, new.points)
            room = max(_LEAST_POINTS, self._max_points // len(self._curves))
            if len(curve) > room:
                curve.thin(room // 2)
        return found

    def columns(self, most: int) -> dict[str, Columns]:
        """Return at most so many points of each trial that has any."""
        return {trial_id: curve.columns(most) for trial_id, curve in sorted(self._curves.items()) if len(curve)}


def _rows(after: int, points: Iterable[CurvePoint]) -> NewRows:
    curve = Curve()
    curve.append(points)
    return NewRows(after=after, **curve.columns(_MOST_NEW_POINTS))


def _spread(items: Sequence[int], count: int) -> Iterable[int]:
    """Return so many of some items, at equal distances, the ends among them."""
    if len(items) <= count:
        return items
    if count < 2:
        return items[-count:] if count else ()
    return (items[round(number * (len(items) - 1) / (count - 1))] for number in range(count))


def _or_none(value: float) -> float | None:
    return None if isnan(value) else value
