"""What has to be true of a sweep that was killed and resumed."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path

from policies.errors import TuneJobsError
from tune_jobs.store.manifests import verify_checkpoint
from tune_jobs.store.sweep_store import SweepStore

# All that may lie in a sweep's folder; of a checkpoint what its manifest names.
_ALLOWED = [
    r"sweep\.json|driver\.log|\.lock|\.owner",
    r"tune(/.*)?",
    r"packs",
    r"packs/p\d\d\.(json|log)|packs/\.p\d\d\.owner",
    r"best",
    r"best/(policy\.safetensors|policy\.json|evaluation\.json|before\.mp4|after\.mp4|after\.gif|before_after\.mp4)",
    r"report|report/index\.html|report/(trials|iterations|steps_to_solve)\.csv|report/figures|report/figures/[a-z_0-9]+\.(svg|png)",
    r"trials",
    r"trials/t\d{4}",
    # Half a line that a kill left is moved to results.damaged.
    r"trials/t\d{4}/(trial\.json|results\.jsonl|results\.damaged|log\.txt|\.owner|checkpoints|tensorboard)",
    r"trials/t\d{4}/tensorboard/events\.out\.tfevents\.[^/]+",
    r"trials/t\d{4}/checkpoints/\d{6}",
    r"trials/t\d{4}/checkpoints/\d{6}/manifest\.json",
]
_ALLOWED_PATTERN = re.compile("|".join(f"(?:{pattern})" for pattern in _ALLOWED))


def problems(folder: Path, num_env_steps: int, *, finishes: bool) -> list[str]:
    """What is wrong with a sweep; empty if all is well."""
    store = SweepStore(folder)
    found: list[str] = []
    try:
        found += _of_records(store)
        for trial in store.read_trials():
            found += _of_results(store.trial(trial.trial_id).results_path, num_env_steps)
            for iteration in store.trial(trial.trial_id).checkpoint_iterations():
                verify_checkpoint(store.trial(trial.trial_id).checkpoint_folder(iteration))
        if finishes:
            store.read_best()
            names = ("best/before_after.mp4", "best/after.gif", "report/index.html")
            found += [f"{name} is missing" for name in names if not (folder / name).is_file()]
        return found + _foreign(folder)
    except (TuneJobsError, OSError) as error:
        return [*found, str(error)]


def _of_records(store: SweepStore) -> list[str]:
    found = []
    state = store.read_record().state
    if state != "completed":
        found.append(f"the sweep's state is {state}")
    found += [
        f"{trial.trial_id} is {trial.status}, failed {trial.num_failures} times, notes {trial.notes}: "
        f"{(trial.error or '')[:300]}"
        for trial in store.read_trials()
        if (trial.status, trial.num_failures, trial.notes) != ("completed", 0, ())
    ]
    return found


def _of_results(path: Path, num_env_steps: int) -> list[str]:
    text = path.read_text(encoding="utf-8")
    try:
        lines = [json.loads(line) for line in text.splitlines()]
    except ValueError as error:
        return [f"{path}: {error}"]
    found = [] if text.endswith("\n") else [f"{path} ends within a line"]
    if [line["iteration"] for line in lines] != list(range(1, len(lines) + 1)):
        found.append(f"{path}: iterations {[line['iteration'] for line in lines]}")
    steps = [line["num_env_steps"] for line in lines]
    if any(after <= before for before, after in itertools.pairwise(steps)) or steps[-1] < num_env_steps:
        found.append(f"{path}: env steps {steps}")
    return found


def _foreign(folder: Path) -> list[str]:
    belonging = set()
    for manifest in folder.glob("trials/*/checkpoints/*/manifest.json"):
        for name in json.loads(manifest.read_text(encoding="utf-8"))["files"]:
            path = manifest.parent / name
            belonging |= {path, *path.parents}
    return [
        f"{path.relative_to(folder)} does not belong there"
        for path in sorted(folder.rglob("*"))
        if path not in belonging and not _ALLOWED_PATTERN.fullmatch(path.relative_to(folder).as_posix())
    ]
