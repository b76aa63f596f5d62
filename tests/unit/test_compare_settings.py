"""Settings of one sweep side by side, and those that two sweeps have in common."""

import dataclasses
import json
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
    assert shared.left_iqm.mean == pytest.approx(stats.trim_mean([100.0, 90.0, 10.0, 80.0], 0.25))


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
