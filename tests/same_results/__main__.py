"""`python -m tests.same_results`: whether two versions of the program give the same results, to the bit.

For changes that are to change no result: a module moved, a function split, a loop made faster. `record` runs small
sweeps (`sweeps.py`: both engines and algorithms, their variants, every search and scheduler, a sweep that is stopped
and resumed) and writes what they give to a file; `compare` says of two such files what is equal and what is not.

    python -m tests.same_results record before.json --program /elsewhere/.venv/bin/tune-jobs
    python -m tests.same_results record after.json
    python -m tests.same_results compare before.json after.json

It knows the program by its command line and the sweep folder alone, so the program may be of any version; without
`--program` it is the one beside this Python. All sweeps take a few minutes on two cores; `--only NAME ...` runs some
of them, `--at-once 2` two at a time. What is recorded, and what is left out as it differs between two runs of the very
same program, is said in `recording.py`. Two files are worth comparing if they come from the same machine and the same
versions of torch and NumPy: other processors and libraries round differently.

Exit code 1 if something differs, or a sweep did not run as it should.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tests.same_results.comparing import compare, num_things
from tests.same_results.program import Program, ProgramError
from tests.same_results.recording import machine, record
from tests.same_results.sweeps import SWEEPS, Sweep

_BESIDE = Path(sys.executable).with_name("tune-jobs")


def _arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.same_results", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    recorder = commands.add_parser("record", help="run the sweeps and write what they give")
    recorder.add_argument("file", type=Path, help="where to")
    recorder.add_argument("--program", type=Path, default=_BESIDE, help="the tune-jobs to run (default: %(default)s)")
    recorder.add_argument("--only", nargs="+", choices=sorted(SWEEPS), metavar="NAME", help=f"of {', '.join(SWEEPS)}")
    recorder.add_argument("--at-once", type=int, default=1, metavar="N", help="sweeps at once (default: 1)")
    comparer = commands.add_parser("compare", help="say what is equal in two recordings, and what differs")
    comparer.add_argument("first", type=Path)
    comparer.add_argument("second", type=Path)
    options = parser.parse_args(arguments)
    problem = _problem(options)
    if problem is not None:
        parser.error(problem)
    return options


def _problem(options: argparse.Namespace) -> str | None:
    """What would be found out after minutes only, or by a traceback."""
    if options.command == "compare":
        missing = [str(path) for path in (options.first, options.second) if not path.is_file()]
        return f"there is no file {' and no file '.join(missing)}" if missing else None
    if options.at_once < 1:
        return "--at-once must be at least 1"
    if not os.access(options.program, os.X_OK) or options.program.is_dir():
        return f"--program {options.program} is not a program"
    return None if options.file.absolute().parent.is_dir() else f"there is no folder for {options.file}"


def record_all(program: Program, sweeps: list[Sweep], file: Path, at_once: int) -> int:
    """Run sweeps and write their recording; returns the exit code."""

    def run(sweep: Sweep) -> dict[str, Any] | None:
        started = time.monotonic()
        try:
            with tempfile.TemporaryDirectory(prefix="same-results-") as folder:
                found = record(program, sweep, Path(folder))
        except ProgramError as error:
            print(f"{sweep.name}: {error}", file=sys.stderr, flush=True)
            return None
        print(f"{sweep.name}: {num_things(found)} things, {time.monotonic() - started:.0f} s", flush=True)
        return found

    with ThreadPoolExecutor(at_once) as threads:
        recordings = dict(zip([sweep.name for sweep in sweeps], threads.map(run, sweeps), strict=True))
    whole = {name: found for name, found in recordings.items() if found is not None}
    file.write_text(json.dumps({"machine": machine(), "sweeps": whole}, indent=1) + "\n", encoding="utf-8")
    things = sum(map(num_things, whole.values()))
    print(f"{len(whole)} of {len(sweeps)} sweeps, {things} things, in {file}")
    return 0 if len(whole) == len(sweeps) else 1


def main(arguments: list[str] | None = None) -> int:
    """Run with the command line's options; returns the exit code."""
    options = _arguments(arguments)
    if options.command == "record":
        program = Program(options.program.absolute())
        return record_all(program, [SWEEPS[name] for name in options.only or SWEEPS], options.file, options.at_once)
    first, second = (json.loads(path.read_text(encoding="utf-8")) for path in (options.first, options.second))
    return compare(first, second)


if __name__ == "__main__":
    sys.exit(main())
