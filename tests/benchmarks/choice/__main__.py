"""`make bench-choice`: what each way to choose a setting loses, in the tasks that were trained; it trains nothing.

It prints the tables, and writes them into docs/choice.md, between its two marks.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.choice.calibration import Calibration, by_bin, calibrate
from tests.benchmarks.choice.collecting import DATA
from tests.benchmarks.choice.named import Named, named_settings
from tests.benchmarks.choice.regret import AT_EQUAL_COST, DEFAULT, RULES, Regret, regrets
from tests.benchmarks.choice.trained import Task, read_task
from tests.benchmarks.ppo import machine_name

PAGE = Path(__file__).parents[3] / "docs" / "choice.md"
BEGIN, END = "<!-- bench-choice: begin -->", "<!-- bench-choice: end -->"
NUM_SEEDS = (5, 10)


def tables(tasks: Sequence[Task], num_draws: int) -> Iterator[str]:
    """Yield the lines of the page's tables."""
    found = {task.name: regrets(task, num_draws) for task in tasks}
    yield from _trainings(tasks)
    yield ""
    yield from _regret_table(found)
    yield ""
    yield from _verdict(found)
    yield ""
    said = {count: [calibrate(task, count, max(1, num_draws // 4)) for task in tasks] for count in NUM_SEEDS}
    named = [named_settings(task, num_draws) for task in tasks]
    yield from _coverage_table(tasks, said, named)
    yield ""
    yield from _best_table(said)


def _trainings(tasks: Sequence[Task]) -> Iterator[str]:
    yield "| task | env steps a training | settings x seeds | best, median, worst setting | trained |"
    yield "|---|---|---|---|---|"
    for task in tasks:
        means = task.evaluations[:, :, -1].mean(axis=1)
        about: dict[str, Any] = json.loads((DATA / f"{task.name}.json").read_text())
        settings, seeds = task.shape
        told = ", ".join(f"{value:.0f}" for value in (means.max(), np.median(means), means.min()))
        yield (
            f"| {task.name} | {task.num_env_steps_each:,} | {settings} x {seeds} | {told} | "
            f"{about['date']}, {about['machine']} |"
        )


def _regret_table(found: dict[str, list[Regret]]) -> Iterator[str]:
    yield f"| score of a training | seeds | trainings | {' | '.join(found)} | mean |"
    yield "|---" * (len(found) + 4) + "|"
    for index, rule in enumerate(RULES):
        row = [item[index] for item in found.values()]
        mark = "**" if rule == DEFAULT else ""
        cells = [f"{mark}{item.mean:.2f}{mark}" for item in row]
        mean = float(np.mean([item.mean for item in row]))
        trainings = float(np.mean([item.num_trainings for item in row]))
        yield f"| {rule.score} | {rule.told} | {trainings:.0f} | {' | '.join(cells)} | {mark}{mean:.2f}{mark} |"


def _verdict(found: dict[str, list[Regret]]) -> Iterator[str]:
    ours, other = RULES.index(DEFAULT), RULES.index(AT_EQUAL_COST)
    means = [float(np.mean([item[index].mean for item in found.values()])) for index in (ours, other)]
    error = max(item.standard_error for rows in found.values() for item in rows)
    yield (
        f"The default loses {means[0]:.3f} where the last training return of as many trainings loses {means[1]:.3f}: "
        f"{means[0] / means[1]:.2f} of it. By task, default less the other: "
        + ", ".join(f"{name} {rows[ours].mean - rows[other].mean:+.3f}" for name, rows in found.items())
        + f". The standard error of a cell is at most {error:.3f}."
    )


def _coverage_table(tasks: Sequence[Task], said: dict[int, list[Calibration]], named: Sequence[Named]) -> Iterator[str]:
    yield f"| 95 % intervals that hold the truth, of | {' | '.join(task.name for task in tasks)} | mean |"
    yield "|---" * (len(tasks) + 2) + "|"
    for count, found in said.items():
        cells = [f"{100 * item.coverage:.1f} %" for item in found]
        mean = 100 * float(np.mean([item.coverage for item in found]))
        yield f"| {count} seeds | {' | '.join(cells)} | {mean:.1f} % |"
    yield from _named_rows(named)


def _named_rows(named: Sequence[Named]) -> Iterator[str]:
    coverages = [item.coverage for item in named]
    cells = [f"{100 * value:.1f} %" for value in (*coverages, float(np.mean(coverages)))]
    yield f"| the setting that a launch names | {' | '.join(cells)} |"
    yield ""
    score, expected = (
        [float(values.mean()) for values in found]
        for found in zip(*((item.score_gaps, item.expected_gaps) for item in named), strict=True)
    )
    yield (
        f"The score of the setting that a launch names is {np.mean(score):.2f} of best minus median too high in the "
        f"mean ({min(score):.2f} to {max(score):.2f} by task), and what is told to be expected of more seeds "
        f"{np.mean(expected):.2f} ({min(expected):.2f} to {max(expected):.2f})."
    )


def _best_table(said: dict[int, list[Calibration]]) -> Iterator[str]:
    yield "| stated probability to be the best | " + " | ".join(f"{count} seeds" for count in said) + " |"
    yield "|---" * (len(said) + 1) + "|"
    for rows in zip(*(by_bin(found) for found in said.values()), strict=True):
        cells = [f"{100 * told:.1f} % said, {100 * so:.1f} % so ({count:,})" for _, count, told, so in rows]
        yield f"| {rows[0][0]} | {' | '.join(cells)} |"
    errors = [
        100 * float(np.average([abs(told - so) for _, count, told, so in rows if count],
                               weights=[count for _, count, _, _ in rows if count]))
        for rows in (by_bin(found) for found in said.values())
    ]  # fmt: skip
    yield "| mean difference, weighted | " + " | ".join(f"{error:.1f} points" for error in errors) + " |"


def main() -> None:
    """Print the tables, and write them into the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=1_000, help="draws of seeds a cell")
    names = sorted(path.stem for path in DATA.glob("*.parquet"))
    lines = list(tables([read_task(name) for name in names], parser.parse_args().draws))
    today = datetime.now(UTC).date().isoformat()
    lines += ["", f"Computed on {machine_name()}, {today}."]
    text = "\n".join(lines)
    print(text)
    before, _, rest = PAGE.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}")


if __name__ == "__main__":
    main()
