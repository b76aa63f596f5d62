"""`python -m tests.learning`: train the presets over several seeds and hold their scores against the targets.

Exit code 1 if a target is missed. Presets that do not exist, or whose environment is not installed, are skipped with
the reason.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from policies.errors import EnvError
from tests.learning.measure import measure, to_json, verdict
from tests.learning.table import markdown, row, show
from tests.learning.targets import tasks
from tune_jobs.spec.file import list_presets


def _arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.learning", description=__doc__)
    parser.add_argument("--preset", action="append", default=[], help="only this one; may be repeated")
    parser.add_argument("--seeds", type=int, default=5, help="training seeds of each preset")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers there")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table there")
    parser.add_argument("--storage", type=Path, metavar="FOLDER", help="keep the sweeps there")
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error("--seeds must be at least 1")
    return options


def run(options: argparse.Namespace, storage: Path) -> int:
    """Train, print and write; returns the exit code."""
    todo, skipped = tasks({preset.name for preset in list_presets()}, tuple(options.preset))
    for name, reason in skipped.items():
        print(f"{name}: skipped, {reason}", flush=True)
    rows, documents, passed = [], [], True
    for task in todo:
        print(f"{task.preset}: training {options.seeds} seeds ...", flush=True)
        found, reason = None, ""
        try:
            found = measure(task, options.seeds, storage)
        except EnvError as error:
            if "Install" not in error.hint:  # the preset itself is wrong
                raise
            reason = str(error)
            print(f"{task.preset}: skipped, it cannot run here: {reason}", flush=True)
        else:
            fine, word = verdict(task, found)
            passed &= fine
            print(f"{task.preset}: {word}", flush=True)
        rows.append(row(task, found))
        documents.append(to_json(task, found, reason))
        # After each preset: all of them take long.
        if options.json is not None:
            options.json.write_text(json.dumps(documents, indent=2) + "\n", encoding="utf-8")
        if options.markdown is not None:
            options.markdown.write_text(markdown(rows) + "\n", encoding="utf-8")
    show(rows, options.seeds)
    return 0 if passed else 1


def main(arguments: list[str] | None = None) -> int:
    """Run with the command line's options."""
    options = _arguments(arguments)
    try:
        if options.storage is not None:
            return run(options, options.storage)
        with tempfile.TemporaryDirectory() as folder:
            return run(options, Path(folder))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
