"""Where `stop.num_iterations` ends trainings, what one scores and costs that ended before is of that length."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from report_sources import source_of
from sweep_folders import make_sweep_folder
from synthetic_sweep import Synthetic, make_sweep
from test_prior import begun, write_earlier

from analysis.charts import Subject
from analysis.comparison.compare import compare
from analysis.comparison.entries import Wanted
from analysis.exports.frames import SweepData, make_frame, ranked_settings
from analysis.importance.scored import score_points
from analysis.objectives import SettingScores, env_steps_of, score_of
from analysis.page.cost import section as cost_section
from analysis.page.next_steps import section as steps_section
from analysis.records import TRAINING_LENGTH, IterationRecord, Objective, TrialRecord, TrialStatus, whole_length
from policies.hyperparams import Algorithm, make_hyperparams
from tests.narrowing import present
from tune_jobs.plan.estimates import iteration_env_steps, planned_env_steps
from tune_jobs.search.history import KnownPoint, known_points
from tune_jobs.search.prior import _mean_cost
from tune_jobs.search.study import make_study
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.spec.training_length import as_trained
from tune_jobs.sweeps.gathered import sweep_data
from tune_jobs.sweeps.policy_choice import most_env_steps
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
    assert {setting.scores for setting in ranked(spec, TRIALS, RESULTS, None)} == {(-2.0 * WHOLE,)}


def reaching(index: int, point: int, seed: int, at: int | None) -> tuple[TrialRecord, list[IterationRecord]]:
    """A trial of all its iterations, and the one of them from which on it reaches the threshold."""
    record = trial(index, "completed", MOST, point_index=point, seed_index=seed, point={"lr": 1e-3 * (point + 1)})
    return record, rows(*(float(at is not None and number >= at) for number in range(1, MOST + 1)))


def test_never_to_reach_a_threshold_counts_as_twice_the_longest_training() -> None:
    """One seed of five that doesn't was as bad as forty trainings, where only the iterations end them."""
    made = [reaching(seed, 0, seed, at) for seed, at in enumerate((3, 3, 3, 3, None))]
    made += [reaching(5 + seed, 1, seed, 19) for seed in range(5)]
    trials, results = [record for record, _ in made], {record.trial_id: items for record, items in made}
    objective = {"type": "steps_to_threshold", "threshold": 1.0}
    best, other = ranked(spec_of(objective=objective), trials, results, None)
    assert (best.point_index, other.point_index) == (0, 1)
    assert min(best.scores) == -2.0 * WHOLE
    gathered = SweepData(trials, results, "steps_to_threshold", 200_000, threshold=1.0, num_iterations=MOST)
    assert make_frame(gathered, "trials")["objective_score"].min() == -2.0 * WHOLE
    assert order(ranked_settings(gathered)) == [0, 1]
    # It is one number, of the longest: whose iterations are shorter does not fail more cheaply, nor does a crash.
    shorter = trials[4].model_copy(update={"hyperparams": {"train_batch_size": 256, "minibatch_size": 64}})
    crashed = trials[9].model_copy(update={"status": "failed"})
    scores = [
        item.scores for item in ranked(spec_of(objective=objective), [shorter, crashed, trials[0]], results, None)
    ]
    assert sorted(scores) == [(-2.0 * WHOLE,), tuple(sorted((-3.0 * BATCH, -2.0 * WHOLE), reverse=True))]


def test_a_search_is_told_twice_the_longest_training_that_it_may_choose() -> None:
    space = {"train_batch_size": {"choice": [256, 600]}, "num_envs": {"choice": [8, 512]}}
    objective = {"type": "steps_to_threshold", "threshold": 1.0}
    spec = spec_of(objective=objective, space=space, search="gp", hyperparams={"minibatch_size": 64})
    for values in ({"train_batch_size": 256, "num_envs": 8}, {"train_batch_size": 600, "num_envs": 512}):
        told = present(judging_of(spec, make_sweep().sweep, values, {**values, "minibatch_size": 64}))
        assert told.num_env_steps == 1_024 * MOST


def test_sweeps_that_are_compared_share_the_longest_training() -> None:
    record, items = reaching(0, 0, 0, None)
    one = SweepData([record], {"t0000": items}, "steps_to_threshold", 200_000, threshold=1.0, num_iterations=MOST)
    other = replace(one, num_iterations=2 * MOST)
    wanted = [Wanted(name, make_sweep().sweep, data, 1.0) for name, data in (("mine", one), ("other", other))]
    comparison = compare(wanted)
    assert comparison.longest_env_steps == 2 * WHOLE
    assert [entry.mean for entry in comparison.entries] == [-4.0 * WHOLE] * 2
    notes = " ".join(comparison.notes)
    assert f"Trials may take different numbers of env steps: A {WHOLE:,}, B {2 * WHOLE:,}." in notes
    assert f"counts as {4 * WHOLE:,} env steps, twice the longest" in notes


# -- iterations end with whole steps of all sub-environments, and with a phase of them


@pytest.mark.parametrize(
    ("algorithm", "values", "length"),
    [
        ("ppo", {"train_batch_size": 256, "minibatch_size": 64, "num_envs": 512}, 512),
        ("ppo", {"train_batch_size": 1_000, "num_envs": 512}, 1_024),
        ("ppo", {"train_batch_size": 1_024, "num_envs": 512}, 1_024),
        ("dqn", {"env_steps_per_iteration": 1_000, "train_freq": 48, "num_envs": 32}, 1_024),
    ],
)
def test_an_iteration_is_of_whole_steps(algorithm: Algorithm, values: dict[str, Any], length: int) -> None:
    made = make_hyperparams(algorithm, values)
    assert iteration_env_steps(made) == length
    ends: list[tuple[TrialStatus, int]] = [("completed", MOST), ("stopped", 10)]
    whole, cut = (
        trial(0, status, iterations, num_env_steps=length * iterations, hyperparams=made.model_dump(mode="json"))
        for status, iterations in ends
    )
    assert [env_steps_of(each, 200_000, MOST) for each in (whole, cut)] == [length * MOST] * 2
    spec = spec_of(algorithm=algorithm, space={}, scheduler={}, hyperparams=values)
    assert planned_env_steps(spec, made) == length * MOST


@pytest.mark.parametrize("objective", ["final", "area"])
def test_who_ended_by_itself_is_judged_by_its_own_length(objective: Objective) -> None:
    """With several env runners an iteration may be longer than its hyperparameters tell."""
    longer = TRIALS[0].model_copy(update={"hyperparams": {"train_batch_size": BATCH // 2}})
    expected = score_of(longer, RESULTS["t0000"], objective, num_env_steps=WHOLE)
    assert score_of(longer, RESULTS["t0000"], objective, num_env_steps=200_000, num_iterations=MOST) == expected


def test_what_an_earlier_sweep_tells_of_costs_is_of_the_same_length() -> None:
    known = KnownPoint({"lr": 1e-3}, (1.0, 1.0), env_steps=(WHOLE, WHOLE + 8))
    assert _mean_cost(known, spec_of(search="gp")) == WHOLE


def test_choosing_the_best_policy_may_take_a_share_of_what_was_trained() -> None:
    trials = [trial(index, "completed", MOST) for index in range(MOST)]
    by_steps = most_env_steps(spec_of(stop={"num_env_steps": WHOLE}), trials)
    assert most_env_steps(spec_of(), trials) == by_steps < most_env_steps(spec_of(stop={}), trials)


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


def test_what_mattered_counts_a_threshold_that_is_never_reached_as_twice_the_longest_training() -> None:
    made = synthetic()
    never = {"type": "steps_to_threshold", "threshold": 900.0}
    sweep = made.sweep.model_copy(update={"spec": {**made.sweep.spec, "objective": never}})
    trials = [TRIALS[0], trial(1, "completed", MOST)]
    reached = rows(*(1_000.0 for _ in range(MOST)))
    scores = score_points(sweep, trials, {**RESULTS, "t0001": reached}, None).scores
    assert scores == (-2.0 * WHOLE, -1.0 * BATCH)


def test_in_a_population_the_length_of_an_iteration_may_change() -> None:
    made = synthetic()
    spec = {**made.sweep.spec, "scheduler": {"type": "pbt"}, "objective": "final"}
    now = TRIALS[0].model_copy(update={"hyperparams": {"train_batch_size": 256}})
    source = source_of(made)
    changed = made.sweep.model_copy(update={"spec": spec})
    subject = Subject(changed, [now], RESULTS, None, source.importance)
    assert subject.scores["t0000"] == score_of(TRIALS[0], RESULTS["t0000"], "final", num_env_steps=WHOLE)
    stopped = TRIALS[1].model_copy(update={"hyperparams": {"train_batch_size": 256}})
    facts = dict(cost_section(replace(source, sweep=changed, trials=[stopped])).facts)
    assert facts["early stopping"].startswith("the scheduler ended 1 trial before 200,000 env steps, which saved 95 %")


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
