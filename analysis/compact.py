"""The iterations of a sweep's trials, in a small part of the memory that their records take.

A record takes some 3.5 kB, most of it for the names of its values and for Python's numbers, and a thousand trials may
have a million of them. Their values alone are kept, as bytes, and made again trial by trial.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import starmap
from operator import attrgetter
from typing import Any, NamedTuple, Self, cast

from analysis.records import IterationRecord

_FEW = 100_000
"""So many iterations, without what is seldom asked for, take some 40 MB when they are made."""


class _Row(NamedTuple):
    """An iteration to whoever reads one: what an `IterationRecord` holds, which takes several times as long to make."""

    iteration: int
    num_env_steps: int
    num_episodes: int
    time_s: float
    waited_s: float
    training_return: float | None
    evaluation_return: float | None
    episode_returns: tuple[float, ...]
    episode_lengths: tuple[int, ...] = ()
    learner: Mapping[str, float | None] = {}

    def model_copy(self, *, update: Mapping[str, Any]) -> Self:
        """Return it with other values, as a record does."""
        return self._replace(**update)


_SELDOM = ("episode_lengths", "learner")
"""The values, the last of a row, of which half of the bytes are and that tables and figures hardly ask for."""
_often, _seldom = attrgetter(*(name for name in _Row._fields if name not in _SELDOM)), attrgetter(*_SELDOM)


class CompactResults(Mapping[str, Sequence[IterationRecord]]):
    """Iterations by trial id. Those of a trial are made whenever it is looked up, unless it was the last one.

    Who looks up all trials needs little memory only by holding the iterations of one at a time.

    Args:
        results: The ids of trials and their iterations, which are asked for one by one.
    """

    def __init__(self, results: Iterable[tuple[str, Iterable[IterationRecord]]]) -> None:
        self._often: dict[str, bytes] = {}
        self._seldom: dict[str, bytes] = {}
        self._num_iterations = 0
        self._last: tuple[str, Sequence[IterationRecord]] | None = None
        for trial_id, items in results:
            records = list(items)
            self._often[trial_id] = pickle.dumps(list(map(_often, records)))
            self._seldom[trial_id] = pickle.dumps(list(map(_seldom, records)))
            self._num_iterations += len(records)

    def __getitem__(self, trial_id: str) -> Sequence[IterationRecord]:
        last = self._last
        if last is None or last[0] != trial_id:
            self._last = last = trial_id, self._made(trial_id)
        return last[1]

    def __iter__(self) -> Iterator[str]:
        return iter(self._often)

    def __len__(self) -> int:
        return len(self._often)

    def _made(self, trial_id: str) -> Sequence[IterationRecord]:
        values = pickle.loads(self._often[trial_id])  # noqa: S301 (our own)
        if self._seldom:
            more = pickle.loads(self._seldom[trial_id])  # noqa: S301 (our own)
            values = [one + other for one, other in zip(values, more, strict=True)]
        return cast("Sequence[IterationRecord]", tuple(starmap(_Row, values)))

    def lean(self) -> Mapping[str, Sequence[IterationRecord]]:
        """Return the iterations without their `learner` and `episode_lengths`, for many looks at all of them."""
        found = CompactResults(())
        found._often, found._num_iterations = self._often, self._num_iterations
        return dict(found.items()) if self._num_iterations <= _FEW else found


def lean(results: Mapping[str, Sequence[IterationRecord]]) -> Mapping[str, Sequence[IterationRecord]]:
    """Return compact results as `CompactResults.lean` has them, and others as they are."""
    return results.lean() if isinstance(results, CompactResults) else results
