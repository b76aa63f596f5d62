"""Sweeps and settings side by side: scores, intervals, probabilities, costs, and what can't be compared."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from compared_sweeps import LEFT, RIGHT, said, the_pair, wanted
from fake_sweeps import RunCommand
from scipy import stats
from sweep_folders import extend_by_leaders, make_sweep_folder

import tune_jobs
from analysis.comparison.compare import compare
from analysis.comparison.wording import fact_rows
from analysis.exports.frames import SweepData
from policies.errors import NotFoundError, SpecError
from tests.narrowing import present
from tune_jobs.cli.result_commands import OBJECTIVES
from tune_jobs.spec.sections import ObjectiveSpec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.exports import sweep_data

# -- statistics, against SciPy


def test_of_single_settings_the_difference_is_welchs_and_the_probability_mann_whitneys() -> None:
    pair = the_pair(compare([wanted("a", LEFT), wanted("b", RIGHT)]))
    welch = stats.ttest_ind(LEFT, RIGHT, equal_var=False).confidence_interval(0.95)
    difference = present(pair.difference)
    assert difference.mean == pytest.approx(np.mean(LEFT) - np.mean(RIGHT))
    np.testing.assert_allclose([difference.lower, difference.upper], [welch.low, welch.high], rtol=1e-9)
    u = stats.mannwhitneyu(LEFT, RIGHT).statistic
    assert present(pair.probability).mean == pytest.approx(u / (len(LEFT) * len(RIGHT)))
    assert pair.verdict == "A is better than B."
    other_way = the_pair(compare([wanted("b", RIGHT), wanted("a", LEFT)]))
    assert other_way.verdict == "B is better than A."
    assert present(other_way.probability).mean == pytest.approx(1 - u / (len(LEFT) * len(RIGHT)))


def test_an_entry_has_the_mean_the_iqm_and_students_interval_of_its_seeds() -> None:
    entry = compare([wanted("a", LEFT), wanted("b", RIGHT)]).entries[0]
    assert entry.scores == tuple(LEFT)
    assert entry.mean == pytest.approx(np.mean(LEFT))
    assert entry.iqm == pytest.approx(stats.trim_mean(LEFT, 0.2))
    expected = stats.t.interval(0.95, 4, loc=np.mean(LEFT), scale=stats.sem(LEFT))
    np.testing.assert_allclose([present(entry.lower), present(entry.upper)], expected, rtol=1e-9)


def test_settings_that_overlap_are_not_told_apart() -> None:
    assert "The data can't tell A from B." in said(compare([wanted("a", [1.0, 3.0]), wanted("b", [2.0, 3.5])]))


def test_sweeps_are_compared_within_the_settings_that_both_have() -> None:
    left = wanted("a", [5.0, 6.0], [50.0, 60.0], [1.0, 2.0], values=[0.1, 0.2, 0.9])
    right = wanted("b", [55.0, 49.0], [4.0, 4.5], values=[0.2, 0.1])
    shared = present(the_pair(compare([left, right])).shared)
    assert shared.num_settings == 2
    by_setting = [stats.mannwhitneyu(x, y).statistic / 4 for x, y in [([5, 6], [4, 4.5]), ([50, 60], [55, 49])]]
    assert shared.probability.mean == pytest.approx(np.mean(by_setting))
    assert shared.left_iqm.mean == pytest.approx(stats.trim_mean([5, 6, 50, 60], 0.25))
    assert shared.left_iqm.lower < shared.left_iqm.mean < shared.left_iqm.upper


def test_without_a_common_setting_it_is_said_and_the_leading_ones_are_compared() -> None:
    found = compare([wanted("a", LEFT, values=[0.1]), wanted("b", RIGHT, values=[0.2])])
    pair = the_pair(found)
    assert pair.shared is None
    assert "none of the 1 setting of a is among the 1 setting of b" in said(found)
    assert pair.probability is not None


def test_more_than_four_are_compared_with_the_one_with_the_highest_mean() -> None:
    many = [wanted(name, [value, value + 1]) for name, value in zip("vwxyz", (1.0, 9.0, 3.0, 4.0, 5.0), strict=True)]
    assert [(pair.left, pair.right) for pair in compare(many).pairs] == [("B", letter) for letter in "ACDE"]
    assert len(compare(many[:4]).pairs) == 6


# -- what isn't known


def test_one_seed_a_setting_gives_scores_but_no_certainty() -> None:
    found = compare([wanted("a", [10.0], [3.0]), wanted("b", RIGHT)])
    pair = the_pair(found)
    assert found.entries[0].mean == 10.0
    assert pair.difference is None
    assert pair.probability is None
    assert "A has one seed a setting, so that nothing is known" in pair.verdict
    assert "tune-jobs replicate a" in pair.verdict
    assert "A has one seed." in said(found)


def test_a_setting_of_one_seed_beside_others_has_the_width_of_those() -> None:
    pair = the_pair(compare([wanted("a", [10.0], [3.0, 4.0]), wanted("b", RIGHT)]))
    assert pair.difference is not None
    assert pair.probability is None


def test_where_all_trials_failed_it_is_said_with_the_first_error() -> None:
    failed = wanted("a", [1.0, 2.0])
    trials = [trial.model_copy(update={"status": "failed", "error": "ValueError: x"}) for trial in failed.data.trials]
    failed = dataclasses.replace(failed, data=dataclasses.replace(failed.data, trials=trials))
    found = compare([failed, wanted("b", RIGHT)])
    assert found.entries[0].why_none == "all of its 2 trials failed, the first: ValueError: x"
    assert found.entries[0].num_failed == 2
    assert "A has no scores" in said(found)
    both = compare([failed, dataclasses.replace(failed, name="c")])
    assert "A and B have no scores" in said(both)


def test_a_failed_seed_counts_as_the_worst_of_all_that_are_compared() -> None:
    left = wanted("a", [9.0, 8.0], [1.0, 1.0])
    trials = [left.data.trials[0].model_copy(update={"status": "failed"}), *left.data.trials[1:]]
    found = compare([dataclasses.replace(left, data=dataclasses.replace(left.data, trials=trials)), wanted("b", RIGHT)])
    assert found.entries[0].scores == (1.0, 8.0)
    assert "A failed seed counts as the worst training of all sweeps that are compared." in found.notes
    worse = wanted("b", [0.5, 7.0])
    ours = dataclasses.replace(left, data=dataclasses.replace(left.data, trials=trials))
    assert compare([ours, worse]).entries[0].scores == (0.5, 8.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e300])
def test_numbers_that_are_none_or_too_large_break_nothing(value: float) -> None:
    found = compare([wanted("a", [value, 3.0]), wanted("b", [value, -value])])
    assert said(found)
    assert found.entries[0].trial_ids or found.entries[0].why_none


def test_equal_scores_of_all_seeds_say_nothing_of_how_much_seeds_differ() -> None:
    pair = the_pair(compare([wanted("a", [5.0, 5.0]), wanted("b", [4.0, 4.0])]))
    assert "no two seeds of either differ" in pair.verdict
    assert present(pair.probability).mean == 1.0


def test_a_population_has_no_setting_to_compare() -> None:
    left = wanted("a", LEFT)
    found = compare(
        [dataclasses.replace(left, data=dataclasses.replace(left.data, has_settings=False)), wanted("b", RIGHT)]
    )
    assert "a population" in found.entries[0].why_none
    assert found.entries[0].num_env_steps > 0


# -- what a reader has to know


def test_different_envs_are_not_comparable_and_the_numbers_of_each_are_there() -> None:
    other = wanted("b", RIGHT)
    spec = {**other.sweep.spec, "env": {"id": "Acrobot-v1", "args": {}}}
    other = dataclasses.replace(other, sweep=other.sweep.model_copy(update={"spec": spec}))
    found = compare([wanted("a", LEFT), other])
    assert found.pairs == ()
    (reason,) = found.not_comparable
    assert "A is on CartPole-v0, B on Acrobot-v1" in reason
    assert [entry.mean for entry in found.entries] == [np.mean(LEFT), np.mean(RIGHT)]
    other_args = {**other.sweep.spec, "env": {"id": "CartPole-v0", "args": {"sutton_barto_reward": True}}}
    other = dataclasses.replace(other, sweep=other.sweep.model_copy(update={"spec": other_args}))
    assert "different arguments" in compare([wanted("a", LEFT), other]).not_comparable[0]


def test_where_objectives_differ_all_are_judged_by_final_or_as_asked_for() -> None:
    both = [wanted("a", LEFT, objective="best"), wanted("b", RIGHT, objective="area")]
    found = compare(both)
    assert found.objective == "final"
    assert "Their sweep files judge them differently (a by best, b by area)" in found.notes[0]
    asked = compare(both, "best")
    assert asked.objective == {entry.objective for entry in asked.entries}.pop() == "best"
    assert not any("differently" in note for note in asked.notes)


def test_where_thresholds_differ_nothing_is_said_of_solving() -> None:
    found = compare([wanted("a", LEFT, threshold=11.0), wanted("b", RIGHT, threshold=8.0)])
    assert [entry.num_solved for entry in found.entries] == [None, None]
    assert "other thresholds" in found.notes[0]
    steps = [
        wanted(name, LEFT, threshold=level, objective="steps_to_threshold") for name, level in [("a", 1), ("b", 2)]
    ]
    assert compare(steps).objective == "final"


def test_env_steps_to_the_threshold_are_a_median_in_which_who_never_reached_it_counts() -> None:
    found = compare([wanted("a", LEFT, threshold=11.0), wanted("b", [1.0, 20.0, 2.0], threshold=11.0)])
    ours, theirs = found.entries
    assert (ours.num_solved, ours.median_env_steps) == (4, 1000.0)
    assert (theirs.num_solved, theirs.median_env_steps) == (1, None)
    assert ours.median_lower is not None
    # One seed says when it reached the threshold, and nothing of others.
    (single, _) = compare([wanted("a", [12.0], threshold=11.0), wanted("b", [12.0], threshold=11.0)]).entries
    assert (single.median_env_steps, single.median_lower, single.median_upper) == (1000.0, None, None)
    rows = dict(fact_rows(found))
    assert rows["steps to 11"][1] == "not by half of the seeds"
    assert rows["solved by"] == ["4 of 5 seeds", "1 of 3 seeds"]


@pytest.mark.parametrize("status", ["failed", "stopped"])
def test_seeds_that_crashed_or_were_stopped_early_never_reached_the_threshold(status: str) -> None:
    """Four of five end at 1,000 env steps, far below it; the fifth reaches it in its last iteration."""
    ours = wanted("a", [1.0, 1.0, 1.0, 1.0, 20.0], threshold=11.0)
    *short, whole = ours.data.trials
    trials = [*(trial.model_copy(update={"status": status}) for trial in short), whole]
    last = ours.data.results["t0004"][0].model_copy(update={"num_env_steps": 50_200})
    data = dataclasses.replace(ours.data, trials=trials, results={**ours.data.results, "t0004": [last]})
    found = compare([dataclasses.replace(ours, data=data), wanted("b", LEFT, threshold=11.0)])
    rows = dict(fact_rows(found))
    assert rows["solved by"][0] == "1 of 5 seeds"
    assert rows["steps to 11"][0] == "not by half of the seeds"
    # Who completed a shorter training may have reached it later.
    shorter = dataclasses.replace(data, trials=ours.data.trials)
    longer = compare([dataclasses.replace(ours, data=shorter), wanted("b", LEFT, threshold=11.0)])
    assert longer.entries[0].median_env_steps == 50_200


def test_scores_of_steps_are_told_without_a_minus() -> None:
    # The other setting says how much seeds of the second sweep differ: without it there is no difference to tell.
    both = [wanted("a", [9.0, 1.0], threshold=5.0), wanted("b", [9.0, 9.0], [9.0, 1.0], threshold=5.0)]
    found = compare(both, "steps_to_threshold")
    assert dict(fact_rows(found))["env steps to goal"] == ["50,500", "1,000"]
    assert "A - B, over training seeds (env steps): +49,500" in said(found)


def test_a_running_sweep_is_told_with_how_far_it_is() -> None:
    left = wanted("a", LEFT, state="running")
    trials = [left.data.trials[0].model_copy(update={"status": "running"}), *left.data.trials[1:]]
    found = compare([dataclasses.replace(left, data=dataclasses.replace(left.data, trials=trials)), wanted("b", RIGHT)])
    assert "Sweep a is running: 4 of 5 trials have ended, and the numbers are those so far." in found.notes
    waiting = [trial.model_copy(update={"status": "pending"}) for trial in trials]
    found = compare(
        [dataclasses.replace(left, data=dataclasses.replace(left.data, trials=waiting)), wanted("b", RIGHT)]
    )
    assert found.entries[0].why_none == "none of its 5 trials has ended yet"


def test_the_wall_time_of_a_run_under_way_is_not_said_to_be_none() -> None:
    ours, theirs = wanted("a", LEFT, state="running", run_time_s=0.0), wanted("b", RIGHT, run_time_s=70.4)
    found = compare([ours, theirs])
    assert [entry.wall_s for entry in found.entries] == [None, 70.4]
    assert dict(fact_rows(found))["wall time"] == ["-", "1 min 10 s"]
    resumed = dataclasses.replace(ours, sweep=ours.sweep.model_copy(update={"run_time_s": 70.4}))
    assert dict(fact_rows(compare([resumed, theirs])))["wall time"] == ["1 min 10 s before this run", "1 min 10 s"]


def test_the_same_trainings_twice_are_told() -> None:
    left, right = wanted("a", LEFT), wanted("b", LEFT)
    assert not any("numbers twice" in note for note in compare([left, right]).notes)
    right = dataclasses.replace(right, data=dataclasses.replace(right.data, trials=left.data.trials))
    assert any("5 trainings with the same hyperparameters" in note for note in compare([left, right]).notes)


def test_versions_and_budgets_that_differ_are_told() -> None:
    left, right = wanted("a", LEFT), wanted("b", RIGHT, versions={"torch": "9.9"})
    right = dataclasses.replace(right, data=dataclasses.replace(right.data, num_env_steps=7))
    notes = "\n".join(compare([left, right]).notes)
    assert "torch 2.13.0, 9.9" in notes
    assert "A 50,000, B 7" in notes


# -- by name


def test_sweeps_settings_and_the_folders_of_trials_are_found(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "one")
    make_sweep_folder(tmp_path / "two", seed=3)
    found = tune_jobs.compare(["one", tmp_path / "two"], storage=tmp_path)
    assert [(entry.letter, entry.name, entry.is_sweep) for entry in found.entries] == [
        ("A", "one", True),
        ("B", "two", True),
    ]
    settings = tune_jobs.compare([tmp_path / "one" / "trials" / "t0001", "one/t0003"], storage=tmp_path)
    assert [entry.trial_ids for entry in settings.entries] == [("t0000", "t0001"), ("t0002", "t0003")]
    alone = tune_jobs.compare("one", storage=tmp_path)
    assert [entry.name for entry in alone.entries] == ["one/t0002", "one/t0000"]
    assert alone.entries[0].wall_s is None


@pytest.mark.parametrize(
    ("sources", "error", "message"),
    [
        (["one", "one"], SpecError, "one and one are the same sweep"),
        (["one/t0000", "one/t0001"], SpecError, "seeds of the same setting"),
        (["one/t0000"], SpecError, "Only one/t0000 was given"),
        ([], SpecError, "Nothing was given"),
        (["one", "none"], NotFoundError, "No sweep 'none'"),
        (["one", "none/t0001"], NotFoundError, "No sweep 'none/t0001'"),
        (["one", "one/t0009"], NotFoundError, "no trial 't0009'"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    tmp_path: Path, sources: list[str], error: type[Exception], message: str
) -> None:
    make_sweep_folder(tmp_path / "one")
    with pytest.raises(error, match=message):
        tune_jobs.compare(sources, storage=tmp_path)


@pytest.mark.parametrize("place", ["copy", "other/one"])
def test_a_copy_is_the_same_sweep_until_one_of_both_goes_on(tmp_path: Path, place: str) -> None:
    store = make_sweep_folder(tmp_path / "one")
    copied = SweepStore(shutil.copytree(store.folder, tmp_path / place))
    (tmp_path / "linked").symlink_to(store.folder)
    for pair in ([store.folder, copied.folder], [copied.folder, store.folder], [store.folder, tmp_path / "linked"]):
        with pytest.raises(SpecError, match=r"are the same sweep"):
            tune_jobs.compare(pair)
    extend_by_leaders(copied)
    found = tune_jobs.compare([store.folder, copied.folder])
    assert [entry.trial_ids for entry in found.entries] == [("t0002", "t0003"), ("t0004", "t0005")]
    assert "A and B have 4 trainings in common" in said(found)
    # Of a setting that neither has trained on there is nothing more.
    with pytest.raises(SpecError, match="seeds of the same setting"):
        tune_jobs.compare([store.folder / "trials" / "t0000", copied.folder / "trials" / "t0001"])
    apart = tune_jobs.compare([store.folder / "trials" / "t0000", copied.folder / "trials" / "t0005"])
    assert "in common" not in said(apart)


def test_copies_that_both_went_on_have_only_what_they_had_before_in_common(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "one")
    copied = SweepStore(shutil.copytree(store.folder, tmp_path / "copy"))
    for each in (store, copied):
        extend_by_leaders(each)
    with pytest.raises(SpecError, match="are the same sweep"):
        tune_jobs.compare([store.folder, copied.folder])
    for trial_id in ("t0004", "t0005"):
        trial = copied.trial(trial_id).read_record()
        others = {"hyperparams": {**trial.hyperparams, "lr": 0.5}, "evaluation_return": 1.0}
        copied.trial(trial_id).write_record(trial.model_copy(update=others))
    assert "A and B have 4 trainings in common" in said(tune_jobs.compare([store.folder, copied.folder]))
    new = tune_jobs.compare([each.folder / "trials" / "t0004" for each in (store, copied)])
    assert "in common" not in said(new)


def test_a_sweep_that_goes_on_between_two_looks_at_it_is_the_same_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make_sweep_folder(tmp_path / "one")

    def look(sweep: Sweep) -> SweepData:
        found = sweep_data(sweep)
        trial = store.trial("t0000").read_record()
        store.trial("t0000").write_record(trial.model_copy(update={"num_env_steps": trial.num_env_steps + 100}))
        return found

    monkeypatch.setattr("tune_jobs.sweeps.compare.sweep_data", look)
    with pytest.raises(SpecError, match="one and one are the same sweep"):
        tune_jobs.compare([store.folder, store.folder])


def test_a_sweep_of_one_setting_has_nothing_to_compare_it_with(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "one", num_samples=1)
    with pytest.raises(NotFoundError, match="no two settings"):
        tune_jobs.compare("one", storage=tmp_path)


def test_the_command_prints_facts_within_the_terminal_and_one_document(run: RunCommand, tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "one")
    make_sweep_folder(tmp_path / "two", seed=3)
    shown = run("compare", "one", "two", "--storage", tmp_path)
    assert shown.exit_code == 0
    assert "P(A > B), a training scores more" in shown.output
    document = json.loads(run("compare", "one", "two", "--json", "--storage", tmp_path).stdout)
    assert [entry["name"] for entry in document["entries"]] == ["one", "two"]
    assert document["pairs"][0]["probability"]["mean"] == 0.5
    assert run("compare", "one", "one", "--storage", tmp_path).exit_code == 2


def test_nothing_is_cut_on_eighty_columns(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.console import Console

    from tune_jobs.cli.comparison_view import _print_facts

    many = [wanted(f"a-sweep-with-a-name-longer-than-a-column-is-{number}", LEFT) for number in range(5)]
    console = Console(width=80, markup=False, highlight=False)
    _print_facts(console, compare(many))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    text = "".join(line.strip() for line in lines)
    assert "…" not in text
    assert all(f" {letter} " in "\n".join(lines) for letter in "ABCDE")


def test_the_command_offers_the_objectives_there_are() -> None:
    assert list(OBJECTIVES) == ObjectiveSpec.model_json_schema()["properties"]["type"]["enum"]
