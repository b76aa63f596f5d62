"""Which lines of a results.jsonl are read where they contradict each other."""

import json
from pathlib import Path

import pytest

from analysis.records import IterationRecord
from tune_jobs.store.trial_store import TrialStore


@pytest.fixture
def trial(tmp_path: Path) -> TrialStore:
    return TrialStore(tmp_path, "t0000")


def lines_of(*numbers: int | tuple[int, int]) -> list[IterationRecord]:
    """Lines of these iterations; of a pair the second is the env steps."""
    pairs = [number if isinstance(number, tuple) else (number, 100 * number) for number in numbers]
    return [
        IterationRecord(iteration=iteration, num_env_steps=steps, num_episodes=iteration, time_s=1.0)
        for iteration, steps in pairs
    ]


@pytest.mark.parametrize(
    ("numbers", "bad", "reason"),
    [
        ((1, 2, 10**9, 4, 5, 6), [3], "contradicts the lines after it"),
        ((1, 2, (3, 10**12), 4, 5, 6), [3], "contradicts the lines after it"),
        (((10**9, 1), 2, 3), [1], "contradicts the lines after it"),
        ((1, 2, 3, 1, 4), [4], "does not follow iteration 3"),
        ((1, 2, (3, 7), 4), [3], "does not follow iteration 2"),
        ((1, 2, 3, 2, 3, 4), [4, 5], "does not follow iteration 3"),
        ((1, 2, 2, 3), [3], "does not follow iteration 2"),
        ((3, 2, 1), [2, 3], "does not follow iteration 3"),
    ],
)
def test_of_lines_that_contradict_each_other_the_fewest_are_left_out(
    trial: TrialStore,
    caplog: pytest.LogCaptureFixture,
    numbers: tuple[int | tuple[int, int], ...],
    bad: list[int],
    reason: str,
) -> None:
    records = lines_of(*numbers)
    trial.keep_iterations(records)
    assert trial.read_iterations() == [record for number, record in enumerate(records, 1) if number not in bad]
    assert [f"line {number} {reason}" in message for number, message in zip(bad, caplog.messages, strict=True)] == [
        True for _ in bad
    ]


@pytest.mark.parametrize("field", ["iteration", "num_env_steps", "num_episodes"])
def test_counts_in_results_are_not_negative(trial: TrialStore, caplog: pytest.LogCaptureFixture, field: str) -> None:
    trial.keep_iterations(lines_of(1, 2, 3))
    first, *others = trial.results_path.read_text().splitlines()
    trial.results_path.write_text("\n".join([json.dumps(json.loads(first) | {field: -1}), *others, ""]))
    assert trial.read_iterations() == lines_of(2, 3)
    assert "line 1 is no result" in caplog.text
