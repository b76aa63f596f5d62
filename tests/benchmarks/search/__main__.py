"""`make bench-search`: what each search method finds on ARLBench's tasks; it goes on where it was interrupted.

It trains what is missing (hours), then writes the tables into docs/search-benchmark.md, between its two marks.
`--tables` trains nothing and takes the runs that are whole.
"""

from __future__ import annotations

import argparse
import os
from contextlib import closing

from tests.benchmarks.search.all_runs import run_all
from tests.benchmarks.search.confirmed_runs import CONFIRMED
from tests.benchmarks.search.kept import DATA, keep, read_runs
from tests.benchmarks.search.runs import METHODS, NUM_RUNS
from tests.benchmarks.search.same_task import AnotherTaskError, check_same_task
from tests.benchmarks.search.schedulers import SCHEDULERS
from tests.benchmarks.search.tables import tables
from tests.benchmarks.search.tasks import HERE, TASKS
from tests.benchmarks.search.trainings import Trainings
from tests.benchmarks.search.whole_runs import WholeRuns

PAGE = HERE.parents[2] / "docs" / "search-benchmark.md"
BEGIN, END = "<!-- bench-search: begin -->", "<!-- bench-search: end -->"


def write_page(lines: list[str]) -> None:
    """Put lines between the marks of the page."""
    text = PAGE.read_text()
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    PAGE.write_text(f"{before}{BEGIN}\n" + "\n".join(lines) + f"\n{END}{after}")


def main() -> None:
    """Train what is missing, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(TASKS)}; none: all")
    methods = (*METHODS, *CONFIRMED, *SCHEDULERS)
    parser.add_argument("--methods", nargs="+", choices=methods, default=methods, help="these alone")
    parser.add_argument("--runs", type=int, default=NUM_RUNS, help="of each method")
    parser.add_argument("--processes", type=int, default=2, help="how many packs train at once")
    parser.add_argument("--tables", action="store_true", help="train nothing")
    options = parser.parse_args()
    DATA.mkdir(exist_ok=True)
    # Packs use a core each, and their processes take this from here.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name in options.tasks or TASKS:
        try:
            check_same_task(TASKS[name], DATA)
        except AnotherTaskError as error:
            raise SystemExit(f"error: {error}") from None
        if not options.tables:
            choosing = [method for method in options.methods if method in (*METHODS, *CONFIRMED)]
            with closing(Trainings(TASKS[name], DATA / f"{name}.jsonl", options.processes)) as trainings:
                keep(name, run_all(TASKS[name], trainings, choosing, options.runs))
            whole = WholeRuns(TASKS[name], DATA / f"{name}.whole.jsonl", options.processes)
            looking = [method for method in options.methods if method in SCHEDULERS]
            keep(name, whole.runs(looking, options.runs))
    lines = list(tables({(task, method): read_runs(task, method) for task in TASKS for method in methods}))
    write_page(lines)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
