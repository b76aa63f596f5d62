"""Ask the drivers of running sweeps to save and end, as the service does."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
from pathlib import Path

from policies.errors import TuneJobsError
from tune_jobs.service.job_files import JobFiles, begun_jobs

_log = logging.getLogger(__name__)


class Draining:
    """Asks each driver once, as the files of jobs say which there are.

    The queue isn't asked for them: a database that is ended together with the service says nothing, and its sweeps have
    to save all the same.

    Args:
        folder: The service's folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._asked: set[str] = set()

    def ask(self) -> bool:
        """Ask the drivers that were not asked yet; return whether any runs."""
        any_runs = False
        for files in begun_jobs(self._folder):
            # A lock that can't be read keeps no other sweep from being saved.
            with contextlib.suppress(TuneJobsError):
                if files.is_run():
                    any_runs = True
                    self._ask(files)
        return any_runs

    def _ask(self, files: JobFiles) -> None:
        holder = files.holder()
        if holder is None or files.uid in self._asked:
            return
        self._asked.add(files.uid)
        if not files.is_open_in(holder.pid):
            _log.warning(
                "The driver of sweep %s can't be asked to save: process %d is another one here. It runs on.",
                holder.sweep, holder.pid, extra={"sweep": holder.sweep},
            )  # fmt: skip
            return
        with contextlib.suppress(OSError):
            # Not SIGTERM, as systemd may have sent that to all: a second one would end the trials before they save.
            os.kill(holder.pid, signal.SIGHUP)
