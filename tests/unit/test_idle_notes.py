"""Hyperparameters that can't act: a search over one is refused, what acts in some points alone is told."""

import re
from typing import Any

import pytest
from spec_errors import MINIMAL

from analysis.records import TrialRecord
from policies.errors import SpecError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.rules import idle_settings

PPO = {"algorithm": "ppo"}
DQN = {"algorithm": "dqn", "stop": {"num_env_steps": 5000}}
TWO_LRS = {"lr": {"grid": [1e-3, 1e-2]}}


def notes(*records: Any, **fields: Any) -> list[str]:
    """What the plan of a small sweep says, but for its engines."""
    made = make_plan(load_spec({**MINIMAL, "space": TWO_LRS, **fields}), Machine(2), records)
    return [note for note in made.notes if "packed" not in note]


def grid(**values: Any) -> dict[str, dict[str, list[bool | float | str]]]:
    return {name: {"grid": list(listed)} for name, listed in values.items()}


# -- settings of search and scheduler


@pytest.mark.parametrize(
    ("section", "told"),
    [
        ({"scheduler": {"grace_env_steps": 100}}, ["scheduler.grace_env_steps can't act: scheduler.type is none"]),
        ({"scheduler": {"type": "median", "reduction_factor": 4}}, ["scheduler.reduction_factor can't act"]),
        ({"scheduler": {"type": "asha", "quantile_fraction": 0.5}}, ["scheduler.quantile_fraction can't act"]),
        (
            {"search": {"num_startup_trials": 3}},
            ["search.num_startup_trials can't act: search.type is random, not gp or forest or tpe."],
        ),
        ({"scheduler": {"type": "asha", "reduction_factor": 4, "grace_env_steps": 25_000}}, []),
        ({"scheduler": {"type": "asha", "quantile_fraction": 0.25}}, []),
    ],
)
def test_settings_that_cannot_act_are_told(section: dict[str, dict[str, Any]], told: list[str]) -> None:
    found = notes(**{**PPO, **section})
    assert len(found) == len(told)
    assert all(note.startswith(words) for note, words in zip(found, told, strict=True))


@pytest.mark.parametrize("kind", ["pbt", "pb2"])
def test_in_a_population_without_settings_nothing_judges_or_confirms_them(kind: str) -> None:
    def told(**fields: Any) -> list[str]:
        space = {"lr": {"loguniform": [1e-4, 1e-2]}}
        spec = load_spec({**MINIMAL, **PPO, "space": space, "num_samples": 4, "scheduler": kind, **fields})
        return idle_settings(spec)

    why = rf"trials of a population \(scheduler.type {kind}\) change their values while they train"
    (objective,) = told(objective="area")
    assert re.match(rf"objective.type area is for charts of the report alone: {why}", objective)
    (confirm,) = told(confirm={"top": 3})
    assert re.match(rf"confirm can't act: {why}", confirm)
    assert len(told(objective="steps_to_threshold", confirm={"max_share": 0.25})) == 2
    # What nobody changed, or asked for no confirmation, is as it is.
    assert told() == told(objective="final", confirm=True) == told(confirm="none") == []
    assert told(scheduler="asha", objective="area", confirm={"top": 3}) == []


# -- searched, and idle in all points: refused

NEVER: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "kl_target": (PPO, {"kl_target": {"loguniform": [1e-3, 1e-1]}}, "use_kl_loss is false"),
    "kl_coeff": ({**PPO, "hyperparams": {"use_kl_loss": False}}, grid(kl_coeff=[0.1, 1.0]), "use_kl_loss is false"),
    "prioritized_alpha": (DQN, {"prioritized_alpha": {"uniform": [0, 1]}}, "replay is not prioritized"),
    "rmsprop_rho": (DQN, {"rmsprop_rho": {"uniform": [0.9, 0.99]}}, "optimizer is adam"),
    "learning_starts": (DQN, {"learning_starts": {"randint": [7000, 9000]}}, "ends before.*6,002 env steps"),
    "replay_capacity": (DQN, grid(replay_capacity=[7000, 50_000]), "keeps them all"),
    "lr": ({**DQN, "hyperparams": {"learning_starts": 6003}}, TWO_LRS, "no update is made"),
    "epsilon_decay": (
        {**DQN, "hyperparams": {"epsilon_initial": 0.1, "epsilon_final": 0.1}}, grid(epsilon_decay=[10, 100]),
        "epsilon_initial is epsilon_final",
    ),
    "target_update_freq": (DQN, grid(target_update_freq=[1, 2, 4]), "not fewer env steps between two updates"),
    "train_freq": ({**DQN, "hyperparams": {"num_envs": 8}}, grid(train_freq=[1, 4, 8]), "not more than num_envs"),
    "n_step": (
        {**DQN, "env": {"id": "CartPole-v1", "args": {"max_episode_steps": 5}}}, grid(n_step=[5, 9]), "no episode has",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NEVER)
def test_a_search_that_changes_nothing_is_refused(name: str) -> None:
    fields, space, why = NEVER[name]
    fields = {"num_samples": 1 if "grid" in space[name] else 6, **fields}
    with pytest.raises(SpecError, match=rf"space\.{name} is searched, but can't act.*{why}") as refused:
        notes(**fields, space=space)
    assert "Take it out of space" in refused.value.hint
    # Whatever else is searched, no trial differs by this one.
    with pytest.raises(SpecError, match=rf"space\.{name} is searched"):
        notes(**fields, space={**space, **grid(activation=["relu", "tanh"])})


@pytest.mark.parametrize("named", [[32, 64], 64, 64.0])
@pytest.mark.parametrize("batch", [{"power_of_two": [16, 256]}, {"qrandint": [16, 256, 16]}])
def test_what_acts_only_with_a_value_inside_a_range_is_not_refused(batch: dict[str, Any], named: Any) -> None:
    optimizer = {"choice": ["adam", "rmsprop"], "when": {"train_batch_size": named}}
    space = {"train_batch_size": batch, "optimizer": optimizer, "rmsprop_rho": {"uniform": [0.9, 0.99]}}
    told = "\n".join(notes(**DQN, num_samples=20, space=space))
    assert "space.rmsprop_rho can't act: " not in told
    # Where no value of it would do, it is refused as ever.
    space["optimizer"] = {**optimizer, "choice": ["adam"]}
    with pytest.raises(SpecError, match=r"rmsprop_rho is searched, but can't act"):
        notes(**DQN, num_samples=20, space=space)


ONE_UPDATE = {"num_epochs": 1, "train_batch_size": 1024, "minibatch_size": 1024}
CLIP = {"clip_param": {"uniform": [0.1, 0.3]}}
BETWEEN: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    # 1,024 is no multiple of 3, 5, 6 and 7.
    "num_envs of ppo": (PPO, ONE_UPDATE, {**CLIP, "num_envs": {"randint": [1, 9]}}),
    # With 64 there is one update, with 128 the schedule is over before the first.
    "train_batch_size": (
        PPO,
        {"num_epochs": 1, "minibatch_size": 64, "num_envs": 1, "clip_decay_steps": 128, "clip_param_final": 0.1},
        {**CLIP, "train_batch_size": {"randint": [64, 129]}},
    ),
    # Three make 6 env steps in a phase, with two updates: one each 3 env steps.
    "num_envs of dqn": (
        DQN,
        {"train_freq": 4, "updates_per_env_step": 0.25},
        {"target_update_freq": {"choice": [3, 4]}, "num_envs": {"randint": [1, 5]}},
    ),
    # So do two where train_freq is 5 or 6.
    "train_freq": (
        DQN,
        {"num_envs": 2, "updates_per_env_step": 0.25},
        {"target_update_freq": {"choice": [2, 3]}, "train_freq": {"qrandint": [4, 8, 2]}},
    ),
}  # fmt: skip


@pytest.mark.parametrize("search", ["random", "gp"])
@pytest.mark.parametrize("case", BETWEEN)
def test_what_acts_only_with_a_step_between_the_ends_of_a_range_is_not_refused(case: str, search: str) -> None:
    fields, fixed, space = BETWEEN[case]
    told = "\n".join(notes(**fields, hyperparams=fixed, space=space, search=search, num_samples=20))
    assert f"space.{next(iter(space))} can't act: " not in told


def test_rules_that_divide_nothing_are_judged_by_the_ends_of_ranges_of_any_length() -> None:
    wide = {"train_freq": {"randint": [1, 513]}, "num_envs": {"randint": [1, 65]}}
    with pytest.raises(SpecError, match=r"space\.lr is searched, but can't act"):
        notes(**DQN, hyperparams={"learning_starts": 200_000}, space={**grid(lr=[1e-3, 1e-4]), **wide}, num_samples=4)
    told = notes(**DQN, hyperparams={"epsilon_start": 200_000, "epsilon_decay": 77}, space=wide, num_samples=4)
    assert any(note.startswith("hyperparams.epsilon_decay can't act") for note in told)


@pytest.mark.parametrize("most", [7, 8])
def test_with_too_many_steps_to_look_at_nothing_is_refused(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four numbers of envs with two values, that divide 1,024 all."""
    monkeypatch.setattr("tune_jobs.plan.idle_notes._MOST_COMBINATIONS", most)
    fields = {**PPO, "hyperparams": ONE_UPDATE, "space": {**CLIP, "num_envs": {"power_of_two": [1, 8]}}}
    if most == 7:
        assert any(note.startswith("space.clip_param can't act in ") for note in notes(**fields, num_samples=5))
    else:
        with pytest.raises(SpecError, match=r"space\.clip_param is searched, but can't act.*policy that sampled"):
            notes(**fields, num_samples=5)


def test_a_range_of_more_steps_than_anybody_can_list_is_not_listed() -> None:
    space = {"target_update_freq": {"choice": [1, 2]}, "train_freq": {"lograndint": [1, 10**12]}}
    told = notes(**DQN, hyperparams={"num_envs": 2, "updates_per_env_step": 0.25}, space=space, num_samples=20)
    assert not any("space.target_update_freq can't act: " in note for note in told)


def test_several_are_told_at_once() -> None:
    space = grid(kl_target=[0.01, 0.1], kl_coeff=[0.1, 0.2], lr=[1e-3, 1e-4])
    with pytest.raises(SpecError, match=r"space\.kl_target, space\.kl_coeff are searched") as refused:
        notes(**PPO, space=space)
    assert "space.lr" not in refused.value.message


@pytest.mark.parametrize("more", [{}, {"search": "tpe", "num_samples": 30}, {"scheduler": "pbt", "num_samples": 3}])
def test_whatever_chooses_the_points(more: dict[str, int | str]) -> None:
    space = {"rmsprop_rho": {"uniform": [0.9, 0.99]}, "lr": {"loguniform": [1e-4, 1e-2]}}
    with pytest.raises(SpecError, match=r"space\.rmsprop_rho is searched.*optimizer is adam"):
        notes(**DQN, **{"num_samples": 3, **more}, space=space)


def test_values_at_both_ends_of_a_range_may_be_alike_for_two_reasons_and_those_between_not() -> None:
    space = {"learning_starts": {"randint": [0, 20_000]}}
    assert not any("space" in note for note in notes(**DQN, space=space, num_samples=2))


def test_a_sweep_that_is_there_goes_on_and_is_told() -> None:
    spec = load_spec({**MINIMAL, **PPO, "space": grid(kl_target=[0.01, 0.1])})
    record = TrialRecord(trial_id="t0000", index=0, point_index=0, seed=1, point={"kl_target": 0.01})
    assert "space.kl_target can't act: use_kl_loss is false." in make_plan(spec, Machine(2), [record]).notes


# -- searched, and idle in some points

ONLY_THERE = "and it is searched only where it acts"
WITH_LOSS = f" Give it when: {{use_kl_loss: true}}, {ONLY_THERE}."


def test_what_has_a_condition_is_not_told_where_that_does_not_hold() -> None:
    space = {**grid(use_kl_loss=[False, True]), "kl_target": {"grid": [0.01, 0.1], "when": {"use_kl_loss": True}}}
    assert notes(**PPO, space=space) == []
    # Where it holds, and it is idle all the same, that is told as ever.
    space |= grid(kl_coeff=[0.0, 0.2])
    (found,) = [note for note in notes(**PPO, space=space) if "kl_target" in note]
    assert found == (
        "space.kl_target can't act in 2 of 6 points (2, 4): kl_coeff is 0, and stays 0 as it is changed by factors. "
        "Add kl_coeff: 0.2 to its when."
    )


def test_a_condition_that_leaves_only_points_where_it_is_idle_is_refused() -> None:
    space = {**grid(use_kl_loss=[False, True]), "kl_target": {"grid": [0.01, 0.1], "when": {"use_kl_loss": False}}}
    with pytest.raises(SpecError, match=r"kl_target is searched, but can't act in any point.*use_kl_loss is false"):
        notes(**PPO, space=space)


def test_a_value_fixed_for_where_it_is_not_searched_is_looked_at_once() -> None:
    space = {**grid(optimizer=["adam", "rmsprop"]), "rmsprop_rho": {"grid": [0.9], "when": {"optimizer": "rmsprop"}}}
    found = notes(**DQN, space=space, hyperparams={"rmsprop_rho": 0.5})
    assert [note for note in found if "rmsprop_rho" in note] == []


def test_what_acts_in_some_points_alone_is_told_with_these() -> None:
    space = grid(use_kl_loss=[False, True], kl_target=[0.01, 0.1])
    (found,) = notes(**PPO, space=space)
    assert found == f"space.kl_target can't act in 2 of 4 points (0, 1): use_kl_loss is false.{WITH_LOSS}"
    many = grid(use_kl_loss=[False, True], kl_target=[0.01 * number for number in range(1, 11)])
    (found,) = notes(**PPO, space=many)
    assert found == f"space.kl_target can't act in 10 of 20 points: use_kl_loss is false.{WITH_LOSS}"


def test_each_reason_has_its_points() -> None:
    space = grid(use_kl_loss=[False, True], kl_coeff=[0.0, 0.2], kl_target=[0.01, 0.1])
    zero = "kl_coeff is 0, and stays 0 as it is changed by factors"
    assert notes(**PPO, space=space) == [
        f"space.use_kl_loss can't act in 4 of 8 points (0, 1, 4, 5): {zero}.",
        "space.kl_coeff can't act in 4 of 8 points (0, 1, 2, 3): use_kl_loss is false.",
        f"space.kl_target can't act in 4 of 8 points (0, 1, 2, 3): use_kl_loss is false.{WITH_LOSS}",
        f"space.kl_target can't act in 2 of 8 points (4, 5): {zero}. Give it when: {{kl_coeff: 0.2}}, {ONLY_THERE}.",
    ]


def test_the_search_of_one_optimizer_with_the_values_of_both_is_no_error() -> None:
    space = grid(optimizer=["adam", "rmsprop"], rmsprop_rho=[0.9, 0.99], adam_beta1=[0.8, 0.9])
    found = notes(**DQN, space=space)
    idle = "space.{} can't act in 4 of 8 points ({}): optimizer is {}. Give it when: {{optimizer: {}}}, " + ONLY_THERE
    assert found == [
        idle.format("rmsprop_rho", "0, 1, 2, 3", "adam", "rmsprop") + ".",
        idle.format("adam_beta1", "4, 5, 6, 7", "rmsprop", "adam") + ".",
    ]


def test_values_that_act_alike_are_told_and_one_alone_is_not() -> None:
    space = grid(replay_capacity=[2000, 8000, 20_000])
    (found,) = notes(**DQN, space=space)
    assert found.startswith(
        "space.replay_capacity: its values act alike in 2 of 3 points (1, 2): a trial makes no more"
    )
    assert notes(**DQN, space=grid(replay_capacity=[2000, 8000])) == []


def test_a_few_draws_of_a_range_that_act_alike_are_not_worth_a_note() -> None:
    rare = {"replay_capacity": {"randint": [100, 6100]}}
    assert notes(**DQN, space=rare, num_samples=50) == []
    often = {"replay_capacity": {"randint": [100, 20_000]}}
    (found,) = notes(**DQN, space=often, num_samples=50)
    assert "its values act alike in" in found


def test_mutations_may_change_what_others_depend_on() -> None:
    pbt = {"scheduler": "pbt", "num_samples": 1}
    (found,) = notes(**PPO, **pbt, space=grid(use_kl_loss=[False, True], kl_target=[0.01, 0.1]))
    assert found.endswith(f"use_kl_loss is false. A mutation of use_kl_loss may change that.{WITH_LOSS}")


def test_points_that_are_not_known_yet_may_act() -> None:
    space = {**grid(optimizer=["adam", "rmsprop"]), "rmsprop_rho": {"uniform": [0.9, 0.99]}}
    (found,) = notes(**DQN, space=space, search="tpe", num_samples=30)
    assert "of 10 points that are known" in found


# -- fixed


def test_fixed_values_that_cannot_act_are_told() -> None:
    fixed = {"rmsprop_rho": 0.9, "adam_beta1": 0.8, "prioritized_beta": 0.5, "hidden_sizes": [8]}
    assert notes(**DQN, hyperparams=fixed) == [
        "hyperparams.rmsprop_rho can't act: optimizer is adam.",
        "hyperparams.prioritized_beta can't act: replay is not prioritized.",
    ]
    both = grid(optimizer=["adam", "rmsprop"])
    assert notes(**DQN, hyperparams={"rmsprop_rho": 0.9}, space=both) == []


def test_a_searched_value_of_one_is_a_fixed_one() -> None:
    assert notes(**DQN, space={**grid(rmsprop_rho=[0.9]), **TWO_LRS}) == [
        "space.rmsprop_rho can't act: optimizer is adam."
    ]


def test_what_is_switched_off_or_large_enough_needs_no_note() -> None:
    fixed = {"replay_capacity": 100_000, "target_update_freq": None, "target_network": False, "double_q": False}
    assert notes(**DQN, hyperparams=fixed) == []
    assert notes(**PPO, hyperparams={"use_kl_loss": False, "kl_coeff": 0.0})[0].startswith("hyperparams.kl_coeff")


def test_trials_that_never_learn_are_told() -> None:
    fixed = {"learning_starts": 6003, "gamma": 0.9}
    (found,) = notes(**DQN, hyperparams=fixed, space={}, num_samples=1)
    assert found == (
        "In the only point no update is made, as learning_starts 6,003 is more than the env steps of a trial (at most "
        "6,002)."
    )
    (found,) = notes(**DQN, hyperparams={"updates_per_env_step": 1e-4}, space={}, num_samples=1)
    assert "updates_per_env_step 0.0001 gives less than one" in found
    (found,) = notes(**DQN, hyperparams={"train_batch_size": 7000}, space={}, num_samples=1)
    assert "train_batch_size 7,000 is more" in found
    (found,) = notes(**DQN, space=grid(learning_starts=[1000, 9000], activation=["relu", "tanh"]))
    assert found.startswith("In 2 of 4 points (2, 3) no update is made")
    assert notes(**DQN, hyperparams={"learning_starts": 6002}) == []


def test_the_exploration_of_a_users_own_module_is_its_own_affair(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tune_jobs.plan.sweep_plan.check_rl_module", lambda spec: None)
    flat = {"epsilon_initial": 0.1, "epsilon_final": 0.1}
    assert notes(**DQN, rl_module="own:Module", hyperparams=flat, space=grid(epsilon_decay=[10, 100])) == []
