"""Sees to it that what was trained is not taken for trainings of another task than that of its time.

Trainings are found again by their points and seeds; that they are of one environment, length and fixed hyperparameters
is told by the task file alone, which anybody may edit.
"""

from __future__ import annotations

import json
from pathlib import Path

import yaml

from tests.benchmarks.search.tasks import Task


class AnotherTaskError(Exception):
    """The data are of another task than the task file's."""


def check_same_task(task: Task, folder: Path) -> None:
    """Keep what a task file says beside its data, and check that data which are there are of the same.

    Args:
        task: The task.
        folder: Where the data are kept.

    Raises:
        AnotherTaskError: They are of another; says of which fields.
    """
    kept = folder / f"{task.name}.task.json"
    now = yaml.safe_load(task.file.read_text())
    del now["about"]
    if not kept.exists():
        kept.write_text(json.dumps(now, indent=1) + "\n")
        return
    before = json.loads(kept.read_text())
    other = [f"{name} is {now.get(name)}, was {before.get(name)}" for name in sorted(before.keys() | now.keys())
             if before.get(name) != now.get(name)]  # fmt: skip
    if other:
        raise AnotherTaskError(
            f"{task.file.name} is not what {folder / task.name}.* were trained with: {'; '.join(other)}. "
            "Set it back, or remove these files to train anew."
        )
