"""The iterations of a trial, in about a tenth of the memory that their records take.

A record takes some 3.5 kB, most of it for the names of its values and for Python's numbers, and a thousand trials may
have a million of them. Here are the bare numbers, one column behind the other.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate, chain, repeat
from typing import Any, cast, overload

from analysis.records import IterationRecord


class CompactIterations(Sequence[IterationRecord]):
    """The iterations of one trial, oldest first.

    Each is made when it is asked for. It has the fields of a record and its `model_copy`, and no more of pydantic.

    Args:
        records: The iterations.
    """

    def __init__(self, records: Iterable[IterationRecord]) -> None:
        items = list(records)
        self.iteration: Sequence[int] = _column("q", [item.iteration for item in items])
        self.num_env_steps: Sequence[int] = _column("q", [item.num_env_steps for item in items])
        self.num_episodes: Sequence[int] = _column("q", [item.num_episodes for item in items])
        self.time_s: Sequence[float] = _column("d", [item.time_s for item in items])
        self.waited_s: Sequence[float] = _column("d", [item.waited_s for item in items])
        self.training_return: Sequence[float | None] = _column("d", [item.training_return for item in items])
        self.evaluation_return: Sequence[float | None] = _column("d", [item.evaluation_return for item in items])
        self.episode_returns = _Tuples("d", [item.episode_returns for item in items])
        self.episode_lengths = _Tuples("i", [item.episode_lengths for item in items])
        self.learner_values = _Tuples("d", [tuple(item.learner.values()) for item in items])
        # The same ones again and again, of which one is kept.
        known: dict[tuple[str, ...], tuple[str, ...]] = {}
        self.learner_names = [known.setdefault(names, names) for names in (tuple(item.learner) for item in items)]

    def __len__(self) -> int:
        return len(self.iteration)

    def __iter__(self) -> Iterator[IterationRecord]:
        return cast("Iterator[IterationRecord]", map(_Iteration, repeat(self), range(len(self))))

    @overload
    def __getitem__(self, index: int) -> IterationRecord: ...

    @overload
    def __getitem__(self, index: slice) -> list[IterationRecord]: ...

    def __getitem__(self, index: int | slice) -> IterationRecord | list[IterationRecord]:
        places = range(len(self))[index]
        if isinstance(places, int):
            return cast("IterationRecord", _Iteration(self, places))
        return cast("list[IterationRecord]", [_Iteration(self, place) for place in places])


class _Iteration:
    """What an `IterationRecord` says, looked up: to make one takes longer than what most do with it."""

    __slots__ = ("_at", "_of")

    def __init__(self, of: CompactIterations, at: int) -> None:
        self._of, self._at = of, at

    @property
    def iteration(self) -> int:
        return self._of.iteration[self._at]

    @property
    def num_env_steps(self) -> int:
        return self._of.num_env_steps[self._at]

    @property
    def num_episodes(self) -> int:
        return self._of.num_episodes[self._at]

    @property
    def time_s(self) -> float:
        return self._of.time_s[self._at]

    @property
    def waited_s(self) -> float:
        return self._of.waited_s[self._at]

    @property
    def training_return(self) -> float | None:
        return self._of.training_return[self._at]

    @property
    def evaluation_return(self) -> float | None:
        return self._of.evaluation_return[self._at]

    @property
    def episode_returns(self) -> tuple[float, ...]:
        return self._of.episode_returns[self._at]

    @property
    def episode_lengths(self) -> tuple[int, ...]:
        return self._of.episode_lengths[self._at]

    @property
    def learner(self) -> dict[str, float | None]:
        return dict(zip(self._of.learner_names[self._at], self._of.learner_values[self._at], strict=True))

    def model_copy(self, *, update: dict[str, Any]) -> IterationRecord:
        """Return it as a record, with other values."""
        known = {name: getattr(self, name) for name in IterationRecord.model_fields}
        return IterationRecord.model_construct(**known | update)


class _Tuples:
    """A tuple of numbers for each iteration.

    Args:
        kind: As for `_column`.
        tuples: The tuples.
    """

    def __init__(self, kind: str, tuples: Sequence[tuple[Any, ...]]) -> None:
        self._numbers = _column(kind, list(chain.from_iterable(tuples)))
        self._ends = array("q", accumulate(map(len, tuples), initial=0))

    def __getitem__(self, at: int) -> tuple[Any, ...]:
        return tuple(self._numbers[self._ends[at] : self._ends[at + 1]])


def _column(kind: str, values: Sequence[Any]) -> Sequence[Any]:
    """Return values as an array of a kind, or as a tuple where one is none of it, as None or an enormous length is."""
    try:
        return array(kind, values)
    except (TypeError, OverflowError):
        return tuple(values)
