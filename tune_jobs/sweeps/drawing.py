"""Write a sweep's report; where films are made too, it is drawn meanwhile.

A child process plays the films and others encode them, for which this one only waits, and what takes longest of the
report are figures, which need no film.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from analysis.best_records import BestRecord, SettingsRecord
from analysis.records import IterationRecord, SweepRecord, TrialRecord
from policies.errors import TuneJobsError
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.candidates import read_results
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.meanwhile import check_same
from tune_jobs.sweeps.settings import judged
from tune_jobs.sweeps.status import trials_as_left

_DRAWN_WITH = (
    "jinja2", "matplotlib.figure", "matplotlib.backends.backend_svg", "matplotlib.backends.backend_pdf",
    "matplotlib.backends.backend_agg",
)  # fmt: skip
Videos = Mapping[str, Path]
_MAX_DRAWN = 3
"""How many times a report is drawn at most where the sweep goes on meanwhile."""

_importing: list[threading.Thread] = []
"""What `import_ahead` has begun."""


@dataclass(frozen=True)
class ReportMatter:
    """What a report shows, but for its films."""

    place: str
    sweep: SweepRecord
    trials: Sequence[TrialRecord]
    results: Mapping[str, Sequence[IterationRecord]]
    best: BestRecord | None
    settings: SettingsRecord | None
    why_no_best: TuneJobsError | None
    stamps: tuple[tuple[int, ...], ...] = ()
    """Those of the sweep's record and of its winner."""

    @classmethod
    def read(cls, store: Sweep, best: BestRecord | None, why_no_best: TuneJobsError | None) -> Self:
        """Read what the report of a sweep shows.

        Args:
            store: The sweep.
            best: Its winner; None: it has none.
            why_no_best: Why it has none; None: the report finds the reason in the trials.

        Raises:
            CheckpointError: A record is damaged.
        """
        from analysis.report_data import goal_of

        stamps = _stamps(store)
        with store.reading():
            record, trials, results = store.read_record(), trials_as_left(store), read_results(store)
        threshold = goal_of(record, None) if best is None else best.confirmation.threshold
        settings = judged(stored_spec(record), trials, results, threshold)
        return cls(store.place, record, trials, results, best, settings, why_no_best, stamps)

    def is_current(self, store: Sweep) -> bool:
        """Whether neither the sweep's record nor its winner was written since this was read."""
        return self.stamps == _stamps(store)

    def write(
        self, target: Path, videos: Videos | Callable[[], Videos], *, before_each: Callable[[], None] = lambda: None
    ) -> str:
        """Write the report, and return the name of its page in the folder.

        Args:
            target: The folder.
            videos: Its films, or what returns them when all else is made.
            before_each: Called before each figure is drawn; what it raises ends this.

        Raises:
            CannotRunError: A file cannot be written.
        """
        # Two threads that import parts of one package at once may see modules half done.
        for thread in _importing:
            thread.join()
        from analysis.report import build_report

        why = self.why_no_best
        page = build_report(
            self.place,
            target=target,
            sweep=self.sweep,
            trials=self.trials,
            results=self.results,
            best=self.best,
            settings=self.settings,
            why_no_best=None if why is None else (why.message, why.hint),
            videos=videos,
            before_each=before_each,
        )
        return page.relative_to(target).as_posix()


def videos_of(store: Sweep) -> Videos:
    """Return the films that the report of a sweep shows."""
    films = store.films()
    return {name: films[key] for name, key in (("before", "before_mp4"), ("after", "after_mp4")) if key in films}


def write_report(store: Sweep, best: BestRecord | None, why_no_best: TuneJobsError | None) -> Path:
    """Write a sweep's report, and return its page.

    If the process that runs the sweep writes its record or its winner meanwhile, this is drawn anew, as the page may be
    written after that of the other process.

    Args:
        store: The sweep.
        best: Its winner; None: it has none.
        why_no_best: Why it has none; None: the report finds the reason in the trials.

    Raises:
        NotFoundError: The sweep was removed since.
        CheckpointError: A record is damaged.
        CannotRunError: A file cannot be written.
    """
    matter = ReportMatter.read(store, best, why_no_best)
    for num_left in reversed(range(_MAX_DRAWN)):
        with contextlib.suppress(_OutdatedError):
            videos = functools.partial(_videos_for, matter, store, is_last=num_left == 0)
            with store.writing_report() as target:
                name = matter.write(target, videos)
            break
        check_same(store, matter.sweep)
        if store.has_best() and store.best_stamp() != matter.stamps[1]:
            best, why_no_best = store.read_best(), None
        matter = ReportMatter.read(store, best, why_no_best)
    return store.report_files()[name]


def _videos_for(matter: ReportMatter, store: Sweep, *, is_last: bool) -> Videos:
    """Return the films of a report of which only the page is missing."""
    if not is_last and not matter.is_current(store):
        raise _OutdatedError
    return videos_of(store) if matter.why_no_best is None else {}


def _stamps(store: Sweep) -> tuple[tuple[int, ...], ...]:
    return store.record_stamp(), store.best_stamp()


class _OutdatedError(Exception):
    """What a report shows was written anew."""


class _GivenUp(Exception):  # noqa: N818 (no error: nobody waits any more)
    pass


class DrawnReport:
    """The report of a sweep that has a winner, drawn in a thread; a context manager, which gives up what it lacks.

    The caller's thread alone uses the store.

    Args:
        store: The sweep.
        best: Its winner.
    """

    def __init__(self, store: Sweep, best: BestRecord) -> None:
        self._store, self._best = store, best
        self._folder = contextlib.ExitStack()
        self._given_up = threading.Event()
        self._videos: Future[Videos] = Future()
        self._name: Future[str] = Future()
        self._thread: threading.Thread | None = None
        self._matter: ReportMatter | None = None
        self._failure: TuneJobsError | None = None

    def __enter__(self) -> Self:
        try:
            matter = self._matter = ReportMatter.read(self._store, self._best, None)
            target = self._folder.enter_context(self._store.writing_report())
        except TuneJobsError as error:
            # It is told where the report is written, and is no reason to make no films.
            self._failure = error
            return self
        self._thread = threading.Thread(target=self._draw, args=(matter, target), name="tune-jobs-report", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._give_up()
        with contextlib.suppress(_GivenUp):
            # What is in the folder is not kept, unless it was written and this is left already.
            self._folder.__exit__(_GivenUp, _GivenUp(), None)

    def written(self) -> Path:
        """Let the report show the films that there are by now, write it, and return its page.

        Raises:
            TuneJobsError: It cannot be read or written.
        """
        if self._failure is not None:
            raise self._failure
        if self._matter is None or not self._matter.is_current(self._store):
            self._give_up()
            return write_report(self._store, self._store.read_best(), None)
        self._videos.set_result(videos_of(self._store))
        name = self._name.result()
        self._folder.pop_all().close()
        return self._store.report_files()[name]

    def _give_up(self) -> None:
        self._given_up.set()
        self._videos.cancel()
        if self._thread is not None:
            # As long as one figure takes.
            self._thread.join()

    def _draw(self, matter: ReportMatter, target: Path) -> None:
        try:
            self._name.set_result(matter.write(target, self._videos.result, before_each=self._go_on))
        except BaseException as error:  # noqa: BLE001 (it is raised where the report is waited for)
            self._name.set_exception(error)

    def _go_on(self) -> None:
        if self._given_up.is_set():
            raise _GivenUp


def import_ahead() -> None:
    """Import in the background what figures are drawn with, while this process waits for others.

    A report waits for it, and nothing else here imports these packages.
    """

    def load() -> None:
        # What can't be imported is an error where it is needed.
        with contextlib.suppress(Exception):
            for name in _DRAWN_WITH:
                importlib.import_module(name)

    _importing.append(threading.Thread(target=load, name="tune-jobs-imports", daemon=True))
    _importing[-1].start()
