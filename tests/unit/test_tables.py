"""DataFrames and CSV files of trials and iterations."""

import math
from pathlib import Path
from typing import Any, cast

import pandas as pd
import pytest
from synthetic_sweep import Synthetic, make_sweep

from analysis.records import ChangeRecord, IterationRecord, TrialRecord
from analysis.selection import score_trial
from analysis.tables import (
    cell_value,
    env_steps_to,
    groups_frame,
    iterations_frame,
    steps_to_solve_frame,
    trials_frame,
    write_csv,
)
from policies.errors import CannotRunError
from tests.narrowing import present


@pytest.fixture(scope="module")
def synthetic() -> Synthetic:
    return make_sweep(failed={3}, pending={5})


def iteration(number: int, *, episodes: int, training: float | None) -> IterationRecord:
    return IterationRecord(
        iteration=number, num_env_steps=1000 * number, num_episodes=episodes, time_s=1.0, training_return=training
    )


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ([64, 64], "64x64"),
        ((32,), "32"),
        ([[16, 8, 4], [32, 4, 2]], "16x8x4 32x4x2"),
        ("relu", "relu"),
        (0, 0),
        (False, False),
        (None, None),
        (1e-7, 1e-7),
    ],
)
def test_a_value_becomes_a_cell(value: Any, expected: bool | float | str | None) -> None:
    assert cell_value(value) == expected
    assert type(cell_value(value)) is type(expected)


def test_one_row_a_trial(synthetic: Synthetic) -> None:
    frame = trials_frame(synthetic.trials, synthetic.results, threshold=195.0)
    assert len(frame) == 20
    assert list(frame.columns[:5]) == ["trial_id", "status", "hidden_sizes", "activation", "lr"]
    assert frame["hidden_sizes"].tolist()[:4] == ["32", "32", "64", "64"]
    assert frame["lr"].tolist() == [trial.point["lr"] for trial in synthetic.trials]
    assert frame["seed"].tolist() == [trial.seed for trial in synthetic.trials]
    row = frame.set_index("trial_id").loc["t0001"]
    assert row["score"] == present(score_trial(synthetic.trials[1])).score
    assert row["score_num_env_steps"] == present(score_trial(synthetic.trials[1])).checkpoint.num_env_steps


def test_rows_are_in_order_of_index_whatever_the_order_given(synthetic: Synthetic) -> None:
    frame = trials_frame(synthetic.trials[::-1])
    assert frame["trial_id"].tolist() == [trial.trial_id for trial in synthetic.trials]


def test_failed_and_pending_trials_are_rows_without_a_score(synthetic: Synthetic) -> None:
    frame = trials_frame(synthetic.trials, synthetic.results).set_index("trial_id")
    assert frame.loc["t0003", "status"] == "failed"
    assert math.isnan(cast("Any", frame.loc["t0003", "score"]))
    assert cast("Any", frame.loc["t0003", "error"]).startswith("RuntimeError: env.step raised")
    assert "\n" not in cast("Any", frame.loc["t0003", "error"])
    assert frame.loc["t0005", "status"] == "pending"
    assert math.isnan(cast("Any", frame.loc["t0005", "training_return"]))
    assert frame.loc["t0005", "num_env_steps"] == 0


def test_a_score_of_zero_is_not_missing() -> None:
    trial = make_sweep(points=[{"lr": 1e-3}]).trials[0]
    zero = trial.checkpoints[0].model_copy(update={"evaluation_return": 0.0})
    frame = trials_frame([trial.model_copy(update={"checkpoints": (zero,)})])
    assert frame["score"].tolist() == [0.0]


def test_solved_needs_the_return_and_a_hundred_episodes() -> None:
    rows = [
        iteration(1, episodes=20, training=200.0),
        iteration(2, episodes=100, training=None),
        iteration(3, episodes=120, training=194.9),
        iteration(4, episodes=140, training=195.0),
        iteration(5, episodes=160, training=199.0),
    ]
    assert env_steps_to(195.0, rows) == 4000
    assert env_steps_to(195.0, rows, num_episodes=20) == 1000
    assert env_steps_to(200.0, rows[1:]) is None
    assert env_steps_to(None, rows) is None
    assert env_steps_to(0.0, [iteration(1, episodes=100, training=0.0)]) == 1000


def test_after_a_copy_solved_needs_a_hundred_episodes_since_then() -> None:
    """The training return of a population's trial is of what it played since it went on from a copy."""
    rows = [
        iteration(number, episodes=60 * number, training=200.0 if number > 2 else 100.0).model_copy(
            update={"episode_returns": (200.0,) * 60}
        )
        for number in range(1, 9)
    ]
    assert env_steps_to(195.0, rows) == 3000
    # Two iterations have a hundred episodes; a change after an iteration leaves that one to what was before.
    assert env_steps_to(195.0, rows, changed_at=[2]) == 4000
    assert env_steps_to(195.0, rows, changed_at=[3]) == 3000
    assert env_steps_to(195.0, rows, changed_at=[3, 2]) == 3000 + 2000
    assert env_steps_to(195.0, rows, changed_at=range(2, 8)) is None
    assert env_steps_to(195.0, rows, num_episodes=60, changed_at=[2, 3]) == 3000
    change = ChangeRecord(
        iteration=2, num_env_steps=2000, source_trial_id="t0001", source_iteration=2, before={"lr": 0.1},
        after={"lr": 0.2}, time=0.0,
    )  # fmt: skip
    trial = TrialRecord(trial_id="t0000", index=0, point_index=0, seed=0, point={"lr": 0.2}, status="completed")
    for changes, steps in [((), 3000), ((change,), 4000)]:
        given = [trial.model_copy(update={"changes": changes})], {"t0000": rows}
        assert trials_frame(*given, threshold=195.0)["num_env_steps_to_solve"].tolist() == [steps]
        assert steps_to_solve_frame(*given, threshold=195.0)["median_num_env_steps"].tolist() == [steps]


def test_no_trials_give_an_empty_table_with_its_columns() -> None:
    frame = trials_frame([])
    assert len(frame) == 0
    assert "score" in frame.columns
    assert len(iterations_frame({})) == 0


def test_one_row_an_iteration(synthetic: Synthetic) -> None:
    frame = iterations_frame(synthetic.results)
    assert len(frame) == sum(len(rows) for rows in synthetic.results.values())
    first = frame.iloc[0]
    assert (first["trial_id"], first["iteration"], first["num_env_steps"]) == ("t0000", 1, 1024)
    assert first["learner/entropy"] == 0.6
    assert frame["evaluation_return"].isna().sum() > 0


def test_groups_count_who_solved_and_how_fast(synthetic: Synthetic) -> None:
    frame = trials_frame(synthetic.trials, synthetic.results, threshold=195.0)
    groups = groups_frame(synthetic.trials, synthetic.results, ["hidden_sizes", "activation"], threshold=195.0)
    assert groups["num_trials"].tolist() == [5, 5, 5, 5]
    assert groups["num_failed"].sum() == 1
    solved = frame["num_env_steps_to_solve"].dropna()
    assert groups["num_solved"].sum() == len(solved) > 0
    assert groups["min_num_env_steps_to_solve"].iloc[0] == solved.min()
    assert groups["min_num_env_steps_to_solve"].isna().tolist() == [False, False, True, True]
    unsolved = groups_frame(synthetic.trials, synthetic.results, ["activation"], threshold=None)
    assert unsolved["num_solved"].tolist() == [0, 0]
    assert unsolved["best_score"].is_monotonic_decreasing


def points_that_solve_at(
    *points: tuple[int | None, ...], unfinished: tuple[int, ...] = ()
) -> tuple[list[TrialRecord], dict[str, list[IterationRecord]]]:
    """Trials whose seeds solve (training return 195) at these iterations, 1,000 env steps each; None: never."""
    seeds_per_point = len(points[0])
    points_of_lr = [{"lr": 10.0 ** -(index + 1)} for index in range(len(points))]
    synthetic = make_sweep(points=points_of_lr, seeds_per_point=seeds_per_point)
    at = [number for point in points for number in point]
    trials = [
        trial.model_copy(update={"status": "running" if trial.index in unfinished else "completed"})
        for trial in synthetic.trials
    ]
    results = {
        trial.trial_id: [
            iteration(number, episodes=200, training=195.0 if at[trial.index] == number else 20.0)
            for number in range(1, 11)
        ]
        for trial in trials
    }
    return trials, results


def test_steps_to_solve_are_medians_over_the_seeds_of_a_point() -> None:
    trials, results = points_that_solve_at((9, 2, 4), (5, None, 3), (None, 1, None), (None, None, None))
    frame = steps_to_solve_frame(trials, results, threshold=195.0)
    # Of three seeds one that never solves is the slowest: the median is the slower of the two others.
    assert frame["lr"].tolist() == [0.1, 0.01, 0.001, 0.0001]
    assert frame["median_num_env_steps"].tolist()[:2] == [4000, 5000]
    assert frame["median_num_env_steps"].isna().tolist() == [False, False, True, True]
    assert frame["num_solved"].tolist() == [3, 2, 1, 0]
    assert frame["num_seeds"].tolist() == [3, 3, 3, 3]
    seeds = frame[["num_env_steps_seed_0", "num_env_steps_seed_1", "num_env_steps_seed_2"]]
    assert seeds.iloc[0].tolist() == [9000, 2000, 4000]
    assert seeds.iloc[1].tolist() == [5000, pd.NA, 3000]


def test_the_fewest_median_steps_come_first_not_the_luckiest_seed() -> None:
    trials, results = points_that_solve_at((1, 9), (3, 4))
    frame = steps_to_solve_frame(trials, results, threshold=195.0)
    assert frame["point_index"].tolist() == [1, 0]
    assert frame["median_num_env_steps"].tolist() == [3500, 5000]


def test_a_seed_that_still_runs_may_solve_yet() -> None:
    trials, results = points_that_solve_at((2, None), unfinished=(1,))
    (row,) = steps_to_solve_frame(trials, results, threshold=195.0).to_dict("records")
    assert (row["num_seeds"], row["num_solved"], row["median_num_env_steps"]) == (1, 1, 2000)


def test_without_a_threshold_or_trials_nothing_is_solved(synthetic: Synthetic) -> None:
    frame = steps_to_solve_frame(synthetic.trials, synthetic.results, threshold=None)
    assert len(frame) == 20
    assert frame["num_solved"].sum() == 0
    assert steps_to_solve_frame([], {}, threshold=195.0).empty


def test_steps_to_solve_agree_with_the_table_of_trials(synthetic: Synthetic, tmp_path: Path) -> None:
    frame = steps_to_solve_frame(synthetic.trials, synthetic.results, threshold=195.0)
    trials = trials_frame(synthetic.trials, synthetic.results, threshold=195.0)
    assert sorted(frame["median_num_env_steps"].dropna()) == sorted(trials["num_env_steps_to_solve"].dropna())
    write_csv(tmp_path / "s.csv", frame)
    assert len(pd.read_csv(tmp_path / "s.csv")) == 20


def test_csv_reads_back(synthetic: Synthetic, tmp_path: Path) -> None:
    frame = trials_frame(synthetic.trials, synthetic.results, threshold=195.0)
    write_csv(tmp_path / "deep" / "trials.csv", frame)
    back = pd.read_csv(tmp_path / "deep" / "trials.csv")
    assert back["trial_id"].tolist() == frame["trial_id"].tolist()
    assert back["lr"].tolist() == frame["lr"].tolist()
    assert back["score"].isna().sum() == 2
    # Whole numbers stay whole where some are missing.
    text = pd.read_csv(tmp_path / "deep" / "trials.csv", dtype=str)["num_env_steps_to_solve"]
    assert text.isna().any()
    assert text.dropna().str.fullmatch(r"\d+").all()
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["trials.csv"]


@pytest.mark.parametrize("start", ["=", "+", "-", "@"])
def test_csv_text_is_no_spreadsheet_formula(tmp_path: Path, start: str) -> None:
    synthetic = make_sweep(points=[{"lr": 1e-3}], failed={0}, error=f"{start}HYPERLINK(1)")
    write_csv(tmp_path / "t.csv", trials_frame(synthetic.trials))
    assert pd.read_csv(tmp_path / "t.csv")["error"].tolist() == [f"'{start}HYPERLINK(1)"]


def test_csv_leaves_numbers_alone(tmp_path: Path) -> None:
    write_csv(tmp_path / "t.csv", pd.DataFrame({"score": [-7.5, 3.0]}))
    assert (tmp_path / "t.csv").read_text() == "score\n-7.5\n3.0\n"


def test_a_csv_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotRunError, match="file"):
        write_csv(tmp_path / "file" / "t.csv", pd.DataFrame({"a": [1]}))
