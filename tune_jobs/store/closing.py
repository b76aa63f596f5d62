"""Write the end of a run into the sweep's record, also from a thread that ends the process at once."""

from __future__ import annotations

import contextlib
import os
import time
from typing import NoReturn

from analysis.records import FINISHED
from policies.errors import TuneJobsError
from tune_jobs.store import transitions
from tune_jobs.store.contract import Sweep


def end_process(store: Sweep, last_words: str, exit_code: int, run_time_s: float) -> NoReturn:
    """Write how the run ended, as `close_run` does, print why, and end this process at once; any thread may."""
    from tune_jobs.process.streams import say_at_last

    with contextlib.suppress(TuneJobsError):
        close_run(store, run_time_s)
    say_at_last(last_words)
    os._exit(exit_code)


def close_run(store: Sweep, run_time_s: float = 0.0) -> None:
    """Write how the run ended.

    Args:
        store: The sweep.
        run_time_s: How long this run and all before it took, which stays as it is if the record says more: a driver on
            the cluster may have written it before the process that waits for it does. 0: the run had not begun.
    """
    interrupted = False
    for trial in store.read_trials():
        if trial.status not in FINISHED:
            interrupted = True
            if trial.status == "running":
                store.trial(trial.trial_id).write_record(transitions.paused(trial))
    record = store.read_record()
    store.write_record(
        record.model_copy(
            update={
                "state": "interrupted" if interrupted else "completed",
                "ended_at": time.time(),
                "run_time_s": max(record.run_time_s, run_time_s),
            }
        )
    )
