"""What is told of the leading setting: that its seeds chose it, and nothing of how sure where no two seeds differ."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from compared_sweeps import said, the_pair, wanted

from analysis.answers import certainty, setting_score
from analysis.best_records import SettingsRecord
from analysis.comparison import page
from analysis.comparison.compare import Comparison, compare
from analysis.comparison.entries import Wanted
from analysis.exports.frames import SweepData, settings_frame
from analysis.exports.latex import latex_table
from analysis.front_words import undecided_text
from analysis.page import answer, how_sure
from analysis.page.cards import setting_card
from analysis.page.source import Source
from analysis.racing import Race
from analysis.records import Objective
from analysis.settings import judge_settings
from tests.narrowing import present

ALIKE = ([300.0, 300.0], [200.0, 200.0], [200.0, 200.0])
"""Settings that differ, each of whose seeds do not."""


def source_of(*points: list[float], **given: Any) -> Source:
    """A sweep of points with these scores, one a training seed, and its settings."""
    sweep = wanted("a", *points, **given)
    data = sweep.data
    return Source("sweep", sweep.sweep, data.trials, data.results, None, None, None, judged(data))


def judged(data: SweepData) -> SettingsRecord:
    return present(
        judge_settings(
            data.trials, data.results, data.objective, num_env_steps=data.num_env_steps, threshold=data.threshold,
            cost="env_steps",
        )
    )  # fmt: skip


def about(source: Source) -> str:
    return " ".join(how_sure.section(source).about)


# -- a leader is flattered


@pytest.mark.parametrize("objective", ["best", "steps_to_threshold"])
def test_what_is_to_be_expected_of_more_seeds_is_told_beside_a_higher_score(objective: Objective) -> None:
    # Two seeds that lie far apart, and the one seed of the leader is beyond them all.
    source = source_of([100.0, 20.0], [90.0, 30.0], [120.0], objective=objective, threshold=50.0)
    settings = present(source.settings)
    best = settings.best
    assert best.expected < best.score
    sign = -1.0 if objective == "steps_to_threshold" else 1.0
    told = f"{sign * best.expected:{',.0f' if sign < 0 else '.1f'}} is to be expected of more seeds"
    assert f"over training seeds); {told}" in setting_score(settings)
    assert present(setting_card(source)).expected == told


def test_nothing_is_told_of_more_seeds_where_they_would_score_the_same() -> None:
    for points in ([[100.0], [90.0]], [[100.0, 100.1], [90.0, 90.1]], [[5.0, 5.0], [5.0, 5.0]]):
        source = source_of(*points)
        assert "expected" not in setting_score(present(source.settings))
        assert present(setting_card(source)).expected == ""


@pytest.mark.parametrize(("expected", "is_told"), [(99.1, False), (98.9, True)])
def test_less_than_a_tenth_of_half_the_interval_is_not_told(expected: float, is_told: bool) -> None:
    settings = present(source_of([100.0, 20.0], [90.0, 30.0]).settings)
    best = settings.best.model_copy(update={"score": 100.0, "lower": 90.0, "upper": 110.0, "expected": expected})
    told = settings.model_copy(update={"ranking": (best, *settings.ranking[1:])})
    assert (f"{expected} is to be expected of more seeds" in setting_score(told)) == is_told


def test_the_report_says_that_the_leader_was_chosen_by_its_seeds() -> None:
    told = "The first leads by the seeds that its score is of: fresh ones would likely score less."
    assert told in about(source_of([100.0, 20.0], [90.0, 30.0]))
    assert told not in about(source_of([100.0], [90.0]))
    assert told not in about(source_of(*ALIKE))


# -- no two seeds of a setting differ


def test_where_no_two_seeds_of_a_setting_differ_nothing_is_said_to_be_sure() -> None:
    settings = judged(wanted("a", *ALIKE).data)
    assert settings.best.point_index == 0
    for item in settings.ranking:
        assert (item.lower, item.upper, item.probability_best, item.may_be_best) == (None, None, None, True)
    assert settings.num_may_be_best == 3
    assert setting_score(settings) == "300.0 in its best evaluation"
    assert certainty(settings) == (
        "no two seeds of a setting differ, so it is not known how much they may: see `tune-jobs replicate`"
    )
    # One pair that differs tells how much seeds may.
    assert judged(wanted("a", [300.0, 301.0], *ALIKE[1:]).data).num_may_be_best == 1


def test_settings_that_all_reach_one_score_may_all_be_the_best() -> None:
    source = source_of([500.0, 500.0], [500.0, 500.0], [500.0])
    settings = present(source.settings)
    assert [item.probability_best for item in settings.ranking] == pytest.approx([1 / 3] * 3)
    assert settings.num_may_be_best == 3
    assert settings.best.lower is None
    assert answer.section(source).sentences[0] == "All 3 settings scored 500.0: the data can't order them."
    assert "no two seeds of a setting differ" in about(source).lower()


def test_the_report_says_who_leads_and_who_ties_where_no_two_seeds_differ() -> None:
    source = source_of(*ALIKE)
    (told, *_) = answer.section(source).sentences
    assert told == (
        "No two seeds of a setting differ, so it is not known how much they may; "
        "lr 0.1 leads: it scored 300.0 in its best evaluation."
    )
    assert answer.section(source).command == "tune-jobs replicate sweep"
    tied = answer.section(source_of([500.0, 500.0], [500.0, 500.0], [200.0, 200.0])).sentences[0]
    assert tied.endswith("; 2 of 3 settings tie.")
    card = present(setting_card(source))
    assert card.interval is None
    assert card.certainty == "No two seeds of a setting differ, so it is not known how much they may."
    assert "there are no intervals, and nothing says that the first is the best" in about(source)
    assert "P(best)" not in how_sure.section(source).settings_table.headings
    huge = source_of([1e300, -1e300], [3.0, 4.0])
    assert "too large to be squared" in certainty(present(huge.settings))


def test_tables_leave_out_what_is_not_known_where_no_two_seeds_differ() -> None:
    data = wanted("a", *ALIKE).data
    frame = settings_frame(data)
    assert frame[["lower", "upper", "probability_best", "may_be_best"]].isna().all(axis=None)
    table = latex_table(data, name="a", env_id="CartPole-v0")
    assert "300.0 to 300.0" not in table
    assert "& --" in table
    equal = settings_frame(wanted("a", [500.0, 500.0], [500.0, 500.0]).data)
    assert equal["may_be_best"].all()
    assert equal["lower"].isna().all()


def test_the_front_is_not_sure_where_no_two_seeds_differ() -> None:
    front = present(judged(wanted("a", *ALIKE).data).front)
    assert (front.num_undecided, front.may_be_best) == (None, None)
    assert {item.lower for item in front.points} == {None}
    assert undecided_text(front).startswith("It is not known how much seeds differ: nothing says how sure")


def test_a_comparison_has_no_interval_where_no_two_seeds_of_a_sweep_differ() -> None:
    found = compare([wanted("a", *ALIKE), wanted("b", [250.0, 251.0], [100.0, 90.0])])
    assert (found.entries[0].lower, found.entries[0].upper) == (None, None)
    assert found.entries[1].lower is not None
    assert "300.0 to 300.0" not in said(found)
    assert the_pair(found).difference is not None


def test_a_race_goes_on_where_no_two_seeds_differ() -> None:
    race = Race((0, 1, 2, 3), 3)
    alike = {0: [5.0, 5.0], 1: [4.0, 4.0], 2: [3.0, 3.0], 3: [2.0, 2.0]}
    assert race.next_points(alike, 1) == (0, 1, 0, 1)
    assert race.next_points(alike | {0: [5.0, 5.001], 1: [4.0, 4.001]}, 1) == ()
    # Of many that score the same, none is out for it.
    many = Race(tuple(range(60)), 60)
    assert len(many.next_points({index: [500.0, 500.0] for index in range(60)}, 1)) > 0
    # A budget is all that it takes, however much they tie.
    assert race.next_points({index: [500.0, 500.0] for index in range(4)}, len(race.rounds)) == ()


# -- a training that failed


def failing(sweep: Wanted, *indices: int) -> Wanted:
    """The sweep, of which some trials failed."""
    trials = [
        trial.model_copy(update={"status": "failed"}) if trial.index in indices else trial
        for trial in sweep.data.trials
    ]
    return dataclasses.replace(sweep, data=dataclasses.replace(sweep.data, trials=trials))


def test_a_failed_seed_is_no_better_than_the_trainings_of_another_sweep() -> None:
    crashes = failing(wanted("a", [499.0, 500.0, 500.0, 498.0, 1.0, 1.0, 1.0, 1.0]), 4, 5, 6, 7)
    steady = wanted("b", [484.0, 490.0, 486.0, 489.0, 487.0, 485.0, 488.0, 491.0])
    found = compare([crashes, steady])
    assert found.failed_score == 484.0
    assert found.entries[0].scores == (499.0, 500.0, 500.0, 498.0, 484.0, 484.0, 484.0, 484.0)
    pair = the_pair(found)
    assert pair.verdict == "The data can't tell A from B."
    # Ties count half: four of eight win all, and of the others only those with the least draw.
    assert present(pair.probability).mean == pytest.approx((4 * 8 + 4 * 0.5) / 64)
    assert present(pair.shared).probability.mean == present(pair.probability).mean


def test_what_cannot_be_compared_has_the_worst_of_each_sweep_for_a_failure() -> None:
    other = wanted("b", [-500.0, -400.0])
    spec = {**other.sweep.spec, "env": {"id": "Acrobot-v1", "args": {}}}
    other = dataclasses.replace(other, sweep=other.sweep.model_copy(update={"spec": spec}))
    found = compare([failing(wanted("a", [9.0, 8.0], [1.0, 1.0]), 0), other])
    assert found.failed_score is None
    assert found.entries[0].scores == (1.0, 8.0)
    assert "A failed seed counts as the worst training of its sweep." in found.notes


def test_a_sweep_is_compared_by_the_setting_that_it_names_by_itself() -> None:
    # By its own worst, 80, its first setting leads with a failed seed; by the other sweep's it would not.
    ours = failing(wanted("a", [100.0, 99.0, 100.0, 0.0], [90.0, 91.0, 89.0, 80.0]), 3)
    assert settings_frame(ours.data)["point_index"].iloc[0] == 0
    found = compare([ours, wanted("b", [-900.0, -800.0])])
    assert found.entries[0].point_index == 0
    assert found.entries[0].scores == (100.0, 99.0, 100.0, -900.0)


def test_a_failed_seed_of_a_comparison_by_env_steps_has_never_reached_the_threshold() -> None:
    sweeps = [failing(wanted("a", [9.0, 1.0], threshold=5.0), 1), wanted("b", [9.0, 9.0], threshold=5.0)]
    found = compare(sweeps, "steps_to_threshold")
    assert found.entries[0].scores == (-1_000.0, -100_000.0)
    assert "A failed seed counts as a training that never reaches the threshold." in found.notes


def test_the_page_of_a_comparison_has_the_same_score_for_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[float] = []

    def figures(comparison: Comparison, wanted: Mapping[str, Wanted]) -> list[dict[str, Any]]:
        drawn.extend(page._runs(comparison.entries[0], wanted["A"]))
        return []

    monkeypatch.setattr(page, "_figures", figures)
    sweeps = [failing(wanted("a", [9.0, 8.0]), 1), wanted("b", [2.0, 3.0])]
    page.write_page(tmp_path / "page.html", compare(sweeps), dict(zip("AB", sweeps, strict=True)))
    assert drawn == [9.0, 2.0]


def test_the_report_and_the_table_say_what_a_failed_seed_counts_as() -> None:
    sweep = failing(wanted("a", [9.0, 1.0], [9.0, 9.0], objective="steps_to_threshold", threshold=5.0), 1)
    source = Source("sweep", sweep.sweep, sweep.data.trials, sweep.data.results, None, None, None, judged(sweep.data))
    assert "A seed that failed counts as a training that never reaches the threshold." in about(source)
    assert "A failed seed counts as one that never reaches it." in latex_table(sweep.data, name="a", env_id="E")
    final = failing(wanted("a", [9.0, 1.0], [9.0, 9.0]), 1)
    assert "A failed seed counts as the worst trial." in latex_table(final.data, name="a", env_id="E")
