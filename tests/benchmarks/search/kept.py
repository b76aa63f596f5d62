"""What was found of each task by each method, in a file each: a run keeps the date and the machine it was made on."""

from __future__ import annotations

import json
import platform
from collections import defaultdict
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tests.benchmarks.ppo import machine_name
from tests.benchmarks.search.runs import Run, finite
from tests.benchmarks.search.tasks import HERE

DATA = HERE / "data"
_ABOUT = ("date", "machine", "python")


def runs_file(task: str, method: str, folder: Path = DATA) -> Path:
    """Return the file of a method's runs of a task."""
    return folder / f"{task}.{method}.json"


def read_runs(task: str, method: str, folder: Path = DATA) -> dict[str, Any] | None:
    """Return what was kept of a method's runs of a task; None: nothing."""
    file = runs_file(task, method, folder)
    return json.loads(file.read_text()) if file.exists() else None


def keep(task: str, runs: Mapping[tuple[str, int], Run], folder: Path = DATA) -> None:
    """Write the runs of a task, a file a method.

    Runs that were kept and are found again stay as they are, with their date and machine. If all are, nothing is
    written: who asks for fewer runs takes none away.
    """
    for method in {name for name, _ in runs}:
        found = [_as_kept(run) for (name, _), run in sorted(runs.items(), key=lambda item: item[0]) if name == method]
        before = list((read_runs(task, method, folder) or {"runs": []})["runs"])
        now = {"date": datetime.now(UTC).date().isoformat(), "machine": machine_name()}
        now["python"] = platform.python_version()
        again = [number < len(before) and _result(before[number]) == run for number, run in enumerate(found)]
        if all(again):
            continue
        kept = [before[number] if same else {**now, **found[number]} for number, same in enumerate(again)]
        about = {"task": task, "method": method, "runs": kept}
        runs_file(task, method, folder).write_text(json.dumps(about, indent=1) + "\n")


def _as_kept(run: Run) -> dict[str, Any]:
    # As a file has it: what is read compares equal to it.
    found = {"scores": list(map(finite, run.scores)), "best": run.best, "test": finite(run.test)}
    return dict(json.loads(json.dumps(found)))


def _result(kept: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in kept.items() if name not in _ABOUT}


def made(kept: Iterable[Mapping[str, Any]]) -> str:
    """Return a sentence on when the runs of some files were made, and on which machines."""
    dates: dict[str, set[str]] = defaultdict(set)
    for file in kept:
        for run in file["runs"]:
            dates[run["machine"]].add(run["date"])
    spans = sorted((min(days), max(days), machine) for machine, days in dates.items())
    told = (f"on {machine}, {first if first == last else f'{first} to {last}'}" for first, last, machine in spans)
    return f"Made {'; '.join(told)}."
