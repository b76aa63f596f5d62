"""The figure for a paper: what it draws of settings, seeds and bands, and its files."""

import dataclasses
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats
from sweep_folders import make_sweep_folder
from synthetic_sweep import make_sweep

import tune_jobs
from analysis.exports.frames import SweepData
from analysis.exports.paper import learning_figure, save_figure, setting_curves
from analysis.records import IterationRecord, TrialRecord
from analysis.statistics import seed_intervals
from policies.errors import NotFoundError, SpecError
from tests.narrowing import present


def data_of(**given: Any) -> SweepData:
    made = make_sweep(**given)
    return SweepData(made.trials, made.results, "final", num_env_steps=50_000, threshold=195.0)


def held(curve: list[tuple[int, float]]) -> list[IterationRecord]:
    return [
        IterationRecord(iteration=i, num_env_steps=steps, num_episodes=9, time_s=1.0, evaluation_return=value)
        for i, (steps, value) in enumerate(curve, start=1)
    ]


def of_curves(*curves: list[tuple[int, float]]) -> SweepData:
    """One setting, with a seed for each curve."""
    made = make_sweep(points=[{"lr": 1e-3}], seeds_per_point=len(curves))
    results = {trial.trial_id: held(curve) for trial, curve in zip(made.trials, curves, strict=True)}
    return SweepData(made.trials, results, "final", num_env_steps=200, threshold=None)


def test_a_curve_is_the_mean_over_seeds_with_students_interval() -> None:
    (curve,) = setting_curves(of_curves([(100, 0.0), (200, 4.0)], [(100, 2.0), (200, 6.0)], [(100, 1.0), (200, 2.0)]),
                              top=3)  # fmt: skip
    assert curve.num_seeds == 3
    assert (curve.num_env_steps[0], curve.num_env_steps[-1]) == (100, 200)
    assert (curve.mean[0], curve.mean[-1]) == (1.0, 4.0)
    lower, upper = present(curve.lower), present(curve.upper)
    for place, values in ((0, [0.0, 2.0, 1.0]), (-1, [4.0, 6.0, 2.0])):
        expected = stats.t.interval(0.95, 2, loc=np.mean(values), scale=stats.sem(values))
        np.testing.assert_allclose([lower[place], upper[place]], expected)


def test_a_seed_that_ended_early_is_held_and_the_curve_says_from_where() -> None:
    (curve,) = setting_curves(of_curves([(100, 0.0), (150, 10.0)], [(100, 0.0), (200, 0.0)]), top=1)
    assert curve.first_end == 150
    assert curve.mean[-1] == 5.0


def test_a_seed_without_a_return_is_counted_though_no_curve_is_of_it() -> None:
    data = of_curves([(100, 0.0), (200, 4.0)], [(100, 2.0), (200, 6.0)], [])
    trials = [*data.trials[:2], data.trials[2].model_copy(update={"status": "failed"})]
    data = dataclasses.replace(data, trials=trials)
    (curve,) = setting_curves(data, top=1)
    assert (curve.num_seeds, curve.num_without, curve.mean[-1]) == (2, 1, 5.0)
    (label,) = [text.get_text() for text in learning_figure([("mine", data)]).legends[0].get_texts()]
    assert label.endswith("(2 of 3 seeds)")


def of_settings(*settings: tuple[dict[str, Any], list[list[tuple[int, float]]]]) -> SweepData:
    """A setting for each point, with a seed for each of its curves; the last of them scores most."""
    trials: list[TrialRecord] = []
    results: dict[str, list[IterationRecord]] = {}
    for place, (point, curves) in enumerate(settings):
        (made,) = make_sweep(points=[point], with_best=False).trials
        for seed, curve in enumerate(curves):
            trial_id = f"t{len(trials):04d}"
            given = {"trial_id": trial_id, "index": len(trials), "point_index": place, "seed_index": seed}
            trials.append(made.model_copy(update=given | {"point": point}))
            results[trial_id] = held(curve)
    return SweepData(trials, results, "final", num_env_steps=200, threshold=None)


def test_a_curve_begins_where_its_own_seeds_do_not_where_the_last_of_all_does() -> None:
    """As of a large train batch, of which an iteration is many env steps, beside a small one."""
    early = [[(10, 0.0), (100, 90.0)], [(20, 2.0), (100, 92.0)]]
    late = [[(70, 500.0), (100, 700.0)], [(80, 500.0), (100, 720.0)], [(70, 400.0), (100, 700.0)]]
    second, first = setting_curves(of_settings(({"lr": 0.1}, early), ({"lr": 0.2}, late)), top=2)[::-1]
    assert (second.label, first.label) == ("lr 0.1", "lr 0.2")
    assert [(curve.num_env_steps[0], curve.num_env_steps[-1]) for curve in (second, first)] == [(20, 100), (80, 100)]
    assert (second.mean[0], second.least) == (6.0, 2.0)
    assert second.num_env_steps.size > 100
    for curve in (first, second):
        assert present(curve.lower).shape == present(curve.upper).shape == curve.mean.shape
        assert (present(curve.lower) < curve.mean).all()
    # Alone until the other begins, of which the intervals then learn how much seeds differ.
    (alone,) = setting_curves(of_settings(({"lr": 0.1}, early)), top=1)
    expected = stats.t.interval(0.95, 1, loc=6.0, scale=stats.sem([10.0, 2.0]))
    assert (present(second.lower)[0], present(second.upper)[0]) == pytest.approx(expected)
    assert (present(alone.lower)[0], present(alone.upper)[0]) == pytest.approx(expected)
    own = [interval[-1] for interval in (present(second.lower), present(second.upper))]
    both = seed_intervals([[700.0, 720.0, 700.0], [90.0, 92.0]])[1]
    assert own == pytest.approx([both.lower, both.upper])


@pytest.mark.parametrize("num_late", [1, 2])
def test_bands_are_of_settings_with_several_seeds_wherever_others_begin(num_late: int) -> None:
    one, several = [[(10, 0.0), (100, 90.0)]], [[(50, 500.0), (100, 700.0)], [(50, 500.0), (100, 720.0)]][:num_late]
    late, early = setting_curves(of_settings(({"lr": 0.1}, one), ({"lr": 0.2}, several)), top=2)
    assert (early.num_env_steps[0], late.num_env_steps[0]) == (10, 50)
    assert early.lower is None
    assert (late.lower is None) == (num_late == 1)
    if late.lower is not None:
        assert late.lower.shape == late.mean.shape
        assert np.isfinite(late.lower).all()


def test_a_curve_of_one_place_is_a_dot_also_after_its_first_seed_has_ended() -> None:
    figure = learning_figure([("mine", of_curves([(100, 0.0)], [(200, 4.0)]))])
    dots = [line for line in figure.axes[0].lines if line.get_marker() == "o" and np.size(line.get_xdata())]
    assert [(np.ravel(line.get_xdata())[0], np.ravel(line.get_ydata())[0]) for line in dots] == [(200, 2.0)]


@pytest.mark.parametrize(
    ("points", "labels"),
    [
        ([{"lr": 0.001}, {"lr": 0.002}], ["lr 0.002", "lr 0.001"]),
        ([{"lr": 0.0012345}, {"lr": 0.0012312}], ["lr 0.001231", "lr 0.001234"]),
        ([{"lr": 0.00123412}, {"lr": 0.00123408}], ["1. lr 0.001234", "2. lr 0.001234"]),
        ([{"lr": 0.001}, {"lr": 0.001}], ["1. lr 0.001", "2. lr 0.001"]),
        ([{}, {}], ["1.", "2."]),
    ],
)
def test_no_two_settings_have_one_label(points: list[dict[str, Any]], labels: list[str]) -> None:
    curves = [[[(100, value), (200, value)]] for value in (1.0, 2.0)]
    data = of_settings(*zip(points, curves, strict=True))
    assert [curve.label for curve in setting_curves(data, top=2)] == labels


def test_one_seed_has_no_band() -> None:
    (curve,) = setting_curves(of_curves([(100, 0.0), (200, 1.0)]), top=1)
    assert curve.lower is None
    figure = learning_figure([("one", of_curves([(100, 0.0), (200, 1.0)]))])
    assert not figure.axes[0].collections


def test_the_leading_settings_are_drawn_with_bands_and_what_tells_them_apart() -> None:
    data = data_of(seeds_per_point=3)
    figure = learning_figure([("mine", data)], top=2)
    (axes,) = figure.axes
    assert len(axes.collections) == 2
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(labels) == 3
    assert all("lr" in label and "(3 seeds)" in label for label in labels[:2])
    assert labels[2] == "goal 195"


def test_curves_of_one_colour_are_told_apart_by_markers() -> None:
    """Also where they are dashed, and in the legend."""
    curves = [[[(100, float(score)), (150, float(score))], [(100, 1.0), (200, 2.0)]] for score in range(9)]
    data = of_settings(*(({"lr": 0.1 * (place + 1)}, seeds) for place, seeds in enumerate(curves)))
    figure = learning_figure([("mine", data)], top=9)
    solid, dashed = (
        [line for line in figure.axes[0].lines if (line.get_linestyle() == "-") == is_solid]
        for is_solid in (True, False)
    )
    handles = [line for line in figure.legends[0].get_lines() if str(line.get_label()).startswith("lr")]
    for lines in (solid, dashed, handles):
        looks = [(line.get_color(), line.get_marker()) for line in lines]
        assert len(looks) == len(set(looks)) == 9
        assert [marker for _, marker in looks[:6]] == [""] * 6
        assert "" not in [marker for _, marker in looks[6:]]
    # A few of them, or they would hide the line.
    for line in solid[6:]:
        assert 1 < len(np.asarray(line.get_xdata())[:: cast("int", line.get_markevery())]) < 10


def test_a_band_of_few_seeds_does_not_set_the_scale() -> None:
    figure = learning_figure([("two", of_curves([(100, 0.0), (200, 1.0)], [(100, 1.0), (200, 0.0)]))])
    # Student's t of two seeds: 0.5 -+ 6.35.
    assert figure.axes[0].get_ylim() == pytest.approx((-0.05, 1.05))


def test_several_sweeps_are_told_by_name(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "one")
    make_sweep_folder(tmp_path / "two", seed=5)
    figure = tune_jobs.figure(["one", "two"], top=1, storage=tmp_path, returns="evaluation", width=5, height=3)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [label.split(" ")[0] for label in labels[:2]] == ["one", "two"]
    assert tuple(figure.get_size_inches()) == (5, 3)


def test_returns_of_different_envs_share_no_axis(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "one")
    make_sweep_folder(tmp_path / "other", env={"id": "Acrobot-v1"})
    with pytest.raises(SpecError, match="one is on CartPole-v1, other on Acrobot-v1"):
        tune_jobs.figure(["one", "other"], storage=tmp_path)


def test_sweeps_of_one_name_are_told_by_place_and_share_no_axis_either(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for storage, env in (("a", "CartPole-v1"), ("b", "Acrobot-v1"), ("c", "CartPole-v1")):
        make_sweep_folder(tmp_path / storage / "mine", env={"id": env})
    with pytest.raises(SpecError, match="a/mine is on CartPole-v1, b/mine on Acrobot-v1"):
        tune_jobs.figure(["a/mine", "b/mine"])
    with pytest.raises(SpecError, match="no common axis"):
        tune_jobs.export(["a/mine", "b/mine"], format="png")
    figure = tune_jobs.figure(["a/mine", "c/mine"], top=1)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [label.split(" ")[0] for label in labels[:2]] == ["a/mine", "c/mine"]


def test_without_anything_to_draw_it_says_so() -> None:
    data = data_of()
    with pytest.raises(NotFoundError, match="nothing to draw: no setting of mine"):
        learning_figure([("mine", dataclasses.replace(data, results={}))])


@pytest.mark.parametrize(("kind", "begins"), [("pdf", b"%PDF"), ("svg", b"<?xml"), ("png", b"\x89PNG")])
def test_files_are_of_their_kind_and_the_same_each_time(tmp_path: Path, kind: str, begins: bytes) -> None:
    data = data_of(points=[{"lr": 1e-3, "activation": "$x$"}, {"lr": 2e-3, "activation": "y"}], seeds_per_point=2)
    first = save_figure(learning_figure([("mine", data)]), tmp_path / "a" / f"figure.{kind}")
    second = save_figure(learning_figure([("mine", data)]), tmp_path / "b" / f"figure.{kind}")
    assert first.read_bytes().startswith(begins)
    assert first.read_bytes() == second.read_bytes()
    if kind == "pdf":
        assert b"/Type3" not in first.read_bytes()
