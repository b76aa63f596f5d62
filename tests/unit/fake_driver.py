"""A driver process whose sweeps take a moment and train nothing; all else is the real one's."""

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tune_jobs.service import driver
from tune_jobs.store.sweep_store import SweepStore

JOURNAL = "journal.jsonl"


def main(descriptor: int) -> None:
    """Do what the real driver does, with a sweep that only waits."""
    driver.warm_up = lambda stack, settings: None
    driver._done = _done
    driver.main(descriptor)


def _done(request: Mapping[str, Any]) -> Any:
    """Hold the sweep's lock for as long as its spec says, and note when that begins and ends."""
    store = SweepStore(Path(request["sweep"]))
    told = {"sweep": store.name, "pid": os.getpid(), "verb": request["verb"]}
    with store.lock():
        store.clear_stop_request()
        record = store.read_record()
        how = record.spec["hyperparams"]
        _note(store, told | {"what": "begin"})
        store.write_record(record.model_copy(update={"state": "running"}))
        if how.get("exit"):
            os._exit(3)
        until, interrupted = time.monotonic() + float(how.get("seconds", 0.05)), False
        while time.monotonic() < until and not interrupted:
            time.sleep(0.01)
            interrupted = store.stop_requested()
        if how.get("error"):
            raise ValueError(how["error"])
        store.clear_stop_request()
        state = "interrupted" if interrupted else "completed"
        store.write_record(record.model_copy(update={"state": state}))
        _note(store, told | {"what": "stopped" if interrupted else "end"})
    return SimpleNamespace(
        interrupted=interrupted, trials=[], notes=(), why_no_best=None, finish_failed=bool(how.get("finish_failed"))
    )


def _note(store: SweepStore, line: Mapping[str, Any]) -> None:
    with (store.folder.parent / ".service" / JOURNAL).open("a") as file:
        file.write(json.dumps(line) + "\n")
