"""What mattered in a sweep: on sweeps whose scores depend on known things."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from known_scores import SPACE, Score, by_activation, by_log_lr, draw, effect_of, slope_of_log_lr, sweep_of

from analysis.importance.edges import _beyond
from analysis.importance.scored import score_points
from analysis.importance.searched import Searched
from analysis.records import ChangeRecord


class TestImportance:
    def test_the_hyperparameter_that_scores_depend_on_comes_first_and_is_clear(self) -> None:
        first, *others = sweep_of(draw(30), by_activation).mattered.hyperparams
        assert first.name == "activation"
        assert first.is_clear
        assert first.share is not None
        assert (
            first.share > 0.45
        )  # the ranks of two groups that never mix have three quarters of their variance between
        assert not any(item.is_clear for item in others)
        assert {item.name for item in others} == {"lr", "hidden_sizes"}

    def test_a_best_value_in_the_middle_of_a_range_is_seen(self) -> None:
        first = sweep_of(draw(30), by_log_lr).mattered.hyperparams[0]
        assert first.name == "lr"
        assert first.share is not None
        assert first.share > 0.6

    def test_seeds_of_a_point_are_no_points(self) -> None:
        # One seed repeated ten times would make anything clear.
        points = draw(12, seed=3)
        noise = dict(zip(map(str, points), np.random.default_rng(5).standard_normal(len(points)), strict=True))
        mattered = sweep_of(points, lambda point: noise[str(point)], seeds=10, noise=0.0).mattered
        assert (mattered.num_points, mattered.num_trials) == (12, 120)
        assert not any(item.is_clear for item in mattered.hyperparams)

    def test_lists_are_values(self) -> None:
        points = draw(30)
        assert sweep_of(points, lambda point: 10.0 * len(point["hidden_sizes"])).mattered.names[0] == "hidden_sizes"

    def test_intervals_hold_the_share_and_shrink_with_points(self) -> None:
        few, many = (sweep_of(draw(count), by_activation).mattered.hyperparams[0] for count in (20, 150))
        widths = []
        for item in (few, many):
            assert item.low is not None
            assert item.high is not None
            assert item.share is not None
            assert 0.0 <= item.low <= item.share <= item.high <= 1.0
            widths.append(item.high - item.low)
        assert widths[1] < 0.6 * widths[0]

    def test_the_order_is_that_of_optuna_where_points_are_many(self) -> None:
        optuna = pytest.importorskip("optuna")
        points = draw(200, seed=4)
        sweep = sweep_of(points, lambda point: by_log_lr(point) + by_activation(point), noise=5.0)
        study = optuna.create_study(direction="maximize")
        distributions = {
            "lr": optuna.distributions.FloatDistribution(1e-5, 1e-1, log=True),
            "activation": optuna.distributions.CategoricalDistribution(["tanh", "relu"]),
            "hidden_sizes": optuna.distributions.CategoricalDistribution([1, 2]),
        }
        for point, rows in zip(points, sweep.results.values(), strict=True):
            params = point | {"hidden_sizes": len(point["hidden_sizes"])}
            value = rows[-1].evaluation_return
            study.add_trial(optuna.trial.create_trial(params=params, distributions=distributions, value=value))
        evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.5)
        theirs = optuna.importance.get_param_importances(study, evaluator=evaluator)
        assert sweep.mattered.names == tuple(theirs)

    def test_many_points_are_sampled_and_it_is_said(self) -> None:
        mattered = sweep_of(draw(600), by_activation, steps=lambda _: 100).mattered
        assert mattered.num_points == 500
        assert any("500 of the 600 points" in note for note in mattered.notes)
        assert mattered.hyperparams[0].is_clear

    def test_a_hyperparameter_with_one_value_comes_last_and_has_no_share(self) -> None:
        points = [point | {"gamma": 0.9} for point in draw(30)]
        last = sweep_of(points, by_activation, space={"gamma": {"choice": [0.9]}} | SPACE).mattered.hyperparams[-1]
        assert (last.name, last.share) == ("gamma", None)

    def test_a_hyperparameter_that_some_points_do_not_have(self) -> None:
        points = [{"a": index % 3, **({"b": 0.1 * index} if index % 2 else {})} for index in range(40)]
        mattered = sweep_of(points, lambda point: 5.0 * point["a"] + 10.0 * point.get("b", 0.0), space={}).mattered
        assert mattered.names == ("b", "a")
        assert mattered.hyperparams[0].is_clear
        assert [level.label for level in effect_of(mattered, "b").levels][-1] == "not set"


class TestEffects:
    def test_they_are_adjusted_for_what_was_drawn_with_them(self) -> None:
        # tanh mostly has the small learning rates, which are bad; the activation does nothing.
        points = draw(60)
        rng = np.random.default_rng(2)
        for point in points:
            small = rng.random() < (0.8 if point["activation"] == "tanh" else 0.2)
            point["lr"] = float(10 ** (rng.uniform(-5, -3) if small else rng.uniform(-3, -1)))
        score: Score = partial(slope_of_log_lr, slope=10.0)
        effect = effect_of(sweep_of(points, score).mattered, "activation")
        tanh, relu = effect.levels
        assert (tanh.label, relu.label) == ("tanh", "relu")
        assert relu.mean - tanh.mean > 8.0
        assert tanh.adjusted is not None
        assert relu.adjusted is not None
        assert abs(relu.adjusted - tanh.adjusted) < 2.0
        assert tanh.low is not None
        assert relu.high is not None
        assert tanh.low < relu.high

    def test_levels_that_share_nothing_are_not_compared(self) -> None:
        points = draw(20)
        for point in points:
            point["lr"] = 1e-5 * (1 + point["lr"]) if point["activation"] == "tanh" else 1e-2 * (1 + point["lr"])
        effect = effect_of(sweep_of(points, by_activation).mattered, "activation")
        assert all(level.adjusted is None for level in effect.levels)
        assert "activation tanh was tried with lr 1e-05" in effect.why_not_comparable
        assert all(math.isfinite(level.mean) for level in effect.levels)

    def test_one_astray_point_makes_no_overlap(self) -> None:
        points = draw(20)
        for point in points:
            point["lr"] = 1e-5 * (1 + point["lr"]) if point["activation"] == "tanh" else 1e-2 * (1 + point["lr"])
        next(point for point in points if point["activation"] == "relu")["lr"] = 1.001e-5
        assert effect_of(sweep_of(points, by_activation).mattered, "activation").why_not_comparable

    def test_a_level_amid_the_others_is_comparable(self) -> None:
        points = draw(20)
        amid = float(np.median([point["lr"] for point in points if point["activation"] == "relu"]))
        for point in points:
            point["lr"] = amid if point["activation"] == "tanh" else point["lr"]
        assert effect_of(sweep_of(points, by_activation).mattered, "activation").why_not_comparable == ""

    def test_a_range_has_three_parts_on_its_scale(self) -> None:
        effect = effect_of(sweep_of(draw(60), by_log_lr).mattered, "lr")
        assert [level.label for level in effect.levels] == [
            "1e-05 to 0.000215", "0.000215 to 0.00464", "0.00464 to 0.1"
        ]  # fmt: skip
        adjusted = [level.adjusted for level in effect.levels]
        assert max(adjusted, key=lambda value: value or -math.inf) == adjusted[1]

    def test_a_small_sweep_has_means_alone(self) -> None:
        effect = effect_of(sweep_of(draw(5), by_activation).mattered, "activation")
        assert all(level.adjusted is None and math.isfinite(level.mean) for level in effect.levels)


class TestInteractions:
    def test_a_pair_that_matters_together_is_named(self) -> None:
        def crossed(point: dict[str, Any]) -> float:
            return 5.0 if (point["activation"] == "tanh") == (len(point["hidden_sizes"]) == 1) else 0.0

        first, *others = sweep_of(draw(60), crossed).mattered.interactions
        assert set(first.names) == {"activation", "hidden_sizes"}
        assert first.share > 0.4
        assert others == []

    def test_a_sum_of_effects_is_no_interaction(self) -> None:
        named = [
            bool(sweep_of(draw(60, seed), lambda point: by_activation(point) + by_log_lr(point), seed=seed, noise=4.0)
                 .mattered.interactions)
            for seed in range(6)
        ]  # fmt: skip
        assert sum(named) <= 1


class TestEdges:
    def test_the_best_at_the_upper_end_asks_for_a_wider_range(self) -> None:
        score: Score = partial(slope_of_log_lr, slope=10.0)
        (edge,) = sweep_of(draw(40), score, algorithm="ppo").mattered.edges
        assert (edge.name, edge.side, edge.end) == ("lr", "high", 0.1)
        assert edge.domain == {"loguniform": [1e-05, 1.0]}
        assert "Widen it to lr: {loguniform: [1e-05, 1.0]}" in edge.text

    def test_the_lower_end(self) -> None:
        score: Score = partial(slope_of_log_lr, slope=-10.0)
        (edge,) = sweep_of(draw(40), score, algorithm="ppo").mattered.edges
        assert (edge.side, edge.domain) == ("low", {"loguniform": [1e-06, 0.1]})

    def test_a_best_value_inside_asks_for_nothing(self) -> None:
        assert sweep_of(draw(40), by_log_lr, algorithm="ppo").mattered.edges == ()

    def test_a_best_value_within_the_outer_fifth_is_inside(self) -> None:
        def near_the_end(point: dict[str, Any]) -> float:
            return -10.0 * abs(math.log10(point["lr"]) + 1.7)

        mattered = sweep_of(draw(60), near_the_end, noise=0.1, algorithm="ppo").mattered
        assert mattered.hyperparams[0].is_clear
        assert mattered.edges == ()

    @pytest.mark.parametrize(
        ("kind", "arguments", "found"), [("lograndint", (1, 100), set()), ("choice", (1, 10, 100), {0})]
    )
    def test_no_value_is_proposed_that_a_log_scale_lacks(self, kind: str, arguments: Any, found: set[int]) -> None:
        searched = Searched("learning_starts", kind, arguments, (1, 10, 100, 1, 1))
        assert {value for value in _beyond(searched, "low") if value <= 0} == found

    def test_no_value_is_proposed_that_the_algorithm_refuses(self) -> None:
        rng = np.random.default_rng(0)
        points = [{"gamma": float(rng.uniform(0.5, high))} for high in [1.0] * 40]
        space = {"gamma": {"uniform": [0.5, 1.0]}}
        assert sweep_of(points, lambda point: 40 * point["gamma"], space=space, algorithm="ppo").mattered.edges == ()
        space = {"gamma": {"uniform": [0.5, 0.99]}}
        points = [{"gamma": min(point["gamma"], 0.99)} for point in points]
        (edge,) = sweep_of(points, lambda point: 40 * point["gamma"], space=space, algorithm="ppo").mattered.edges
        assert edge.domain == {"uniform": [0.5, 1.0]}

    def test_whole_numbers_stay_whole(self) -> None:
        rng = np.random.default_rng(0)
        points = [{"num_epochs": int(rng.integers(1, 10))} for _ in range(40)]
        space = {"num_epochs": {"randint": [1, 10]}}
        (edge,) = sweep_of(points, lambda point: point["num_epochs"], space=space, algorithm="ppo").mattered.edges
        assert (edge.end, edge.domain) == (9, {"randint": [1, 13]})

    def test_listed_numbers_get_another_one(self) -> None:
        rng = np.random.default_rng(0)
        points = [{"num_epochs": int(rng.choice([2, 4, 8]))} for _ in range(40)]
        space = {"num_epochs": {"choice": [2, 4, 8]}}
        (edge,) = sweep_of(points, lambda point: point["num_epochs"], space=space, algorithm="ppo").mattered.edges
        assert edge.domain == {"choice": [2, 4, 8, 12]}


class TestWhatCannotBeSaid:
    def test_nothing_is_clear_of_scores_that_depend_on_nothing(self) -> None:
        clear = [
            any(item.is_clear for item in sweep_of(draw(20, seed), lambda _: 0.0, seed=seed).mattered.hyperparams)
            for seed in range(15)
        ]
        assert sum(clear) <= 2

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"points": draw(1)}, "One point alone"),
            ({"points": draw(7)}, "7 points are too few"),
            ({"points": draw(1) * 20}, "one value alone"),
            ({"score": lambda _: 1.0, "noise": 0.0}, "All points score the same"),
            ({"status": lambda _: "failed"}, "All trials failed"),
            ({"status": lambda _: "running"}, "No trial has ended"),
            ({"score": lambda _: math.nan}, "No trial showed a score"),
            ({"objective": {"type": "steps_to_threshold"}}, "objective.threshold"),
            ({"scheduler": {"type": "pbt"}}, "Population based training"),
        ],
    )
    def test_it_is_said_why(self, change: dict[str, Any], says: str) -> None:
        made: dict[str, Any] = {"points": draw(20), "score": by_activation}
        mattered = sweep_of(**made | change).mattered
        assert says in mattered.too_few
        assert mattered.names == ("lr", "activation", "hidden_sizes")
        assert all(item.share is None for item in mattered.hyperparams)

    def test_a_trial_that_changed_its_values_has_no_setting(self) -> None:
        sweep = sweep_of(draw(20), by_activation)
        change = ChangeRecord(
            iteration=1, num_env_steps=100, source_trial_id="t0001", source_iteration=1, before={}, after={}, time=0.0
        )
        sweep.trials[0] = sweep.trials[0].model_copy(update={"changes": (change,)})
        assert "Population based training" in sweep.mattered.too_few

    def test_no_trials(self) -> None:
        mattered = sweep_of([], by_activation).mattered
        assert mattered.names == ("lr", "activation", "hidden_sizes")
        assert mattered.too_few == "No trial has ended yet."


class TestOddNumbers:
    @pytest.mark.parametrize("scale", [1e-300, 1e300])
    def test_scores_of_any_size(self, scale: float) -> None:
        sweep = sweep_of(draw(20), lambda point: scale * by_activation(point), seeds=2, noise=0.0)
        mattered = sweep.mattered
        assert mattered.hyperparams[0].is_clear
        for level in effect_of(mattered, "activation").levels:
            assert level.adjusted is not None
            assert math.isfinite(level.adjusted)

    def test_what_is_no_domain_is_taken_from_the_points(self) -> None:
        space: dict[str, Any] = {
            "lr": "x",
            "activation": {"choice": 3},
            "hidden_sizes": None,
            "gamma": {"uniform": [1]},
        }
        mattered = sweep_of(draw(20), by_activation, space=space).mattered
        assert mattered.hyperparams[0].name == "activation"
        assert mattered.hyperparams[-1].name == "gamma"

    def test_two_that_always_go_together_are_not_told_apart(self) -> None:
        points = [point | {"twin": point["activation"]} for point in draw(30)]
        mattered = sweep_of(points, by_activation).mattered
        assert not any(item.is_clear for item in mattered.hyperparams)
        assert "activation tanh was tried with twin tanh" in effect_of(mattered, "activation").why_not_comparable


class TestFairness:
    def test_a_failed_trial_counts_as_the_worst(self) -> None:
        points = draw(30)
        failing = {index for index, point in enumerate(points) if point["activation"] == "relu"}
        mattered = sweep_of(points, lambda _: 0.0, status=lambda i: "failed" if i in failing else "completed").mattered
        assert mattered.hyperparams[0].name == "activation"
        assert mattered.hyperparams[0].is_clear
        assert any("counted as the worst" in note for note in mattered.notes)
        means = {level.label: level.mean for level in effect_of(mattered, "activation").levels}
        assert means["relu"] < means["tanh"]

    @pytest.mark.parametrize(("ended_at", "whole"), [(1_000, 1_000), (300, 300)])
    def test_by_env_steps_a_failed_trial_counts_as_one_that_never_reached_the_threshold(
        self, ended_at: int, whole: int
    ) -> None:
        sweep = sweep_of(
            draw(3), lambda _: 10.0,
            objective={"type": "steps_to_threshold", "threshold": 5.0},
            status=lambda index: ("failed", "stopped" if ended_at < 1_000 else "completed", "completed")[index],
            steps=lambda index: ended_at if index == 1 else 1_000,
        )  # fmt: skip
        scored = score_points(sweep.sweep, sweep.trials, sweep.results, None)
        assert scored.scores == (-2.0 * whole, -100.0, -100.0)

    def test_trials_that_were_ended_early_are_compared_with_others_at_the_same_env_steps(self) -> None:
        points = draw(30)
        sweep = sweep_of(
            points, lambda _: 0.0,
            status=lambda index: "stopped" if index % 3 else "completed",
            steps=lambda index: 300 + index % 2 * 100 if index % 3 else 1000,
        )  # fmt: skip
        # Had they been judged at their ends, activation would be all that matters.
        for trial in sweep.trials:
            if trial.status == "completed" and trial.point["activation"] == "tanh":
                rows = sweep.results[trial.trial_id]
                rows[3:] = [row.model_copy(update={"evaluation_return": 100.0}) for row in rows[3:]]
        mattered = sweep.mattered
        assert mattered.num_env_steps == 300
        assert any("20 of 30 trials early" in note for note in mattered.notes)
        assert not any(item.is_clear for item in mattered.hyperparams)
