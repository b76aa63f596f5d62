"""`confirm`: which sweeps train their leading settings again, how often, and in which rounds."""

from typing import Any

import pytest

from analysis.answers import replicas_text
from analysis.objectives import SettingScores
from analysis.racing import Race, race_within
from analysis.records import ReplicationRecord, SweepRecord, TrialRecord
from policies.errors import SpecError
from tune_jobs.spec.file import json_schema, stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.confirm import confirming_race, different_points, may_confirm, recent_rounds, trials_before

CAP = 1_000


def spec(**changes: Any) -> SweepSpec:
    fields: dict[str, Any] = {
        "env": "CartPole-v1",
        "algorithm": "ppo",
        "hyperparams": {"train_batch_size": 100, "minibatch_size": 50, "num_envs": 1},
        "space": {"lr": {"uniform": [1e-4, 1e-2]}},
        "num_samples": 6,
        "stop": {"num_env_steps": CAP},
    }
    return SweepSpec.model_validate(fields | changes)


def trials(
    num_points: int, *, steps: int = CAP, seeds: int = 1, more: tuple[int, ...] = (), reason: str = "num_env_steps"
) -> list[TrialRecord]:
    places = [(point, seed) for point in range(num_points) for seed in range(seeds)] + [
        (point, seeds) for point in more
    ]
    return [
        TrialRecord(
            trial_id=f"t{index:04d}", index=index, point_index=point, seed_index=seed, seed=index, point={"lr": 0.001},
            hyperparams={"train_batch_size": 100, "minibatch_size": 50, "num_envs": 1}, status="completed",
            num_env_steps=steps, stop_reason=f"{reason} 1 >= 1",
        )
        for index, (point, seed) in enumerate(places)
    ]  # fmt: skip


def race(made: SweepSpec, records: list[TrialRecord]) -> Race | None:
    points = sorted({trial.point_index for trial in records})
    return confirming_race(made, points, records)


def record(made: SweepSpec, *rounds: ReplicationRecord) -> SweepRecord:
    num_trials = made.num_samples * made.seeds_per_point + sum(len(item.points) for item in rounds)
    return SweepRecord(
        name="mine", state="completed", spec=made.model_dump(mode="json"), evaluation_seeds=(1,),
        confirmation_seeds=(2,), created_at=0.0, num_trials=num_trials, replications=rounds,
    )  # fmt: skip


def added(num_points: int, *points: int, by: Any = "confirm") -> ReplicationRecord:
    return ReplicationRecord(num_points=num_points, points=points, by=by)


# -- the largest race


@pytest.mark.parametrize("allowed", range(31))
def test_the_largest_race_never_takes_more_trainings_than_allowed(allowed: int) -> None:
    found = race_within(range(20), top=5, num_seeds=5, max_trainings=allowed)
    if allowed < 2:
        assert found is None
        return
    assert found is not None
    assert found.max_trainings <= allowed
    # All five race as soon as that many trainings are allowed; until then, as many as are.
    assert len(found.contenders) == min(5, allowed)
    larger = Race(found.contenders, found.num_seeds + 1)
    assert found.num_seeds == 5 or larger.max_trainings > allowed


def test_one_setting_has_nothing_to_race_with() -> None:
    assert race_within([3], top=5, num_seeds=5, max_trainings=100) is None
    assert race_within([], top=5, num_seeds=5, max_trainings=100) is None


def test_equal_points_race_once() -> None:
    def setting(index: int, lr: float) -> SettingScores:
        return SettingScores(index, {"lr": lr}, (1.0,), (f"t{index:04d}",), 0, 1.0, (CAP,))

    found = different_points([setting(3, 0.1), setting(0, 0.2), setting(5, 0.1), setting(1, 0.3), setting(2, 0.2)])
    assert found == [3, 0, 1]


# -- the share


@pytest.mark.parametrize(("share", "most"), [(0.5, 10), (0.25, 5), (1.0, 14), (0.09, None), (0.1, 2)])
def test_a_race_takes_no_larger_share_of_the_env_steps_than_is_declared(share: float, most: int | None) -> None:
    found = race(spec(confirm={"max_share": share}), trials(20))
    assert (None if found is None else found.max_trainings) == most


@pytest.mark.parametrize("reason", ["training_return", "evaluation_return"])
def test_trials_that_reached_their_goal_early_leave_less_to_spend(reason: str) -> None:
    # A training of the race may take the whole cap, though those of the search took half of it.
    found = race(spec(), trials(20, steps=CAP // 2, reason=reason))
    assert found is not None
    assert found.max_trainings == 5
    # One that did not reach it says how long such a training is.
    records = trials(20, steps=CAP // 2, reason=reason)
    records[7] = records[7].model_copy(update={"stop_reason": "num_iterations 5 >= 5"})
    found = race(spec(), records)
    assert found is not None
    assert found.max_trainings == 10
    assert race(spec(), trials(20, steps=0)) is None


@pytest.mark.parametrize("reason", ["num_episodes", "num_iterations", "time_s"])
def test_trainings_that_end_by_other_rules_count_with_the_longest_of_the_search(reason: str) -> None:
    # Far from the cap, which none of them comes to.
    found = race(spec(stop={"num_env_steps": 100 * CAP}), trials(20, reason=reason))
    assert found is not None
    assert found.max_trainings == 10


def test_seeds_of_an_earlier_race_count_as_spent() -> None:
    found = race(spec(), trials(20, more=(0, 1, 2, 3, 4)))
    assert found is not None
    assert found.max_trainings == 5
    assert race(spec(), trials(20, more=tuple(range(9)))) is None


def test_a_last_iteration_that_went_beyond_the_cap_is_counted_whole() -> None:
    made = spec(stop={"num_env_steps": 950})
    found = race(made, trials(4, steps=1_000))
    assert found is not None
    assert found.max_trainings == 2
    # Half of 3,700 env steps are not two trainings of 1,000.
    records = trials(4, steps=900)
    records[0] = records[0].model_copy(update={"num_env_steps": 1_000})
    assert race(made, records) is None


def test_top_and_seeds_limit_a_race() -> None:
    found = race(spec(confirm={"top": 2, "seeds": 3, "max_share": 10}), trials(6))
    assert found == Race((0, 1), 3)


# -- who races


@pytest.mark.parametrize("word", ["none", False, {"max_share": 0}])
def test_it_is_off_by_a_word(word: Any) -> None:
    assert not may_confirm(spec(confirm=word))


@pytest.mark.parametrize("word", [True, {}, None])
def test_it_is_on_otherwise(word: Any) -> None:
    made = spec(confirm=word)
    assert may_confirm(made)
    assert made.confirm.max_share == 0.5


@pytest.mark.parametrize(
    "wrong", ["maybe", "off", 1, 0, "", {"top": 1}, {"seeds": 0}, {"max_share": -0.1}, {"share": 0.5}, []]
)
def test_what_it_cannot_be_is_refused_by_name(wrong: Any) -> None:
    with pytest.raises(SpecError, match="confirm"):
        spec(confirm=wrong)


def test_the_schema_knows_the_words() -> None:
    jsonschema = pytest.importorskip("jsonschema")

    schema = json_schema()
    good: dict[str, Any] = {"env": "CartPole-v1", "algorithm": "ppo"}
    right: list[Any] = ["none", True, False, {"top": 3}]
    wrong: list[Any] = ["maybe", 3, {"top": 1}]
    for word in right:
        jsonschema.validate(good | {"confirm": word}, schema)
    for word in wrong:
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(good | {"confirm": word}, schema)


def test_populations_and_baselines_have_no_setting_to_confirm() -> None:
    assert not may_confirm(spec(scheduler="pbt"))
    baseline = SweepSpec.model_validate({"env": "CartPole-v1", "algorithm": "random"})
    assert not may_confirm(baseline)


def test_sweeps_of_versions_without_it_stay_as_they_are() -> None:
    made = spec()
    assert may_confirm(stored_spec(record(made)))
    old = record(made)
    del old.spec["confirm"]
    assert not may_confirm(stored_spec(old))


# -- rounds


def test_rounds_are_those_since_the_last_sample() -> None:
    made = spec()
    assert recent_rounds(record(made)) == []
    first, second = added(6, 0, 1, 2), added(6, 1)
    assert recent_rounds(record(made, first, second)) == [first, second]
    extended = made.model_copy(update={"num_samples": 8})
    assert recent_rounds(record(extended, first, second)) == []
    third = added(8, 7)
    assert recent_rounds(record(extended, first, second, third)) == [third]


def test_trials_before_the_rounds_are_all_others() -> None:
    records = trials(6, more=(0, 1, 2, 1))
    before = trials_before(records[::-1], [added(6, 0, 1, 2), added(6, 1)])
    assert [trial.index for trial in before] == [0, 1, 2, 3, 4, 5]
    assert [trial.index for trial in trials_before(records, [added(6, 1)])] == list(range(9))


# -- in words


def test_what_more_seeds_cost_and_what_the_race_saved_is_said() -> None:
    made = spec()
    assert replicas_text(record(made), trials(6)) == ""
    raced = record(made, added(6, 0, 1, 2), added(6, 0))
    # Ten trainings of 1,000 env steps; three settings with two more seeds each would have been six.
    assert replicas_text(raced, trials(6, more=(0, 1, 2, 0))) == (
        "4 trials gave 3 leading settings more seeds with 40 % of the env steps; as many for each would take 6"
    )
    level = record(made, added(6, 0, 1, by="replicate"))
    assert replicas_text(level, trials(6, more=(0, 1))) == (
        "2 trials gave 2 leading settings more seeds with 25 % of the env steps"
    )
    assert replicas_text(level, trials(6, steps=0, more=(0, 1))) == "2 trials gave 2 leading settings more seeds"
