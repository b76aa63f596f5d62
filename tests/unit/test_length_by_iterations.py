"""Where `stop.num_iterations` ends trainings, what one scores and costs that ended before is of that length."""

from pathlib import Path
from typing import Any

import pytest
from report_sources import source_of
from sweep_folders import make_sweep_folder
from synthetic_sweep import Synthetic, make_sweep
from test_prior import begun, write_earlier

from analysis.charts import Subject
from analysis.exports.frames import SweepData, make_frame, ranked_settings
from analysis.importance.scored import score_points
from analysis.objectives import SettingScores, env_steps_of, score_of
from analysis.page.cost import section as cost_section
from analysis.page.next_steps import section as steps_section
from analysis.records import TRAINING_LENGTH, IterationRecord, TrialRecord, TrialStatus, whole_length
from policies.hyperparams import Algorithm, make_hyperparams
from tests.narrowing import present
from tune_jobs.plan.estimates import planned_env_steps
from tune_jobs.search.history import known_points
from tune_jobs.search.study import make_study
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.spec.training_length import as_trained
from tune_jobs.sweeps.gathered import sweep_data
from tune_jobs.sweeps.settings import judged, ranked
from tune_jobs.training.scoring import Judging, judging_of

BATCH, MOST = 1_024, 20
WHOLE = BATCH * MOST
VALUES: dict[str, Any] = {"train_batch_size": BATCH}


def spec_of(**changes: Any) -> SweepSpec:
    """The env steps are those that nobody wrote."""
    given: dict[str, Any] = {
        "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-4, 1e-2]}}, "num_samples": 12,
        "scheduler": "asha", "stop": {"num_iterations": MOST}, "objective": ["area", "env_steps"],
    }  # fmt: skip
    return load_spec(given | changes)


def trial(index: int, status: TrialStatus, iterations: int, **changes: Any) -> TrialRecord:
    reason = f"num_iterations {iterations} >= {iterations}" if status == "completed" else None
    record = TrialRecord(
        trial_id=f"t{index:04d}", index=index, point_index=index, seed=index, point={"lr": 1e-3 * (index + 1)},
        hyperparams=VALUES, status=status, num_env_steps=BATCH * iterations, stop_reason=reason,
    )  # fmt: skip
    return record.model_copy(update=changes)


def rows(*evaluations: float) -> list[IterationRecord]:
    return [
        IterationRecord(
            iteration=number, num_env_steps=BATCH * number, num_episodes=number, time_s=1.0, evaluation_return=value
        )
        for number, value in enumerate(evaluations, start=1)
    ]


# The second was stopped behind the first, and would have to rise at once to 150 to be as good.
TRIALS = [trial(0, "completed", MOST), trial(1, "stopped", 10)]
RESULTS = {
    "t0000": rows(*(10.0 * number for number in range(1, 11)), *(101.0 + number for number in range(10))),
    "t0001": rows(*(9.9 * number for number in range(1, 11))),
}
ORDER = [0, 1]
REACHED = TRIALS[1].model_copy(update={"status": "completed", "stop_reason": "evaluation_return 99 >= 99"})
"""As the second, but that it reached its goal there."""


def order(settings: list[SettingScores]) -> list[int]:
    return [item.point_index for item in settings]


@pytest.mark.parametrize(
    ("algorithm", "hyperparams"),
    [
        ("ppo", {"train_batch_size": 512, "minibatch_size": 64}), ("ppo", {"train_batch_size": 8_192}),
        ("dqn", {"env_steps_per_iteration": 100}), ("dqn", {"env_steps_per_iteration": 8_192}),
        ("random", {}), ("constant", {"action": 0}),
    ],
)  # fmt: skip
@pytest.mark.parametrize("point", [{}, {TRAINING_LENGTH: 700}, {TRAINING_LENGTH: 90_000}])
def test_a_trials_length_is_that_which_its_plan_tells(
    algorithm: Algorithm, hyperparams: dict[str, Any], point: dict[str, Any]
) -> None:
    spec = spec_of(algorithm=algorithm, stop={"num_env_steps": 50_000, "num_iterations": 10}, space={}, scheduler={})
    values = make_hyperparams(algorithm, hyperparams)
    found = whole_length(point, values.model_dump(mode="json"), num_env_steps=50_000, num_iterations=10)
    assert found == planned_env_steps(as_trained(spec, point), values)


def test_of_a_record_that_does_not_say_how_long_an_iteration_is_the_env_steps_alone_are_known() -> None:
    for values in ({}, {"train_batch_size": "?"}):
        assert whole_length({}, values, num_env_steps=50_000, num_iterations=10) == 50_000
    assert whole_length({}, VALUES, num_env_steps=50_000) == 50_000


def test_one_that_was_stopped_behind_another_is_not_ranked_before_it() -> None:
    assert order(ranked(spec_of(), TRIALS, RESULTS, None)) == ORDER
    settings = present(judged(spec_of(), TRIALS, RESULTS, None))
    assert [item.point_index for item in settings.ranking] == ORDER
    # Both are as long, so that the better one alone is on the front.
    front = present(settings.front)
    assert [(item.point_index, item.num_env_steps) for item in front.points] == [(0, WHOLE)]


def test_seeds_that_were_added_are_judged_by_the_same_length() -> None:
    """They are stopped by no scheduler, but may fail or reach a goal."""
    seeds = [
        trial(2, "failed", 3, point_index=0, seed_index=1, point=TRIALS[0].point),
        REACHED.model_copy(update={"trial_id": "t0003", "index": 3, "seed_index": 1}),
    ]
    results = {**RESULTS, "t0003": RESULTS["t0001"]}
    best, other = ranked(spec_of(seeds_per_point=1), [*TRIALS, *seeds], results, None)
    failed, reached = (best, other) if best.point_index == 0 else (other, best)
    assert failed.env_steps == (WHOLE, WHOLE)
    assert reached.env_steps == (WHOLE, 10 * BATCH)
    assert reached.scores[0] == reached.scores[1]


@pytest.mark.parametrize(("length", "expected"), [(12 * BATCH, 12 * BATCH), (90_000, WHOLE)])
def test_of_a_searched_length_and_the_iterations_that_counts_which_ends_it_first(length: int, expected: int) -> None:
    domain = {"lr": {"loguniform": [1e-4, 1e-2]}, TRAINING_LENGTH: {"choice": [12 * BATCH, 90_000]}}
    spec = spec_of(space=domain, search="gp")
    stopped = trial(1, "stopped", 10, point={"lr": 2e-3, TRAINING_LENGTH: length})
    (setting,) = ranked(spec, [stopped], RESULTS, None)
    assert setting.env_steps == (expected,)
    assert setting.scores == (score_of(stopped, RESULTS["t0001"], "area", num_env_steps=expected),)
    (known,) = known_points(spec, [stopped])
    assert known.env_steps == (expected,)
    judging = judging_of(spec, make_sweep().sweep, stopped.point, stopped.hyperparams)
    assert judging == Judging("area", expected, at_evaluations=True)


def test_a_search_learns_the_same_score_and_cost() -> None:
    spec = spec_of(search="gp")
    whole, stopped = known_points(spec, TRIALS)
    assert whole.env_steps == stopped.env_steps == (WHOLE,)
    judging = judging_of(spec, make_sweep().sweep, TRIALS[1].point, TRIALS[1].hyperparams)
    assert judging == Judging("area", WHOLE, at_evaluations=True)


def test_one_that_begins_with_it_too(tmp_path: Path) -> None:
    """A random search told no scores, so that they are made of its results."""
    store = write_earlier(tmp_path, objective="area", stop={"num_iterations": MOST})
    reached, whole = store.read_trials()[:2]
    for record, like in ((whole, TRIALS[0]), (reached, REACHED)):
        fields = {name: getattr(like, name) for name in ("status", "num_env_steps", "stop_reason", "hyperparams")}
        store.trial(record.trial_id).write_record(record.model_copy(update=fields))
        store.trial(record.trial_id).append_iterations(RESULTS[like.trial_id])
    for record in store.read_trials()[2:]:
        store.trial(record.trial_id).write_record(record.model_copy(update={"status": "pending"}))
    _, (prior,) = begun(tmp_path)
    shares = {item.point["lr"]: present(item.share) for item in prior.points}
    assert shares[whole.point["lr"]] > shares[reached.point["lr"]]


def test_steps_to_a_threshold_count_one_number_where_it_is_never_reached() -> None:
    spec = spec_of(objective={"type": "steps_to_threshold", "threshold": 900.0})
    assert {setting.scores for setting in ranked(spec, TRIALS, RESULTS, None)} == {(-400_000.0,)}


# -- what else shows scores and costs


def test_what_is_made_of_a_sweep_folder_knows_it(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine", stop={"num_iterations": MOST})
    assert sweep_data(store).num_iterations == MOST


def data() -> SweepData:
    return SweepData(TRIALS, RESULTS, "area", num_env_steps=200_000, threshold=None, num_iterations=MOST)


EXPECTED = score_of(TRIALS[1], RESULTS["t0001"], "area", num_env_steps=WHOLE)


def test_tables_have_the_same_scores() -> None:
    assert order(ranked_settings(data())) == ORDER
    assert list(make_frame(data(), "trials")["objective_score"])[1] == EXPECTED
    assert list(make_frame(data(), "settings")["num_env_steps"]) == [WHOLE, WHOLE]


def test_so_has_a_study_of_optuna() -> None:
    pytest.importorskip("optuna")
    assert make_study(spec_of(), data(), "mine").trials[1].value == EXPECTED


def synthetic(**stop: Any) -> Synthetic:
    made = make_sweep(points=[trial.point for trial in TRIALS])
    spec = spec_of(stop={"num_iterations": MOST, **stop}).model_dump(mode="json")
    best = present(made.best)
    settings = present(judged(spec_of(), TRIALS, RESULTS, None))
    return Synthetic(
        made.sweep.model_copy(update={"spec": spec}), TRIALS, RESULTS, best.model_copy(update={"settings": settings})
    )


def test_the_report_has_the_same_scores_and_lengths() -> None:
    source = source_of(made := synthetic())
    assert order(source.ranked) == ORDER
    subject = Subject(made.sweep, TRIALS, RESULTS, None, source.importance)
    assert order(subject.settings) == ORDER
    assert subject.scores["t0001"] == EXPECTED
    saved = dict(cost_section(source).facts)["early stopping"]
    assert "before the env steps that they were to have, which saved 25 % of the env steps of all" in saved
    steps = {step.title: step.text for step in steps_section(source).steps}
    assert f"total_timesteps={WHOLE}" in steps["The setting in Stable-Baselines3"]


def test_what_mattered_is_of_the_same_scores() -> None:
    """With no scheduler: one that reached its goal goes on as it was for as long as it was to be."""
    made = synthetic(evaluation_return=99.0)
    assert score_points(made.sweep, [REACHED], RESULTS, None).scores == (EXPECTED,)


def test_in_a_population_the_length_of_an_iteration_may_change() -> None:
    made = synthetic()
    spec = {**made.sweep.spec, "scheduler": {"type": "pbt"}, "objective": "final"}
    now = TRIALS[0].model_copy(update={"hyperparams": {"train_batch_size": 256}})
    source = source_of(made)
    subject = Subject(made.sweep.model_copy(update={"spec": spec}), [now], RESULTS, None, source.importance)
    assert subject.scores["t0000"] == score_of(TRIALS[0], RESULTS["t0000"], "final", num_env_steps=WHOLE)


def test_what_a_training_takes_is_no_more_than_its_iterations() -> None:
    for status in ("stopped", "failed"):
        assert env_steps_of(trial(0, status, 3), 200_000, MOST) == WHOLE
        assert env_steps_of(trial(0, status, 3), 200_000) == 200_000
    assert env_steps_of(trial(0, "completed", 3), 200_000, MOST) == 3 * BATCH


def test_the_process_that_trains_is_told_how_long_its_trial_is(tmp_path: Path) -> None:
    from tune_jobs.ray_tune.trainable import TaskReader

    store = write_earlier(tmp_path, objective="area", search="gp", stop={"num_iterations": MOST})
    store.trial("t0000").write_record(TRIALS[0])
    assert TaskReader(store.place).read("t0000").judging == Judging("area", WHOLE)
