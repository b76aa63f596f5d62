"""What is told of the leading setting: that its seeds chose it, and nothing of how sure where no two seeds differ."""

import dataclasses
import math
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


def test_settings_that_are_not_listed_may_be_those_that_have_several_seeds() -> None:
    listed = [[100.0 + index] for index in range(12)]
    source = source_of(*listed, [60.0, 50.0], [55.0, 62.0])
    assert {len(item.scores) for item in present(source.settings).ranking} == {1}
    assert present(source.settings).best.lower is not None
    assert "Intervals are over training seeds, and learn from all settings" in about(source)
    assert "Each was trained with one seed" not in about(source)
    # Their seeds may tell nothing, and then it isn't for want of seeds.
    alike = source_of(*listed, [60.0, 60.0])
    settings = present(alike.settings)
    assert certainty(settings).startswith("no two seeds of a setting differ")
    assert answer.section(alike).sentences[0].startswith("No two seeds of a setting differ")
    assert "No two seeds of a setting differ" in about(alike)
    # A former record knows of those that it lists.
    former = settings.model_copy(update={"most_seeds": None})
    assert certainty(former).startswith("one seed a setting")


def test_settings_beside_the_front_may_be_those_that_have_several_seeds() -> None:
    front = present(judged(wanted("a", [300.0], [200.0, 200.0], [200.0, 200.0]).data).front)
    assert [item.num_seeds for item in front.points] == [1]
    assert undecided_text(front).startswith("It is not known how much seeds differ: ")
    former = front.model_copy(update={"most_seeds": None})
    assert undecided_text(former).startswith("Each setting has one seed: ")


def test_more_seeds_are_no_advice_where_scores_are_too_large() -> None:
    told = certainty(present(source_of([1e300, -1e300], [3.0, 4.0]).settings))
    assert told == "scores are too large to be squared, so it is not known how much seeds differ"


def test_small_scores_are_not_too_large() -> None:
    points = [[1e-170, 3e-170], [9e-170, 8e-170]]
    settings = present(source_of(*points).settings)
    assert 0.0 < present(settings.best.lower) < settings.best.score
    assert certainty(settings).startswith("the best of 2 with a probability of ")
    difference = present(the_pair(compare([wanted("a", points[0]), wanted("b", points[1])])).difference)
    large = present(the_pair(compare([wanted("a", [1.0, 3.0]), wanted("b", [9.0, 8.0])])).difference)
    assert difference.upper == pytest.approx(large.upper * 1e-170, rel=1e-9)


def test_a_comparison_has_no_interval_where_no_two_seeds_of_a_sweep_differ() -> None:
    found = compare([wanted("a", *ALIKE), wanted("b", [250.0, 251.0], [100.0, 90.0])])
    assert (found.entries[0].lower, found.entries[0].upper) == (None, None)
    assert found.entries[1].lower is not None
    assert "300.0 to 300.0" not in said(found)
    # Nor is its mean taken for exact beside the other one's.
    pair = the_pair(found)
    assert pair.difference is None
    assert pair.verdict == (
        "Whether A or B is better can't be said: no two seeds of a setting in A's sweep differ, so nothing is known of "
        "how much they may."
    )
    assert present(pair.probability).mean == 1.0
    # One pair of them that differs is enough, be it of another setting.
    one = compare([wanted("a", ALIKE[0], [200.0, 201.0]), wanted("b", [250.0, 251.0], [100.0, 90.0])])
    assert the_pair(one).verdict == "A is better than B."


def test_a_race_by_scores_of_any_size_is_one_by_their_ratios() -> None:
    race = Race((0, 1, 2, 3), 3)
    plain = {0: [5.0, 5.01], 1: [4.0, 4.01], 2: [3.0, 3.01], 3: [2.0, 2.01]}
    for exponent in (0, -600, 700):
        scores = {index: [math.ldexp(score, exponent) for score in seeds] for index, seeds in plain.items()}
        assert race.next_points(scores, 1) == ()


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


def of_length(sweep: Wanted, num_env_steps: int) -> Wanted:
    """The sweep, with trainings of as many env steps."""
    return dataclasses.replace(sweep, data=dataclasses.replace(sweep.data, num_env_steps=num_env_steps))


def sweeps_of_two_lengths() -> list[Wanted]:
    """Two sweeps, in each of which a training reached the threshold, and one did not; in the first one failed, too."""
    short = failing(wanted("a", [9.0, 1.0, 9.0], threshold=5.0), 2)
    return [of_length(short, 10_000), of_length(wanted("b", [9.0, 1.0, 9.0], threshold=5.0), 1_000_000)]


def test_what_never_reaches_the_threshold_counts_the_same_in_sweeps_of_other_lengths() -> None:
    found = compare(sweeps_of_two_lengths(), "steps_to_threshold")
    assert (found.failed_score, found.longest_env_steps) == (-2_000_000.0, 1_000_000)
    ours, theirs = found.entries
    assert ours.scores == (-1_000.0, -2_000_000.0, -2_000_000.0)
    assert theirs.scores == (-1_000.0, -2_000_000.0, -1_000.0)
    assert (ours.num_env_steps, theirs.num_env_steps) == (3_000, 3_000)
    assert "Trials may take different numbers of env steps: A 10,000, B 1,000,000." in found.notes
    assert "One that never reaches the threshold counts as 2,000,000 env steps, twice the longest." in found.notes
    # One that reached it wins over one that did not; all others are alike.
    shared = present(the_pair(found).shared)
    assert shared.probability.mean == pytest.approx((1 + 4 * 0.5) / 9)


def test_by_other_objectives_a_training_has_the_length_of_its_sweep() -> None:
    sweeps = sweeps_of_two_lengths()
    short = sweeps[0]
    first = short.data.results["t0000"]
    rising = [*first, first[0].model_copy(update={"iteration": 2, "num_env_steps": 10_000, "evaluation_return": 20.0})]
    data = dataclasses.replace(short.data, results={**short.data.results, "t0000": rising})
    sweeps[0] = dataclasses.replace(short, data=data)
    found = compare(sweeps, "area")
    # Half of the way from 9 to 20 on average, which by the other sweep's length would be 20 nearly.
    assert found.entries[0].scores[0] == pytest.approx(0.1 * 9.0 + 0.9 * 14.5, rel=0.05)
    assert found.longest_env_steps is None
    assert not any("never reaches" in note for note in found.notes)


def test_which_setting_leads_a_sweep_does_not_go_by_the_length_of_another() -> None:
    # Of its own 10,000 env steps its first setting reaches the threshold sooner, in two of three; by the other sweep's
    # million the third would outweigh that.
    ours = of_length(wanted("a", [9.0, 9.0, 1.0], [9.0, 9.0, 9.0], threshold=5.0), 10_000)
    late = [item.model_copy(update={"num_env_steps": 9_900}) for item in ours.data.results["t0003"]]
    results = {**ours.data.results, **dict.fromkeys(("t0003", "t0004", "t0005"), late)}
    ours = dataclasses.replace(ours, data=dataclasses.replace(ours.data, results=results))
    theirs = of_length(wanted("b", [9.0, 9.0, 9.0], threshold=5.0), 1_000_000)
    found = compare([ours, theirs], "steps_to_threshold")
    assert found.entries[0].point_index == 0
    assert found.entries[0].scores == (-1_000.0, -1_000.0, -2_000_000.0)


def test_a_failed_setting_of_one_sweep_counts_as_the_worst_of_that_sweep() -> None:
    """Settings that aren't among those compared count, too."""
    sweep = failing(wanted("a", [500.0, 490.0, 0.0], [480.0, 470.0, 475.0], [10.0, 11.0, 12.0]), 2)
    settings = [dataclasses.replace(sweep, name=f"a/p{index}", point_index=index) for index in (0, 1)]
    found = compare(settings)
    assert found.entries[0].scores == (500.0, 490.0, 10.0)
    assert "A failed seed counts as the worst training of its sweep." in found.notes
    # Of one name are two sweeps, too.
    another = dataclasses.replace(settings[1], sweep=sweep.sweep.model_copy(update={"created_at": 1.0}))
    assert "A failed seed counts as the worst training of all sweeps that are compared." in (
        compare([settings[0], another]).notes
    )


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
    drawn.clear()
    sweeps = sweeps_of_two_lengths()
    found = compare(sweeps, "steps_to_threshold")
    page.write_page(tmp_path / "page.html", found, dict(zip("AB", sweeps, strict=True)))
    assert drawn == list(found.entries[0].scores)


def test_the_report_and_the_table_say_what_a_failed_seed_counts_as() -> None:
    sweep = failing(wanted("a", [9.0, 1.0], [9.0, 9.0], objective="steps_to_threshold", threshold=5.0), 1)
    source = Source("sweep", sweep.sweep, sweep.data.trials, sweep.data.results, None, None, None, judged(sweep.data))
    assert "A seed that failed counts as a training that never reaches the threshold." in about(source)
    assert "A failed seed counts as one that never reaches it." in latex_table(sweep.data, name="a", env_id="E")
    final = failing(wanted("a", [9.0, 1.0], [9.0, 9.0]), 1)
    assert "A failed seed counts as the worst trial." in latex_table(final.data, name="a", env_id="E")
