"""The table of trials: which columns a terminal of some width shows, and in which order the trials come."""

import io
from typing import Any

import pytest
from fake_sweeps import FakeSweeps, RunCommand
from rich.console import Console

from analysis.records import CheckpointRecord, TrialRecord
from policies.errors import SpecError
from tune_jobs.cli.trials_table import chosen, print_table
from tune_jobs.sweeps.columns import fit


def trial(index: int, score: float | None = None, **given: Any) -> TrialRecord:
    trial_id = f"t{index:04d}"
    kept = CheckpointRecord(trial_id=trial_id, iteration=1, num_env_steps=given.pop("at", 100), evaluation_return=score)
    values: dict[str, Any] = {
        "status": "completed",
        "point": {"gamma": 0.99, "activation": "tanh", "lr": 0.001 * (index + 1)},
        "stop_reason": "num_env_steps 20480 >= 20000",
        "num_env_steps": 20_480,
        "checkpoints": () if score is None else (kept,),
        **given,
    }
    return TrialRecord(trial_id=trial_id, index=index, point_index=index, seed=1_041_290_240 + index, **values)


TRIALS = [trial(0, 30.0), trial(1, 120.25), trial(2), trial(3, -5.0, status="running", stop_reason=None)]


def printed(trials: list[TrialRecord], width: int | None, **given: Any) -> list[str]:
    """The lines that a terminal of this width shows; None: a pipe."""
    console = Console(file=io.StringIO(), width=width or 80, markup=False, highlight=False)
    print_table(console, trials, among=trials, width=width, **given)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return [line.rstrip() for line in text.splitlines()]


def titles(line: str) -> list[str]:
    return [title.strip() for title in line.split("   ") if title.strip()]


ALL = [
    "trial", "status", "score", "env steps", "lr", "gamma", "activation", "seed", "evaluation", "training", "time",
    "ended by",
]  # fmt: skip


def test_ids_and_scores_are_whole_on_every_terminal() -> None:
    for width in range(20, 200):
        lines = printed(TRIALS, width)
        assert all(len(line) <= width for line in lines)
        assert [line.split()[0] for line in lines[2:6]] == ["t0000", "t0001", "t0002", "t0003"]
        assert not any("…" in line for line in lines)
        shown = titles(lines[0])
        assert shown == [title for title in ALL if title in shown]


def test_at_80_columns_what_matters_most_is_shown_and_what_is_left_out_is_named() -> None:
    lines = printed(TRIALS, 80)
    assert titles(lines[0]) == ["trial", "status", "score", "env steps", "lr", "gamma", "activation", "seed"]
    assert lines[3].split() == ["t0001", "completed", "120.2", "20,480", "0.002", "0.99", "tanh", "1041290241"]
    told = " ".join(lines[6:])
    assert "Left out, as 80 columns are too few: evaluation, training, time, ended by." in told
    assert "widen the terminal, or add --json" in told


def test_a_pipe_gets_all_columns_and_nothing_is_cut() -> None:
    failed = trial(4, status="failed", error="ValueError: " + "x" * 300 + "\n  more")
    lines = printed([*TRIALS, failed], None)
    assert titles(lines[0]) == ALL
    assert len(lines) == 7
    assert lines[-1].endswith("ValueError: " + "x" * 300)
    assert not any("Left out" in line for line in lines)


def test_a_wide_terminal_leaves_nothing_out() -> None:
    lines = printed(TRIALS, 200)
    assert titles(lines[0]) == ALL
    assert len(lines) == 6


def test_values_that_differ_come_before_those_that_are_the_same_in_all_trials() -> None:
    trials = [trial(index, point={"gamma": 0.9, "lr": 0.1, "activation": name}) for index, name in enumerate("ab")]
    assert titles(printed(trials, None)[0])[4:7] == ["activation", "gamma", "lr"]


def test_the_column_that_is_sorted_by_is_shown_beside_the_ids() -> None:
    assert titles(printed(TRIALS, 40, first="training")[0])[:2] == ["trial", "training"]


def test_errors_are_told_below_a_table_without_room_for_them() -> None:
    trials = [trial(index, status="failed", error=f"ValueError: [b]{index}[/b]\nmore") for index in range(5)]
    lines = printed(trials, 80)
    assert "t0002 failed: ValueError: [b]2[/b]" in lines
    assert lines[-1] == "and 2 more failed"
    assert "and 2 more failed" not in printed(trials, None)


def order(trials: list[TrialRecord], sort: str | None, top: int | None = None) -> list[int]:
    return [record.index for record in chosen(trials, sort, top)]


def test_scores_come_best_first_and_trials_without_one_last() -> None:
    failed = trial(4, 500.0, status="failed", error="E")
    assert order([*TRIALS, failed], "score") == [1, 0, 3, 2, 4]
    # Those of equal scores as the winner is chosen: by env steps, then by index.
    assert order([trial(0, 1.0, at=9), trial(1, 1.0, at=3), trial(2, 1.0, at=3)], "score") == [1, 2, 0]


@pytest.mark.parametrize(
    ("sort", "expected"),
    [
        ("trial", [0, 1, 2, 3]),
        ("env steps", [1, 0, 2, 3]),
        ("env_steps", [1, 0, 2, 3]),
        ("num_env_steps", [1, 0, 2, 3]),
        ("training", [3, 0, 1, 2]),
        ("Training-Return", [3, 0, 1, 2]),
        ("lr", [2, 1, 3, 0]),
        ("hidden_sizes", [3, 0, 1, 2]),
        ("status", [0, 3, 2, 1]),
    ],
)
def test_other_columns_ascend_and_what_is_not_known_comes_last(sort: str, expected: list[int]) -> None:
    trials = [
        trial(0, num_env_steps=7, training_return=1.0, point={"lr": None, "hidden_sizes": [64]}),
        trial(1, num_env_steps=3, training_return=None, point={"lr": 0.5, "hidden_sizes": [256]}, status="pending"),
        trial(2, num_env_steps=8, training_return=None, point={"lr": 1e-5}, status="running"),
        trial(3, num_env_steps=9, training_return=2.0, point={"lr": "auto", "hidden_sizes": [64, 8][1:]}),
    ]
    assert order(trials, sort) == expected


def test_the_first_are_the_best_unless_another_order_is_asked_for() -> None:
    assert order(TRIALS, None) == [0, 1, 2, 3]
    assert order(TRIALS, None, 2) == [1, 0]
    assert order(TRIALS, "trial", 3) == [0, 1, 2]
    assert order(TRIALS, None, 99) == [1, 0, 3, 2]


def test_an_unknown_column_is_an_error_that_names_the_nearest_and_all() -> None:
    with pytest.raises(SpecError) as caught:
        chosen(TRIALS, "scor", None)
    assert caught.value.message == "--sort: the trials have no column 'scor'. Did you mean 'score'?"
    assert caught.value.hint == f"The columns: {', '.join(ALL)}."


def test_the_command_sorts_what_it_prints(run: RunCommand, sweeps: FakeSweeps) -> None:
    sweeps.answers["trials"] = TRIALS
    lines = run("trials", "mine", "--sort", "score", "--top", "2").stdout.splitlines()
    assert [line.split()[0] for line in lines if line.startswith("t0")] == ["t0001", "t0000"]
    assert "2 of 4 trials" in lines
    document = run("trials", "mine", "--top", "1", "--json").stdout
    assert '"t0001"' in document
    assert '"t0000"' not in document
    assert "of 4 trials" not in run("trials", "mine").stdout


@pytest.mark.parametrize("arguments", [("--sort", "scor"), ("--top", "0"), ("--top", "two")])
def test_a_wrong_order_is_exit_code_2(run: RunCommand, sweeps: FakeSweeps, arguments: tuple[str, str]) -> None:
    sweeps.answers["trials"] = TRIALS
    result = run("trials", "mine", *arguments)
    assert result.exit_code == 2
    assert not result.stdout.splitlines()[1:]  # the stand-in prints a line


def test_a_wide_character_counts_for_two_columns() -> None:
    assert fit(["a", "b"], [["x", "漢字"]], 6, gap=1).shown == (0, 1)
    assert fit(["a", "b"], [["x", "漢字"]], 5, gap=1).left_out == (1,)
