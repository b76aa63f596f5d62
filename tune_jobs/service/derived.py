"""What is made of all results of sweeps, which takes seconds: once for all who ask, and anew when they changed."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from weakref import ReferenceType, ref

from tune_jobs.service.busy import held
from tune_jobs.service.statuses import Seen, Statuses, Trials
from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.sweeps.plain import to_json
from tune_jobs.sweeps.status import SweepStatus

if TYPE_CHECKING:
    from analysis.comparison.compare import Comparison
    from analysis.front_view import FrontView
    from analysis.importance import WhatMattered
    from analysis.records import Objective
    from tune_jobs.sweeps.side_by_side import SideBySide

_SHARE = 0.1
"""The share of a core that making one thing anew of a running sweep takes."""
_MOST_KEPT = 64
_MOST_BYTES = 256 * 2**20
"""What is kept of all, besides the last, which may be larger; a sweep as one file has at most so many."""
_BYTES_OF_JSON = 8
"""What one character of JSON takes as objects, about."""


_Key = tuple[str, tuple[tuple[str, float], ...]]
"""What it is, and of which sweeps: one of the same name that was created at another time is another one."""


@dataclass(frozen=True)
class _Made:
    of: tuple[tuple[ReferenceType[Trials], ReferenceType[SweepStatus]], ...]
    """What each sweep was like; not to keep all its trials, of which `Statuses` has those of now."""
    value: Any
    num_bytes: int
    at: float
    took_s: float


class Derived:
    """Makes and keeps such things; threads may share it.

    Args:
        storage: The sweeps.
        statuses: What they look like.
        clock: A monotonic clock, in seconds.
    """

    def __init__(self, storage: Storage, statuses: Statuses, clock: Callable[[], float] = time.monotonic) -> None:
        self._storage, self._statuses, self._clock = storage, statuses, clock
        self._made: dict[_Key, _Made] = {}
        # Held for as long as it takes to look; what is kept has to wait for nothing that is being made.
        self._lock = threading.Lock()
        # One at a time: two at once would take as long, and twice the memory.
        self._making = threading.Lock()

    def importance(self, name: str) -> WhatMattered:
        """Say which hyperparameters a sweep's scores depend on, as of a while ago if it runs.

        Raises:
            NotFoundError: There is no such sweep, or it is damaged.
        """
        from tune_jobs.sweeps.results import importance_of

        found: WhatMattered = self._get(name, "importance", importance_of)
        return found

    def front(self, name: str) -> FrontView:
        """Set a sweep's settings against their cost, as of a while ago if it runs.

        Raises:
            NotFoundError: There is no such sweep, or it is damaged.
        """
        from tune_jobs.sweeps.results import front_view_of

        found: FrontView = self._get(name, "front", front_view_of)
        return found

    def trials_csv(self, name: str) -> str:
        """Return the table of a sweep's trials as CSV, as of a while ago if it runs.

        Raises:
            NotFoundError: There is no such sweep, or it is damaged.
        """
        from tune_jobs.sweeps.exports import trials_csv

        text: str = self._get(name, "trials.csv", trials_csv)
        return text

    def comparison(self, names: Sequence[str]) -> SideBySide:
        """Put sweeps side by side, as of a while ago if any of them runs.

        Raises:
            NotFoundError: There is no such sweep, or it is damaged.
            SpecError: They can't be compared.
        """
        from tune_jobs.sweeps import side_by_side

        for name in names:
            self._statuses.see(name)
        side_by_side.check_comparable([self._storage.sweep(name) for name in names])
        found: SideBySide = self._get_of(names, "comparison", side_by_side.side_by_side)
        return found

    def compared(self, sources: Sequence[tuple[str, str | None]], objective: Objective | None, top: int) -> Comparison:
        """Compare sweeps or settings of sweeps, as of a while ago if any of them runs.

        Args:
            sources: Each a sweep's name, and the id of one of its trials; None: the sweep.
            objective: What all are judged by; None: what their sweep files say.
            top: How many settings are compared of a sweep that is named alone.

        Raises:
            NotFoundError: There is no such sweep or trial, or it is damaged.
            SpecError: They can't be compared.
        """
        from tune_jobs.sweeps.compare import compared

        names = list(dict.fromkeys(name for name, _ in sources))

        def make(sweeps: Sequence[Sweep]) -> Comparison:
            known = dict(zip(names, sweeps, strict=True))
            return compared([(known[name], trial_id) for name, trial_id in sources], objective, top)[0]

        found: Comparison = self._get_of(names, f"compared {json.dumps([sources, objective, top])}", make)
        return found

    def sweep_file(self, name: str) -> bytes:
        """Return a sweep as one file, as of a while ago if it runs.

        Raises:
            NotFoundError: There is no such sweep, or it is damaged.
            SpecError: There is more of it than a reader takes.
        """
        from tune_jobs.sweeps.sweep_file import sweep_file

        content: bytes = self._get(name, "file", sweep_file)
        return content

    def records(self, name: str) -> bytes:
        """Return the records of a sweep's trials with the checkpoints that may be chosen, as a JSON list.

        They are as of a while ago if it runs.

        Raises:
            NotFoundError: There is no such sweep, or it is damaged.
        """
        from tune_jobs.sweeps.status import trials_as_left

        def records_of(sweep: Sweep) -> bytes:
            return b"[%s]" % b",".join(record.model_dump_json().encode() for record in trials_as_left(sweep))

        found: bytes = self._get(name, "records", records_of)
        return found

    def _get(self, name: str, what: str, make: Callable[[Sweep], Any]) -> Any:
        return self._get_of((name,), what, lambda sweeps: make(*sweeps))

    def _get_of(self, names: Sequence[str], what: str, make: Callable[[Sequence[Sweep]], Any]) -> Any:
        _, _, known = self._look(names, what)
        if known is None:
            with held(self._making):
                # Looked at again, as one may have waited here for long.
                seen, key, known = self._look(names, what)
                if known is None:
                    known = self._make(names, seen, key, make)
        return known.value

    def _look(self, names: Sequence[str], what: str) -> tuple[Sequence[Seen], _Key, _Made | None]:
        """Return what sweeps are like, how it is kept, and what is kept if it may still be told."""
        seen, now = [self._statuses.see(name) for name in names], self._clock()
        key = (what, tuple((one.name, one.status.sweep.created_at) for one in seen))
        with self._lock:
            known = self._made.get(key)
            if known is None or not _may_be_told(known, seen, now):
                return seen, key, None
            # The last is the one that somebody has asked for.
            self._made[key] = self._made.pop(key)
            return seen, key, known

    def _make(
        self, names: Sequence[str], seen: Sequence[Seen], key: _Key, make: Callable[[Sequence[Sweep]], Any]
    ) -> _Made:
        with self._lock:
            # Nobody needs the memory of what it was before.
            self._made.pop(key, None)
        now = self._clock()
        value = make([self._storage.sweep(name) for name in names])
        took_s = self._clock() - now
        of = tuple((ref(one.trials), ref(one.status)) for one in seen)
        made = _Made(of, value, _num_bytes(value), now, took_s)
        with self._lock:
            self._made[key] = made
            while len(self._made) > _MOST_KEPT or (len(self._made) > 1 and self._num_bytes() > _MOST_BYTES):
                # The first is the one that nobody has asked for the longest.
                del self._made[next(iter(self._made))]
        return made

    @property
    def num_bytes(self) -> int:
        """About how many bytes are kept."""
        with self._lock:
            return self._num_bytes()

    def _num_bytes(self) -> int:
        return sum(made.num_bytes for made in self._made.values())


def _may_be_told(made: _Made, seen: Sequence[Seen], now: float) -> bool:
    is_of_now = all(
        trials() is one.trials and status() is one.status for one, (trials, status) in zip(seen, made.of, strict=True)
    )
    runs = any(not one.is_over for one in seen)
    return is_of_now or (runs and now - made.at < made.took_s / _SHARE)


def _num_bytes(value: Any) -> int:
    if isinstance(value, bytes | str):
        return len(value)
    return _BYTES_OF_JSON * len(json.dumps(to_json(value)))
