"""All runs of the methods that choose points, side by side, so that their trainings share packs."""

from __future__ import annotations

from collections.abc import Sequence

from tests.benchmarks.search import confirmed_runs, runs
from tests.benchmarks.search.tasks import Task
from tests.benchmarks.search.trainings import Trainings


def run_all(
    task: Task, trainings: Trainings, methods: Sequence[str], num_runs: int = runs.NUM_RUNS
) -> dict[tuple[str, int], runs.Run]:
    """Run every method as often as is asked, all side by side, and return what each run found."""
    running = {
        (method, number): (confirmed_runs.run if method in confirmed_runs.CONFIRMED else runs.run)(task, method, number)
        for method in methods
        for number in range(num_runs)
    }
    wanted = {name: next(generator) for name, generator in running.items()}
    done: dict[tuple[str, int], runs.Run] = {}
    while wanted:
        made = trainings.returns([item for items in wanted.values() for item in items])
        answers = {name: [next(made) for _ in items] for name, items in wanted.items()}
        wanted = {}
        for name, returns in answers.items():
            try:
                wanted[name] = running[name].send(returns)
            except StopIteration as end:
                done[name] = end.value
        print(f"{task.name}: {len(trainings)} trainings, {len(done)} of {len(running)} runs ended", flush=True)
    return done
