"""Finish a sweep whose trials have ended: choose, confirm and film the winner, and write the report."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from analysis.best_records import BestRecord
from policies.errors import EnvFailedError, TuneJobsError, said_by
from tune_jobs.process.interruption import current
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.drive import noted
from tune_jobs.sweeps.outcome import SweepResult, notes_on_best

_LOG = logging.getLogger(__name__)


def finish_sweep(store: Sweep, result: SweepResult, progress: str = "none", *, keep: bool = False) -> SweepResult:
    """Choose, confirm and film the winner, and write the report; what can't be made is noted, and raises no error.

    Args:
        store: The sweep.
        result: The trials.
        progress: Whether it is told what is done, as for `launch`.
        keep: Whether only what is missing or out of date is made: the records of a sweep that was finished before stay
            as they are, whichever machine, version or number of episodes they came from.
    """
    made = _Finish(store, progress, keep=keep)
    with noted():
        made.make_all()
    return replace(
        result,
        best=made.best,
        why_no_best=made.why_no_best,
        finish_failed=made.failed,
        artifacts=made.artifacts,
        notes=(*notes_on_best(result.sweep, made.best), *made.notes),
        interrupted=made.stopped or current().came,
    )


class _Finish:
    """Makes what comes after the trials, as far as possible."""

    def __init__(self, store: Sweep, progress: str, *, keep: bool) -> None:
        self._store = store
        self._progress = progress
        self._keep = keep
        self.best: BestRecord | None = None
        self._why: TuneJobsError | None = None
        self.artifacts: dict[str, Path] = {}
        self.notes: list[str] = []
        self.stopped = False
        """Whether another process asked to stop before everything was made."""
        self.failed = False
        """Whether no winner could be confirmed, the environment failed where it was filmed, or a library did."""

    @property
    def why_no_best(self) -> str | None:
        """Why no winner could be chosen."""
        return None if self._why is None else str(self._why)

    def make_all(self) -> None:
        """Make everything that can be made."""
        from tune_jobs.sweeps import conclude as finish
        from tune_jobs.sweeps.current_best import winner_in_best_alone
        from tune_jobs.sweeps.policy_choice import confirmed_best
        from tune_jobs.sweeps.settings import with_present_settings

        store = self._store
        if self._keep:
            self.best = confirmed_best(store)
        kept = self.best is not None
        try:
            if self.best is not None:
                self.best = with_present_settings(store, self.best)
            else:
                lost = winner_in_best_alone(store)
                with self._working("choosing the best policy") as say:
                    self.best = finish.choose_best(store, say=say)
                if lost is not None:
                    self.notes.append(
                        f"The best policy of before, {lost.trial_id} at {lost.num_env_steps:,} env steps, could not "
                        "compete, as its checkpoint is gone: best/ has another one now."
                    )
            self.artifacts["policy"] = store.best_policy_path
        except TuneJobsError as error:
            self._why = error
        self.failed = self._why is not None
        if self.best is not None and not kept:
            self._films_and_report(self.best)
            return
        if self.best is not None:
            films = dict(store.current_films())
            self.artifacts.update(films)
            if not films:
                self._film()
        page = store.current_report() if kept else None
        if page is not None:
            self.artifacts["report"] = page
        else:
            self._attempt("report", "writing the report", lambda _: {"report": finish.make_report(store, self._why)})

    def _films_and_report(self, best: BestRecord) -> None:
        """Film the winner, and draw the report meanwhile."""
        from tune_jobs.sweeps.drawing import DrawnReport

        if self._asked_to_stop():
            return
        with DrawnReport(self._store, best) as report:
            self._film()
            self._attempt("report", "writing the report", lambda _: {"report": report.written()})

    def _film(self) -> None:
        from tune_jobs.sweeps import conclude as finish
        from tune_jobs.sweeps.filming import telling_frames

        def films(say: Callable[[str], None]) -> dict[str, Path]:
            with telling_frames(say, doing):
                return finish.make_videos(self._store)

        doing = "filming the best policy"
        self._attempt("video", doing, films)

    @contextlib.contextmanager
    def _working(self, doing: str) -> Iterator[Callable[[str], None]]:
        from policies.guard.guarded import printing_to
        from tune_jobs.sweeps.live_view import working

        with contextlib.ExitStack() as stack:
            # A log that is a link, say, is no reason to make nothing: what environments print is seen then.
            with contextlib.suppress(TuneJobsError):
                stack.enter_context(printing_to(self._store.driver_log))
            yield stack.enter_context(working(self._store.name, doing, self._progress))

    def _attempt(self, what: str, doing: str, make: Callable[[Callable[[str], None]], dict[str, Path]]) -> None:
        if self._asked_to_stop():
            return
        try:
            with self._working(doing) as say:
                self.artifacts.update(make(say))
        except TuneJobsError as error:
            self.notes.append(f"No {what}: {error}")
            # Other errors are expected, as not every environment can be drawn.
            self.failed = self.failed or isinstance(error, EnvFailedError)
        except Exception as error:  # noqa: BLE001 (whatever a library raises that draws, what was trained is told)
            _LOG.exception("%s: no %s", self._store.name, what)
            self.notes.append(f"No {what}: {type(error).__name__}: {said_by(error)}.")
            self.failed = True

    def _asked_to_stop(self) -> bool:
        # Another process may have asked to stop, which ends this too.
        self.stopped = self.stopped or self._store.stop_requested()
        return self.stopped
