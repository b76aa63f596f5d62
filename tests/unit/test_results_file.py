"""Which lines of a results.jsonl are read where they contradict each other."""

import json
from pathlib import Path

import pytest
from store_parts import Reopen

from analysis.records import IterationRecord
from tune_jobs.store.contract import Sweep
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


@pytest.mark.parametrize("after", [0, 2, 4, 6])
@pytest.mark.parametrize(
    "numbers",
    [(1, 2, 10**9, 4, 5, 6), (1, 2, (3, 10**12), 4, 5, 6), (10**9, 5), (1, 2, 3, 2, 3, 4, 5), (3, (4, 1), 5), (6, 5)],
)
def test_the_iterations_after_one_are_the_same_as_of_all(
    trial: TrialStore, numbers: tuple[int | tuple[int, int], ...], after: int
) -> None:
    trial.keep_iterations(lines_of(*numbers))
    assert trial.read_iterations(after) == [record for record in trial.read_iterations() if record.iteration > after]


def test_of_the_iterations_up_to_that_one_only_the_beginning_is_read(
    trial: TrialStore, caplog: pytest.LogCaptureFixture
) -> None:
    trial.keep_iterations(lines_of(1, 2, 3, 4))
    lines = trial.results_path.read_text().splitlines()
    for index in (1, 2):
        lines[index] = lines[index].replace('"num_episodes":', "?")
    trial.results_path.write_text("\n".join([*lines, ""]))
    assert trial.read_iterations(2) == lines_of(4)
    assert ["line 3 is no result" in message for message in caplog.messages] == [True]
    assert trial.read_iterations() == lines_of(1, 4)


def test_every_store_reads_those_after_one(sweep: Sweep, another: Reopen) -> None:
    trial = sweep.trial("t0000")
    assert trial.read_iterations(2) == []
    trial.append_iterations(lines_of(1, 2, 3, 4))
    trial.settle()
    found = another().trial("t0000")
    assert found.read_iterations(2) == found.read_results(2).records == lines_of(3, 4)
    assert found.read_iterations(4) == []
    assert found.read_iterations() == lines_of(1, 2, 3, 4)
