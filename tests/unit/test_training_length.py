"""The length of training as a searched value: from the sweep file to what each trial is planned and judged by."""

from typing import Any

import pytest
import yaml
from report_sources import source_of
from spec_errors import MINIMAL, errors
from test_report_sections import ppo_sweep, steps_of, with_spec

from analysis.page.cost import section as cost_section
from analysis.records import TRAINING_LENGTH, ReplicationRecord, TrialRecord
from policies.errors import SpecError
from policies.hyperparams import make_hyperparams
from tune_jobs.plan.estimates import max_env_steps
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.search.chosen_point import checked_point
from tune_jobs.spec.file import json_schema, load_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.spec.training_length import as_trained, ends_of
from tune_jobs.store.transitions import pending_record
from tune_jobs.sweeps.forecast import caps_of

LENGTHS = [2_000, 5_000, 20_000]
BATCH = {"train_batch_size": 512, "num_envs": 8}


def spec_of(domain: dict[str, Any] | None = None, **fields: Any) -> SweepSpec:
    space = {TRAINING_LENGTH: domain or {"grid": LENGTHS}, **fields.pop("space", {})}
    return load_spec({**MINIMAL, "hyperparams": BATCH, "space": space, **fields})


def planned(*records: TrialRecord, **fields: Any) -> SweepPlan:
    return make_plan(spec_of(**fields), Machine(2), records)


@pytest.mark.parametrize(
    ("domain", "ends"),
    [
        ({"grid": LENGTHS}, (2_000, 20_000)),
        ({"choice": [2e4, 5_000]}, (5_000, 20_000)),
        ({"randint": [1_000, 9_000]}, (1_000, 8_999)),
        ({"qlograndint": [1_000, 9_000, 500]}, (1_000, 9_000)),
        ({"qloguniform": [1_000, 9_000, 500]}, (1_000, 9_000)),
    ],
)
def test_the_longest_is_the_sweeps_own_length(domain: dict[str, Any], ends: tuple[int, int]) -> None:
    spec = spec_of(domain)
    assert ends_of(spec.space[TRAINING_LENGTH]) == ends
    assert spec.stop.num_env_steps == ends[1]
    assert SweepSpec.model_validate(spec.model_dump(mode="json")) == spec
    # What else says how a trial ends stays.
    assert spec_of(domain, stop={"time_s": 9}).stop == spec.stop.model_copy(update={"time_s": 9})
    assert spec_of(domain, stop={"num_env_steps": ends[1]}) == spec


def test_it_is_set_and_taken_out_by_options() -> None:
    option = f"space.{TRAINING_LENGTH}="
    assert load_spec(MINIMAL, [f"{option}{{choice: [600, 700]}}"]).stop.num_env_steps == 700
    assert load_spec({**MINIMAL, "space": {TRAINING_LENGTH: {"choice": [1, 2]}}}, [option]) == load_spec(MINIMAL)
    for rule in json_schema()["allOf"]:
        assert TRAINING_LENGTH in rule["then"]["properties"]["space"]["properties"]


def wrong(domain: Any, **fields: Any) -> str:
    return errors(space={TRAINING_LENGTH: domain}, **fields)


@pytest.mark.parametrize(
    ("domain", "fields", "said"),
    [
        ({"grid": LENGTHS}, {"stop": {"num_env_steps": 9_000}}, "stop.num_env_steps: is 9,000, but the length of "),
        ({"choice": [0, 5]}, {}, f"space.{TRAINING_LENGTH}.choice[0]: 0 is not allowed: it should be at least 1"),
        ({"choice": [2.5, 5]}, {}, f"space.{TRAINING_LENGTH}.choice[0]: 2.5 is not allowed: it should be a whole"),
        ({"choice": ["5", 5]}, {}, "'5' is of the wrong type: write 5 if that is meant"),
        ({"choice": [True, 5]}, {}, "true is not a number"),
        ({"loguniform": [10, 99]}, {}, "stop.num_env_steps must be a whole number: use lograndint"),
        ({"randint": [-5, 99]}, {}, "-5 is not allowed: it should be at least 1"),
        ({"choice": []}, {}, "is empty: list at least one value"),
        ({"choice": [5_000, 5e3]}, {}, "lists 5000 twice"),
        (5_000, {}, "5000 is one value: fix it as stop.num_env_steps, or write {grid: [5000]}"),
        ({"grid": LENGTHS}, {"scheduler": "hyperband"}, "cannot be used with scheduler.type hyperband"),
        ({"grid": LENGTHS}, {"scheduler": "pbt", "num_samples": 3}, "cannot be used with scheduler.type pbt"),
        (
            {"grid": LENGTHS},
            {"scheduler": {"type": "asha", "grace_env_steps": 2_000}},
            f"grace_env_steps: 2,000 is not less than 2,000, the shortest training of space.{TRAINING_LENGTH}",
        ),
        ({"grid": LENGTHS}, {"scheduler": {"type": "asha", "grace_env_steps": 30_000}}, "no trial would ever be ended"),
    ],
)  # fmt: skip
def test_what_is_no_length_is_refused(domain: Any, fields: dict[str, Any], said: str) -> None:
    assert said in wrong(domain, **fields)


@pytest.mark.parametrize("name", ["num_env_steps", "stop"])
def test_who_calls_it_otherwise_is_told_its_name(name: str) -> None:
    assert f"write space: {{{TRAINING_LENGTH}: ...}}" in errors(space={name: {"choice": [5, 6]}})
    assert f"write space: {{{TRAINING_LENGTH}: ...}}" in errors(hyperparams={name: 5})


def test_a_trial_is_planned_with_its_own_length_and_no_algorithm_sees_it() -> None:
    made, spec = planned(seeds_per_point=2), spec_of(seeds_per_point=2)
    values = make_hyperparams("ppo", BATCH)
    assert [trial.point[TRAINING_LENGTH] for trial in made.trials] == [2_000, 2_000, 5_000, 5_000, 20_000, 20_000]
    assert all(TRAINING_LENGTH not in trial.hyperparams for trial in made.trials)
    each = [max_env_steps(load_spec({**MINIMAL, "stop": {"num_env_steps": length}}), values) for length in LENGTHS]
    assert made.max_env_steps == 2 * sum(each)
    assert made.max_disk_bytes < make_plan(spec_of({"grid": [20_000]}, num_samples=6), Machine(2)).max_disk_bytes
    caps = caps_of(spec, [pending_record(trial) for trial in made.trials])
    assert list(caps.values()) == [2_000, 2_000, 5_000, 5_000, 20_000, 20_000]
    assert as_trained(spec, {TRAINING_LENGTH: 2e3}).stop.num_env_steps == 2_000
    assert as_trained(spec, {"lr": 1.0}) is spec


def test_more_seeds_of_a_setting_are_as_long_as_it_says() -> None:
    more = ReplicationRecord(num_points=3, points=(2, 0))
    made = make_plan(spec_of(), Machine(2), replications=[more])
    assert [trial.point[TRAINING_LENGTH] for trial in made.trials[3:]] == [20_000, 2_000]
    assert made.max_env_steps == sum(
        max_env_steps(as_trained(spec_of(), trial.point), make_hyperparams("ppo", BATCH)) for trial in made.trials
    )


def test_points_that_are_not_chosen_yet_may_be_the_longest() -> None:
    made = planned(
        domain={"choice": LENGTHS}, space={"lr": {"loguniform": [1e-4, 1e-2]}}, num_samples=4,
        search={"type": "tpe", "num_startup_trials": 1},
    )  # fmt: skip
    values = make_hyperparams("ppo", BATCH)
    first = as_trained(spec_of(), made.trials[0].point)
    assert made.max_env_steps == max_env_steps(first, values) + 3 * max_env_steps(spec_of(), values)


def test_less_than_one_iteration_is_no_length_of_its_own() -> None:
    with pytest.raises(SpecError, match="500 is less than one iteration, which has 512 env steps"):
        planned(domain={"grid": [500, 9_000]})
    assert len(planned(domain={"grid": [512, 9_000]}).trials) == 2
    with pytest.raises(SpecError, match=r"10 is less than one iteration.*\(env_steps_per_iteration\)"):
        planned(domain={"grid": [10, 9_000]}, algorithm="dqn", hyperparams={})


def test_a_point_of_ones_own_has_a_length_up_to_the_longest() -> None:
    from tune_jobs.plan.points import point_hyperparams

    spec = spec_of()
    assert checked_point(spec, {TRAINING_LENGTH: 3_000}) == {TRAINING_LENGTH: 3_000}
    with pytest.raises(SpecError, match="whole number"):
        checked_point(spec, {TRAINING_LENGTH: 3_000.5})
    with pytest.raises(SpecError, match=f"it has no {TRAINING_LENGTH}"):
        checked_point(spec, {})
    with pytest.raises(SpecError, match=r"30,000 of the new point .* is more than 20,000, the longest training"):
        point_hyperparams(spec, checked_point(spec, {TRAINING_LENGTH: 30_000}), None)


def test_what_can_not_act_in_a_short_training_is_noted_of_that_one() -> None:
    made = planned(
        domain={"grid": [1_000, 9_000]}, algorithm="dqn",
        hyperparams={"learning_starts": 5_000, "env_steps_per_iteration": 500},
    )  # fmt: skip
    assert [note for note in made.notes if note.startswith("In 1 of 2 points (0)")]


def test_what_follows_from_a_sweep_has_the_length_of_the_setting() -> None:
    made = ppo_sweep()
    assert made.best is not None
    assert made.best.settings is not None
    best_ids = made.best.settings.best.trial_ids
    for index, trial in enumerate(made.trials):
        point = trial.point | {TRAINING_LENGTH: 10_000 if trial.trial_id in best_ids else 50_000}
        made.trials[index] = trial.model_copy(update={"point": point})
    space = {**made.sweep.spec["space"], TRAINING_LENGTH: {"choice": [10_000, 25_000, 50_000]}}
    made = with_spec(made, space=space)
    source = source_of(made)
    assert source.settings is not None
    best = next(trial for trial in made.trials if trial.trial_id in source.settings.best.trial_ids)
    length = best.point[TRAINING_LENGTH]
    assert length == 10_000
    ranking = [item.model_copy(update={"point": best.point}) for item in source.settings.ranking]
    settings = source.settings.model_copy(update={"ranking": tuple(ranking)})
    made.best = made.best and made.best.model_copy(update={"settings": settings})
    steps = steps_of(made)
    alone = load_spec(yaml.safe_load(steps["Train the setting by itself"].text))
    assert alone.stop.num_env_steps == length
    assert TRAINING_LENGTH not in alone.hyperparams
    assert f"total_timesteps={length}" in steps["The setting in Stable-Baselines3"].text
    load_spec(yaml.safe_load(steps["Search a narrower space"].text))
    assert "the env steps that they were to have" in dict(cost_section(source_of(made)).facts)["early stopping"]
