"""Settings of one sweep side by side, and those that two sweeps have in common."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compared_sweeps import LEFT, RIGHT, said, the_pair, wanted
from scipy import stats
from sweep_folders import make_sweep_folder

import tune_jobs
from analysis.comparison.compare import compare
from analysis.comparison.entries import Wanted
from analysis.points import meaning_of
from analysis.statistics import moderated_means
from policies.errors import NotFoundError, SpecError
from tests.narrowing import present
from tune_jobs.spec.domain_kinds import text_of
from tune_jobs.store.sweep_store import SweepStore

# -- two settings of one sweep


def settings_of(*points: list[float]) -> list[Wanted]:
    """The first two settings of a sweep of points with these scores."""
    return [wanted("a", *points, point_index=index) for index in (0, 1)]


@pytest.mark.parametrize("others", [(), ([5.0, 6.5], [1.0, 2.0, 3.5])])
def test_where_variances_do_not_differ_it_is_students_interval_by_the_one_variance(others: tuple[list[float]]) -> None:
    points = ([10.0, 12.0], [15.0, 17.0], *others)
    assert moderated_means(points).common_variance
    difference = present(the_pair(compare(settings_of(*points))).difference)
    df = sum(len(scores) - 1 for scores in points)
    pooled = sum(float(np.var(scores, ddof=1)) * (len(scores) - 1) for scores in points) / df
    expected = stats.t.interval(0.95, df, loc=-5.0, scale=np.sqrt(pooled))
    np.testing.assert_allclose([difference.lower, difference.upper], expected)
    if not others:
        # With twice the degrees of freedom, as Welch's rule has it, they would be told apart.
        student = stats.ttest_ind(*points).confidence_interval(0.95)
        np.testing.assert_allclose([difference.lower, difference.upper], student)
        assert difference.lower < 0 < difference.upper


def test_there_are_no_more_degrees_of_freedom_than_the_sweep_has() -> None:
    points = ([10.0, 10.1, 10.2], [15.0, 25.0, 11.0], [1.0, 2.0, 1.5])
    fit = moderated_means(points)
    assert not fit.common_variance
    squares = fit.standard_errors[:2] ** 2
    welch = squares.sum() ** 2 / (squares**2 / fit.dfs[:2]).sum()
    assert welch > 6.0
    difference = present(the_pair(compare(settings_of(*points))).difference)
    half = stats.t.ppf(0.975, 6.0) * np.sqrt(squares.sum())
    assert difference.upper - difference.mean == pytest.approx(half)


def test_sweeps_of_one_name_are_two_sweeps() -> None:
    pair = the_pair(compare([wanted("a", LEFT), wanted("a", RIGHT, created_at=1.0)]))
    welch = stats.ttest_ind(LEFT, RIGHT, equal_var=False).confidence_interval(0.95)
    assert present(pair.difference).lower == pytest.approx(welch.low)


def running(item: Wanted, **changes: Any) -> Wanted:
    """The same, of a sweep whose last trial has not ended."""
    trials = [*item.data.trials[:-1], item.data.trials[-1].model_copy(update={"status": "running"})]
    sweep = item.sweep.model_copy(update={"state": "running"})
    return dataclasses.replace(item, data=dataclasses.replace(item.data, trials=trials), sweep=sweep, **changes)


def test_a_renamed_sweep_and_a_new_one_of_its_name_are_told_as_two() -> None:
    """The record of a sweep whose folder was renamed has the name of before."""
    old, new = wanted("a", LEFT), wanted("a", LEFT, created_at=1.0)
    old = dataclasses.replace(old, name="a-old")
    found = compare([old, new])
    assert [entry.sweep for entry in found.entries] == ["a-old", "a"]
    assert any("A and B have 5 trainings with the same" in note for note in found.notes)
    told = [note for note in compare([running(old), running(new)]).notes if "have ended" in note]
    assert [note.partition(" is running: 4 of 5 trials")[0] for note in told] == ["Sweep a-old", "Sweep a"]
    # One whose seeds are not known to differ is replicated by the name that it has now.
    single = dataclasses.replace(wanted("a", [1.0]), name="a-old")
    assert "`tune-jobs replicate a-old`" in said(compare([single, new]))


def test_sweeps_of_one_name_in_two_storages_are_told_as_two() -> None:
    ours, theirs = wanted("a", LEFT), wanted("a", LEFT, created_at=1.0)
    assert any("numbers twice" in note for note in compare([ours, theirs]).notes)
    assert not any("numbers twice" in note for note in compare([ours, ours]).notes), "told where copies are read"
    told = [note for note in compare([running(ours), running(theirs)]).notes if "have ended" in note]
    assert len(told) == 2
    settings = [running(wanted("a", LEFT, RIGHT, point_index=index)) for index in (0, 1)]
    assert len([note for note in compare(settings).notes if "have ended" in note]) == 1


def test_renamed_folders_are_compared_by_the_names_that_they_have(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "one")
    store.folder.rename(tmp_path / "one-old")
    again = make_sweep_folder(tmp_path / "one")
    again.write_record(again.read_record().model_copy(update={"created_at": 1.0}))
    found = tune_jobs.compare(["one-old", "one/t0002"], storage=tmp_path)
    assert [entry.sweep for entry in found.entries] == ["one-old", "one"]


def test_a_sweep_and_the_setting_that_leads_it_are_the_same_trainings() -> None:
    found = compare([wanted("a", RIGHT, LEFT), wanted("a", RIGHT, LEFT, point_index=1)])
    pair = the_pair(found)
    assert (pair.difference, pair.probability) == (None, None)
    same = "A is compared by its leading setting, and that is B."
    assert pair.verdict == f"Whether A or B is better can't be said: {same}"
    assert f"P(A > B) can't be given: {same}" in said(found)
    other = the_pair(compare([wanted("a", RIGHT, LEFT), wanted("a", RIGHT, LEFT, point_index=0)]))
    assert other.verdict == "A is better than B."


# -- settings in common


def test_all_points_of_equal_values_are_one_setting() -> None:
    left = wanted("a", [100.0], [90.0], [10.0], [80.0], values=[0.1, 0.1, 0.1, 0.2])
    right = wanted("b", [50.0], [70.0], values=[0.1, 0.2])
    shared = present(the_pair(compare([left, right])).shared)
    assert shared.num_settings == 2
    # Two of three are above 50, and 80 is above 70.
    assert shared.probability.mean == pytest.approx((2 / 3 + 1) / 2)
    # The other sweep has one seed of each, so the first ones count.
    assert shared.left_iqm.mean == pytest.approx(stats.trim_mean([100.0, 80.0], 0.25))


def test_seeds_that_a_race_gave_raise_no_sweeps_interquartile_mean() -> None:
    plain = [[50.0 * level - 2, 50.0 * level + 2] for level in range(1, 9)]
    raced = [[*seeds, *(seeds * 3 if index >= 6 else [])] for index, seeds in enumerate(plain)]
    shared = present(the_pair(compare([wanted("a", *raced), wanted("b", *plain)])).shared)
    assert shared.probability.mean == 0.5
    for iqm in (shared.left_iqm, shared.right_iqm):
        assert iqm.mean == pytest.approx(stats.trim_mean(np.concatenate(plain), 0.25))


def test_the_seeds_that_came_first_count_of_points_that_are_one_setting() -> None:
    """The second point of equal values ranks first, as its seed was the better one."""
    left, right = wanted("a", [10.0, 30.0, 40.0], [90.0], values=[0.1, 0.1]), wanted("b", [50.0], values=[0.1])
    # The race came when both points were trained.
    came = {"t0000": 0, "t0003": 1, "t0001": 2, "t0002": 3}
    trials = [trial.model_copy(update={"index": came[trial.trial_id]}) for trial in left.data.trials]
    left = dataclasses.replace(left, data=dataclasses.replace(left.data, trials=trials))
    shared = present(the_pair(compare([left, right])).shared)
    assert shared.left_iqm.mean == 10.0


@pytest.mark.parametrize(
    ("one", "other", "equal"),
    [
        (2e3, 2000, True),
        ([64], 64, True),
        ([64.0], [64], True),
        ([64.0, 32], [64, 32], True),
        ([0.5], 0.5, True),
        ([64, 64], 64, False),
        (True, 1, False),
        ([True], True, False),
        (None, 0, False),
        ("64", 64, False),
        (["relu"], "relu", False),
    ],
)
def test_settings_are_the_same_however_numbers_are_written(one: Any, other: Any, equal: bool) -> None:
    pair = the_pair(compare([wanted("a", LEFT, values=[one]), wanted("b", RIGHT, values=[other])]))
    assert (pair.shared is not None) == equal
    # As in sweep files.
    assert (text_of(one) == text_of(other)) == equal
    points = [{"gamma": 0.5, "x": one}, {"x": other, "gamma": 0.5}]
    assert (meaning_of(points[0]) == meaning_of(points[1])) == equal


@pytest.mark.parametrize(("fixed", "num_common"), [(50_000, 2), (20_000, 0)])
def test_a_length_of_training_that_one_sweep_searches_may_be_the_fixed_one_of_another(
    fixed: int, num_common: int
) -> None:
    left, right = wanted("a", LEFT, RIGHT), wanted("b", RIGHT, LEFT)
    left = dataclasses.replace(left, data=dataclasses.replace(left.data, num_env_steps=fixed))
    trials = [
        trial.model_copy(update={"point": {**trial.point, "stop.num_env_steps": 5e4}}) for trial in right.data.trials
    ]
    space = {**right.sweep.section("space"), "stop.num_env_steps": {"grid": [25_000, 50_000]}}
    sweep = right.sweep.model_copy(update={"spec": {**right.sweep.spec, "space": space}})
    right = dataclasses.replace(right, data=dataclasses.replace(right.data, trials=trials), sweep=sweep)
    for pair in ([left, right], [right, left]):
        shared = the_pair(compare(pair)).shared
        assert (0 if shared is None else shared.num_settings) == num_common


# -- the settings of one sweep, by what they are judged by


def make_spiking_sweep(folder: Path) -> SweepStore:
    """A sweep of four settings, of which the last one ends best, and the first had the best evaluation once."""
    store = make_sweep_folder(folder, num_samples=4, seeds_per_point=1)
    file = folder / "trials" / "t0000" / "results.jsonl"
    first, *others = file.read_text().splitlines(keepends=True)
    file.write_text("".join([json.dumps(json.loads(first) | {"evaluation_return": 1000.0}) + "\n", *others]))
    return store


def test_the_leading_settings_lead_by_the_objective_that_is_asked_for(tmp_path: Path) -> None:
    make_spiking_sweep(tmp_path / "one")
    by_best = tune_jobs.compare("one", objective="best", top=2, storage=tmp_path)
    assert [(entry.name, entry.mean) for entry in by_best.entries] == [("one/t0000", 1000.0), ("one/t0003", 36.0)]
    by_file = tune_jobs.compare("one", top=2, storage=tmp_path)
    assert by_file.objective == "final"
    assert [entry.name for entry in by_file.entries] == ["one/t0003", "one/t0002"]


def test_where_no_settings_can_be_ranked_it_is_said_why(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "one", env={"id": "Pendulum-v1"})
    with pytest.raises(
        NotFoundError, match="the env steps to a threshold, and neither its sweep file nor its env"
    ) as of:
        tune_jobs.compare("one", objective="steps_to_threshold", storage=tmp_path)
    assert of.value.hint == "Ask for another objective."
    assert len(tune_jobs.compare("one", storage=tmp_path).entries) == 2
    with pytest.raises(SpecError, match="1 leading setting"):
        tune_jobs.compare("one", top=1, storage=tmp_path)
    for trial in store.read_trials():
        failed = trial.model_copy(update={"status": "failed", "error": "ValueError: x"})
        store.trial(trial.trial_id).write_record(failed)
    with pytest.raises(NotFoundError, match="all of its 4 trials failed, the first: ValueError: x"):
        tune_jobs.compare("one", storage=tmp_path)
    make_sweep_folder(tmp_path / "single", num_samples=1)
    with pytest.raises(NotFoundError, match="one of its settings alone has been trained"):
        tune_jobs.compare("single", storage=tmp_path)


def test_sweeps_of_other_thresholds_are_not_said_to_have_none() -> None:
    both = [wanted("a", LEFT, threshold=11.0), wanted("b", RIGHT, threshold=8.0)]
    found = compare(both, "steps_to_threshold")
    assert {entry.why_none for entry in found.entries} == {
        "it is judged by the env steps to a threshold, and they share none"
    }
    alike = [dataclasses.replace(item, data=dataclasses.replace(item.data, threshold=None)) for item in both]
    assert "neither its sweep file nor" in compare(alike, "steps_to_threshold").entries[0].why_none


# -- Atari games


def atari(**frames: int) -> dict[str, Any]:
    kept = {"frame_skip": 4, "noop_max": 30, "screen_size": 84, "terminal_on_life_loss": True, "clip_rewards": True}
    return {"id": "ALE/Pong-v5", "args": {}, "atari": kept | frames}


@pytest.mark.parametrize(
    ("other", "differs"),
    [
        (atari(), ""),
        (atari(screen_size=42, clip_rewards=False, terminal_on_life_loss=False), ""),
        (atari(frame_skip=1), "'atari.frame_skip': 1"),
        (atari(noop_max=0), "'atari.noop_max': 0"),
        ({"id": "ALE/Pong-v5", "args": {}}, "and {}"),
    ],
)
def test_what_changes_the_returns_of_a_game_is_an_argument(tmp_path: Path, other: dict[str, Any], differs: str) -> None:
    stores = [make_sweep_folder(tmp_path / name) for name in "ab"]
    for store, env in zip(stores, (atari(), other), strict=True):
        record = store.read_record()
        store.write_record(record.model_copy(update={"spec": record.spec | {"env": env}, "env_threshold": 18.0}))
    reasons = tune_jobs.compare(["a", "b"], storage=tmp_path).not_comparable
    if not differs:
        assert reasons == ()
        assert tune_jobs.figure(["a", "b"], storage=tmp_path).axes
        return
    assert "A and B give ALE/Pong-v5 different arguments" in reasons[0]
    assert differs in reasons[0]
    with pytest.raises(SpecError, match="with other arguments: their returns have no common axis"):
        tune_jobs.figure(["a", "b"], storage=tmp_path)


def with_spec(wanted_one: Wanted, **spec: Any) -> Wanted:
    changed = {**wanted_one.sweep.spec, **spec}
    return dataclasses.replace(wanted_one, sweep=wanted_one.sweep.model_copy(update={"spec": changed}))


def without_points(wanted_one: Wanted) -> Wanted:
    """The sweep as one that searches nothing."""
    trials = [trial.model_copy(update={"point": {}}) for trial in wanted_one.data.trials]
    return dataclasses.replace(wanted_one, data=dataclasses.replace(wanted_one.data, trials=trials))


@pytest.mark.parametrize(
    ("one", "other", "why"),
    [
        ({"algorithm": "ppo"}, {"algorithm": "dqn"}, "a trains with ppo and b with dqn"),
        (
            {"rl_module": None}, {"rl_module": "mine:Net"},
            "a trains with the built-in network and b with mine:Net",
        ),
        ({"hyperparams": {"gamma": 0.9}}, {"hyperparams": {"gamma": 0.8}}, "gamma is 0.9 in a and 0.8 in b"),
        ({"hyperparams": {"gamma": 0.9}}, {"hyperparams": {}}, "gamma is 0.9 in a and 0.99 in b"),
        (
            {"hyperparams": {"gamma": 0.9, "gae_lambda": 0.9, "num_epochs": 1, "clip_param": 0.1}}, {"hyperparams": {}},
            "gamma is 0.9 in a and 0.99 in b, and 1 more differs",
        ),
    ],
)  # fmt: skip
@pytest.mark.parametrize("searches", [True, False])
def test_other_algorithms_networks_or_fixed_values_are_no_common_setting(
    one: dict[str, Any], other: dict[str, Any], why: str, searches: bool
) -> None:
    # What both search is lr, with one value; or they search nothing.
    left, right = (
        with_spec(wanted(name, scores), space={"lr": {"grid": [0.1]}} if searches else {}, **spec)
        for name, scores, spec in (("a", LEFT, one), ("b", RIGHT, other))
    )
    found = compare([left, right] if searches else [without_points(left), without_points(right)])
    pair = the_pair(found)
    assert pair.shared is None
    assert f"{why}, so only the leading ones are compared." in said(found)
    assert pair.probability is not None


@pytest.mark.parametrize(
    "fixed",
    [{"lr": 0.2}, {"lr": 0.2, "gamma": 0.99}, {"lr": 0.2, "num_epochs": 6.0, "hidden_sizes": 64}],
)
def test_a_value_that_one_searches_and_another_fixes_or_writes_out_is_the_same(fixed: dict[str, Any]) -> None:
    left = with_spec(
        wanted("a", [5.0, 6.0], [50.0, 60.0], values=[0.1, 0.2]),
        space={"lr": {"grid": [0.1, 0.2]}}, hyperparams={"hidden_sizes": [64]} if "hidden_sizes" in fixed else {},
    )  # fmt: skip
    right = without_points(with_spec(wanted("b", [55.0, 49.0]), space={}, hyperparams=fixed))
    shared = present(the_pair(compare([left, right])).shared)
    assert shared.num_settings == 1
    # 50 and 60 beside 55 and 49.
    assert shared.probability.mean == pytest.approx(3 / 4)


def test_engines_and_versions_on_one_grid_have_their_settings_in_common() -> None:
    left = with_spec(wanted("a", LEFT), engine="packed")
    right = with_spec(wanted("b", RIGHT, versions={"torch": "9.9"}), engine="rllib")
    assert present(the_pair(compare([left, right])).shared).num_settings == 1


# -- the same trainings twice


def beside_the_same(*rows: dict[str, Any], **other: Any) -> bool:
    """Whether two sweeps are said to have the same numbers twice; all but the fields of `other` are equal.

    Args:
        *rows: The fields of the iterations of the one training.
        **other: Fields of the last iteration of the other sweep.
    """
    left, right = wanted("a", [5.0]), wanted("b", [5.0])

    def filled(one: Wanted, *items: dict[str, Any]) -> Wanted:
        known = one.data.results["t0000"][0]
        made = [known.model_copy(update={"iteration": i, **item}) for i, item in enumerate(items, start=1)]
        return dataclasses.replace(
            one, data=dataclasses.replace(one.data, trials=left.data.trials, results={"t0000": made})
        )

    pair = [filled(left, *rows), with_spec(filled(right, *rows[:-1], {**rows[-1], **other}), frame_stack=4)]
    return any("1 training with the same hyperparameters" in note for note in compare(pair).notes)


def test_only_trainings_of_equal_numbers_are_the_same_twice() -> None:
    rows: list[dict[str, Any]] = [
        {"num_env_steps": 1000, "episode_returns": (-200.0, math.nan), "learner": {"loss": 0.5, "kl": None}},
        {"num_env_steps": 2000, "episode_returns": (-200.0,), "learner": {"loss": 0.25}},
    ]
    assert beside_the_same(*rows)
    assert not beside_the_same(*rows, episode_returns=(-200.0, -200.0))
    assert not beside_the_same(*rows, num_env_steps=2008)
    assert not beside_the_same(*rows, evaluation_return=6.0)
    # No episode has reached the goal, and the losses differ all the same.
    assert not beside_the_same(*rows, learner={"loss": 0.26})
    # One of them is evaluated less often, or still runs.
    assert beside_the_same(*rows, evaluation_return=None)
    assert beside_the_same(*rows, iteration=3)
    assert not beside_the_same(rows[0], iteration=3)


def test_evaluations_on_other_seeds_do_not_make_trainings_others() -> None:
    left, right = wanted("a", [5.0]), wanted("b", [6.0], evaluation_seeds=(7, 8))
    right = dataclasses.replace(right, data=dataclasses.replace(right.data, trials=left.data.trials))
    alike = right.data.results["t0000"][0].model_copy(update={"training_return": 5.0})
    right = dataclasses.replace(right, data=dataclasses.replace(right.data, results={"t0000": [alike]}))
    assert any("numbers twice" in note for note in compare([left, right]).notes)
    of_the_same = dataclasses.replace(
        right, sweep=right.sweep.model_copy(update={"evaluation_seeds": left.sweep.evaluation_seeds})
    )
    assert not any("numbers twice" in note for note in compare([left, of_the_same]).notes)
