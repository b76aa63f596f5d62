"""What figures, tables and texts say at the edges: one evaluation, odd names, values close to each other or to 1."""

import math
from pathlib import Path

import numpy as np
import pytest
from compared_sweeps import wanted
from sweep_folders import make_sweep_folder
from synthetic_sweep import make_sweep_record

import tune_jobs
from analysis.best_so_far import best_so_far
from analysis.charts.what_mattered import _told_apart
from analysis.comparison.compare import compare
from analysis.comparison.wording import fact_rows, pair_lines
from analysis.importance.effects import _parts
from analysis.importance.searched import Searched
from analysis.points import setting_labels
from analysis.records import IterationRecord, TrialRecord
from analysis.report_data import goal_of
from analysis.wording import setting_text, short_text


def test_a_curve_of_one_evaluation_is_seen(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine", iterations=1)
    (curve, *_) = tune_jobs.figure(store.folder).axes[0].lines
    assert len(np.asarray(curve.get_xdata())) == 1
    assert curve.get_marker() == "o"
    longer = tune_jobs.figure(make_sweep_folder(tmp_path / "longer").folder).axes[0].lines[0]
    assert longer.get_marker() in ("", "None")


def test_a_sweep_whose_name_begins_with_a_line_is_in_the_legend(tmp_path: Path) -> None:
    folders = [make_sweep_folder(tmp_path / name).folder for name in ("_mine", "other")]
    drawn = tune_jobs.figure(folders, top=1)
    texts = [text.get_text().lstrip("\u200b") for text in drawn.legends[0].get_texts()]
    assert [text.partition(" ")[0] for text in texts[:2]] == ["_mine", "other"]


def test_env_steps_are_told_as_such_everywhere_in_a_comparison() -> None:
    """They are scored below zero, as fewer are better; an interval may go beyond none at all."""
    steps = [[30.0, 2.0], [2.0, 30.0]]
    left, right = (
        wanted(name, *steps, objective="steps_to_threshold", threshold=threshold)
        for name, threshold in (("a", 25.0), ("b", 25.0))
    )
    comparison = compare([left, right], objective=None)
    told = [line for _, lines in pair_lines(comparison) for line in lines]
    (iqm,) = [line for line in told if line.startswith("Their IQM there")]
    assert "-" not in iqm.replace("Their IQM there", "")
    rows = dict(fact_rows(comparison))
    (interval,) = {cell for title, cells in rows.items() if "95 %" in title for cell in cells}
    assert interval.startswith("0 to ")
    assert not any("-0 " in line for line in told)


@pytest.mark.parametrize(
    ("numbers", "texts"),
    [
        ([1.0, 2.0, 3.0], ["1", "2", "3"]),
        ([0.98, 0.9848, 0.9895], ["0.98", "0.985", "0.99"]),
        ([1000.0, 1050.0, 1100.0], ["1000", "1050", "1100"]),
        ([0.5, 0.5], ["0.5", "0.5"]),
        ([1 / 3, 1 / 3], ["0.33", "0.33"]),
    ],
)
def test_edges_of_bins_are_told_apart(numbers: list[float], texts: list[str]) -> None:
    assert _told_apart(numbers) == texts


def test_values_near_one_have_the_digits_of_what_they_lack() -> None:
    values = {0.99: "0.99", 0.9904: "0.9904", 0.99987: "0.99987", 0.95: "0.95", 0.91234: "0.9123", 0.5123: "0.512"}
    assert {value: short_text(value) for value in values} == values
    assert (short_text(1.0), short_text(0.0), short_text(1.0001)) == ("1", "0", "1")
    assert setting_labels([{"gamma": 0.99}, {"gamma": 0.9904}]) == ["0.99", "0.9904"]


def test_convolutions_are_told_apart() -> None:
    for text in (short_text, setting_text):
        assert text([[16, 8, 4], (32, 4, 2)]) == "16x8x4 32x4x2"
        assert text([[16, 8, 4]]) == "16x8x4"
        assert text((64, 32)) == "64x32"


def test_parts_of_whole_numbers_are_told_by_those_in_them() -> None:
    searched = Searched("n_step", "randint", (1, 9), tuple(range(1, 9)))
    assert [label for label, _, _ in _parts(searched)] == ["1 to 3", "4 to 5", "6 to 8"]


def test_the_time_before_a_resume_is_not_counted_again() -> None:
    """The first trained for 100 s, then for 10 more when it was resumed at 1,000; the other from 1,020 on."""

    def record(index: int, time_s: float, started_at: float, ended_at: float) -> TrialRecord:
        return TrialRecord(
            trial_id=f"t{index:04d}", index=index, point_index=index, seed=index, point={}, status="completed",
            time_s=time_s, started_at=started_at, ended_at=ended_at,
        )  # fmt: skip

    def rows(*found: tuple[float, float]) -> list[IterationRecord]:
        return [
            IterationRecord(
                iteration=number, num_env_steps=100 * number, num_episodes=1, time_s=time_s, evaluation_return=score
            )
            for number, (time_s, score) in enumerate(found, start=1)
        ]

    trials = [record(0, 110.0, 1000.0, 1010.0), record(1, 20.0, 1020.0, 1040.0)]
    results = {"t0000": rows((100.0, 1.0), (110.0, 2.0)), "t0001": rows((10.0, 3.0))}
    found = best_so_far(trials, results, evaluated=True)
    assert [(item.trial_id, item.spent) for item in found.improvements] == [
        ("t0000", 100), ("t0000", 200), ("t0001", 300)
    ]  # fmt: skip


def test_a_threshold_that_is_infinite_is_none() -> None:
    sweep = make_sweep_record("mine", "ppo", "elsewhere:Mine-v0", [], 1)
    # The next that is known is that of the sweep's stop rule.
    assert goal_of(sweep.model_copy(update={"env_threshold": math.inf}), None) == 195.0
    assert goal_of(sweep.model_copy(update={"env_threshold": 7.0}), None) == 7.0
