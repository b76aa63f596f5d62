"""Search methods and schedulers that don't go with the rest of a sweep; plans whose points are chosen later."""

import itertools
from pathlib import Path
from typing import Any

import pytest
from spec_errors import MINIMAL, errors

from analysis.records import ChangeRecord
from policies.errors import CannotRunError, SpecError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.spec.file import load_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.transitions import pending_record
from tune_jobs.sweeps.adding import check_same_trials
from tune_jobs.sweeps.drive import write_new

LR = {"lr": {"loguniform": [1e-4, 1e-2]}}
TPE = {"space": LR, "num_samples": 20, "search": "tpe"}
PBT: dict[str, Any] = {"space": LR, "num_samples": 4, "scheduler": "pbt"}
PB2 = {**PBT, "scheduler": "pb2"}
MACHINE = Machine(num_cpus=2)


@pytest.mark.parametrize(
    ("changes", "path", "words"),
    [
        ({**TPE, "space": {}}, "search.type", ["space is empty"]),
        ({**TPE, "num_samples": 10}, "num_samples", ["10", "search.num_startup_trials, 10"]),
        ({**TPE, "scheduler": "pbt"}, "search.type", ["tpe", "scheduler.type pbt"]),
        ({**TPE, "scheduler": "hyperband"}, "search.type", ["tpe", "hyperband", "asha"]),
        (
            {**TPE, "algorithm": "random", "space": {"num_envs": {"randint": [1, 9]}}},
            "search.type",
            ["random does not"],
        ),
        ({**PBT, "space": {}}, "scheduler.type", ["pbt", "space is empty"]),
        ({**PBT, "num_samples": 1}, "num_samples", ["1 trial", "at least 2"]),
        ({**PBT, "num_samples": 1, "space": {"lr": {"grid": [0.1]}}}, "space", ["1 trial", "at least 2"]),
        ({**PBT, "seeds_per_point": 3}, "seeds_per_point", ["3", "pbt"]),
        ({**PB2, "seeds_per_point": 3}, "seeds_per_point", ["3", "pb2"]),
        ({**PB2, "space": {"lr": {"grid": [1e-3, 1e-2]}}}, "scheduler.type", ["pb2", "lists alone", "use pbt"]),
        ({**TPE, "scheduler": "pb2"}, "search.type", ["tpe", "pb2 changes the values"]),
        ({**PB2, "resources": {"max_concurrent": 1}}, "resources.max_concurrent", ["pb2", "num_cpus"]),
        (
            {**PBT, "algorithm": "random", "space": {"num_envs": {"randint": [1, 9]}}},
            "scheduler.type",
            ["random does not"],
        ),
        (
            {**PBT, "stop": {"num_env_steps": 500}, "scheduler": {"type": "pbt", "perturb_every_env_steps": 500}},
            "scheduler.perturb_every_env_steps",
            ["500", "stop.num_env_steps, 500"],
        ),
        (
            {"scheduler": {"type": "asha", "perturb_every_env_steps": 500}},
            "scheduler.perturb_every_env_steps",
            ["pbt", "asha"],
        ),
        ({**PBT, "resources": {"max_concurrent": 1}}, "resources.max_concurrent", ["pbt", "num_cpus"]),
        (
            {"space": LR, "scheduler": "hyperband", "resources": {"max_concurrent": 1}},
            "resources.max_concurrent",
            ["hyperband", "num_cpus"],
        ),
    ],
)
def test_what_does_not_go_together_is_refused_with_both_names(
    changes: dict[str, Any], path: str, words: list[str]
) -> None:
    message = errors(**changes)
    assert path in message
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    "name",
    ["hidden_sizes", "activation", "num_envs", "vf_share_layers", "normalize_observations", "normalize_rewards"],
)
def test_a_population_refuses_to_change_what_shapes_a_network_by_name(name: str) -> None:
    values = {"hidden_sizes": [[8], [16]], "activation": ["tanh", "relu"], "num_envs": [4, 8]}.get(name, [True, False])
    assert f"space.{name}: can't be changed within a trial" in errors(
        **(PBT | {"space": {**LR, name: {"choice": values}}})
    )
    # A sweep without pbt may search it.
    load_spec({**MINIMAL, "num_samples": 4, "space": {name: {"choice": values}}})


def test_a_population_refuses_to_change_what_rewards_are_multiplied_by() -> None:
    space = {**LR, "reward_scale": {"loguniform": [0.01, 1]}}
    assert "space.reward_scale: can't be changed within a trial" in errors(**PBT | {"algorithm": "dqn", "space": space})
    load_spec({**MINIMAL, "algorithm": "dqn", "num_samples": 4, "space": space})


def test_a_population_refuses_to_change_what_target_updates_are_counted_in() -> None:
    """The count of the last one is copied, in the other's unit."""
    space = {**LR, "target_update_unit": {"choice": ["env_step", "episode"]}}
    assert "space.target_update_unit: can't be changed within a trial" in errors(
        **PBT | {"algorithm": "dqn", "space": space}
    )
    load_spec({**MINIMAL, "algorithm": "dqn", "num_samples": 4, "space": space})


def test_a_grid_is_a_population_of_its_values() -> None:
    spec = load_spec({**MINIMAL, "space": {"lr": {"grid": [1e-4, 1e-3, 1e-2]}}, "scheduler": "pbt"})
    assert spec.perturb_every_env_steps == 20_000
    assert len(make_plan(spec, MACHINE).trials) == 3


# -- plans


def test_a_tpe_plan_names_all_trials_and_the_points_of_the_first() -> None:
    spec = load_spec({**MINIMAL, **TPE, "seeds_per_point": 2, "search": {"type": "tpe", "num_startup_trials": 3}})
    plan = make_plan(spec, MACHINE)
    assert (len(plan.trials), plan.num_points, plan.max_concurrent) == (40, 20, 4)
    assert [trial.has_point for trial in plan.trials] == [True] * 6 + [False] * 34
    assert all(trial.point["lr"] == trial.hyperparams["lr"] for trial in plan.trials[:6])
    assert all(trial.point == trial.hyperparams == {} for trial in plan.trials[6:])
    assert len({trial.seed for trial in plan.trials}) == 40


def test_a_grid_is_a_choice_for_tpe_so_num_samples_is_the_number_of_points() -> None:
    spec = load_spec({**MINIMAL, **TPE, "space": {"lr": {"grid": [1e-4, 1e-3]}, "gamma": {"grid": [0.9, 0.99]}}})
    assert make_plan(spec, MACHINE).num_points == 20


def test_unknown_points_count_with_the_largest_the_space_has() -> None:
    small = {**TPE, "search": {"type": "tpe", "num_startup_trials": 1}, "stop": {"num_env_steps": 1000}}
    sizes = {"train_batch_size": {"choice": [1024, 100_000]}, "num_envs": {"grid": [8, 16]}, **LR}

    def bounds(**changes: Any) -> tuple[int, int]:
        plan = make_plan(load_spec({**MINIMAL, **small, **changes}), MACHINE)
        return plan.max_env_steps, plan.max_disk_bytes

    steps, _ = bounds(space=sizes)
    # 19 unknown points, each of which may come to one iteration of 100,000 and 16 env steps.
    assert steps >= 19 * 100_000
    assert bounds(space={**LR, "hidden_sizes": {"grid": [[8], [2048, 2048]]}})[1] > 10 * bounds(space=LR)[1]


def test_a_population_counts_with_the_largest_values_it_may_mutate_to() -> None:
    space = {"train_batch_size": {"choice": [1024, 100_000]}}
    changes = {**PBT, "num_samples": 12, "space": space, "stop": {"num_env_steps": 30_000}}
    plan = make_plan(load_spec({**MINIMAL, **changes}), MACHINE)
    assert {trial.point["train_batch_size"] for trial in plan.trials} == {1024, 100_000}
    assert plan.max_env_steps >= 12 * 100_000


def test_a_dry_run_shows_points_that_are_not_known_yet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from click.testing import CliRunner

    from tune_jobs.cli.commands import cli

    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(
        "env: CartPole-v1\nalgorithm: ppo\nspace: {lr: {uniform: [1e-4, 1e-2]}, gamma: {grid: [0.9, 0.99]}}\n"
        "num_samples: 6\nsearch: {type: tpe, num_startup_trials: 4}\n"
    )
    result = CliRunner().invoke(cli, ["launch", "mine.yaml", "--dry-run"])
    assert result.exit_code == 0, result.output
    rows = [line.split() for line in result.stdout.splitlines() if line.strip().startswith("t000")]
    assert [row[2:] == ["by", "tpe", "by", "tpe"] for row in rows] == [False] * 4 + [True] * 2
    assert "once 4 have ended" in result.stdout


# -- resuming


def written(tmp_path: Path, changes: dict[str, Any]) -> tuple[SweepStore, SweepPlan]:
    spec = load_spec({**MINIMAL, **changes})
    plan = make_plan(spec, MACHINE)
    store = SweepStore(tmp_path / "mine")
    store.create()
    write_new(store, spec, plan, None)
    return store, plan


def test_points_that_were_chosen_since_are_no_other_sweep(tmp_path: Path) -> None:
    store, plan = written(tmp_path, TPE)
    last = store.trial("t0019")
    assert not last.read_record().has_point
    last.write_record(last.read_record().model_copy(update={"point": {"lr": 1}, "hyperparams": {"lr": 1}}))
    check_same_trials(store, plan)
    first = store.trial("t0000")
    first.write_record(first.read_record().model_copy(update={"hyperparams": {"lr": 1}}))
    with pytest.raises(CannotRunError, match="t0000"):
        check_same_trials(store, plan)


def test_values_that_a_population_changed_are_no_other_sweep_but_others_are(tmp_path: Path) -> None:
    store, plan = written(tmp_path, PBT)
    trial = store.trial("t0001")
    known = pending_record(plan.trials[1])
    change = ChangeRecord(
        iteration=3, num_env_steps=30, source_trial_id="t0000", source_iteration=2, before=known.point,
        after={"lr": 0.5}, time=0.0,
    )  # fmt: skip
    changed = {"point": {"lr": 0.5}, "hyperparams": {**known.hyperparams, "lr": 0.5}, "changes": (change,)}
    trial.write_record(known.model_copy(update=changed))
    check_same_trials(store, plan)
    trial.write_record(known.model_copy(update={**changed, "changes": ()}))
    with pytest.raises(CannotRunError, match="t0001"):
        check_same_trials(store, plan)


@pytest.mark.parametrize("fixed", [{}, {"prioritized_alpha": 0.3}])
def test_values_that_did_not_act_before_a_population_gave_them_are_no_other_sweep(
    tmp_path: Path, fixed: dict[str, Any]
) -> None:
    space = {
        "replay": {"choice": ["uniform", "prioritized"]},
        "prioritized_alpha": {"uniform": [0.5, 1.0], "when": {"replay": "prioritized"}},
    }
    store, plan = written(tmp_path, {**PBT, "algorithm": "dqn", "hyperparams": fixed, "space": space})
    index = next(index for index, trial in enumerate(plan.trials) if trial.point == {"replay": "uniform"})
    known, trial = pending_record(plan.trials[index]), store.trial(f"t{index:04d}")
    assert known.hyperparams.items() >= fixed.items()
    points = [known.point, {"replay": "prioritized", "prioritized_alpha": 0.9}, {"replay": "uniform"}]
    changes = tuple(
        ChangeRecord(
            iteration=3 * at, num_env_steps=30 * at, source_trial_id="t0000", source_iteration=2, before=before,
            after=after, time=0.0,
        )
        for at, (before, after) in enumerate(itertools.pairwise(points), start=1)
    )  # fmt: skip
    for number in (1, 2):
        hyperparams = {**known.hyperparams, **points[number]}
        changed = {"point": points[number], "hyperparams": hyperparams, "changes": changes[:number]}
        trial.write_record(known.model_copy(update=changed))
        check_same_trials(store, plan)
        trial.write_record(known.model_copy(update={**changed, "hyperparams": {**hyperparams, "gamma": 0.5}}))
        with pytest.raises(CannotRunError, match=f"t{index:04d}"):
            check_same_trials(store, plan)
        other = changes[0].model_copy(update={"before": {"replay": "prioritized"}})
        trial.write_record(known.model_copy(update={**changed, "changes": (other, *changes[1:number])}))
        with pytest.raises(CannotRunError, match=f"t{index:04d}"):
            check_same_trials(store, plan)


def test_more_combinations_of_sizes_than_can_be_looked_at_are_refused() -> None:
    space = {
        "hidden_sizes": {"choice": [[number, number] for number in range(1, 2_602)]},
        "num_envs": {"randint": [1, 8]},
        "train_batch_size": {"randint": [512, 1024]},
    }
    with pytest.raises(SpecError, match="hidden_sizes, num_envs, train_batch_size have 10,404 combinations"):
        make_plan(load_spec({**MINIMAL, **TPE, "space": space}), MACHINE)


def test_a_list_of_sizes_is_measured_once_however_many_points_it_stands_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from tune_jobs.plan import sweep_plan as plan

    measured: list[Any] = []
    real = plan.max_env_steps  # type: ignore[attr-defined]

    def counted(spec: Any, values: Any) -> Any:
        measured.append(values)
        return real(spec, values)

    monkeypatch.setattr(plan, "max_env_steps", counted)
    spec = load_spec({**MINIMAL, **TPE, "space": {"num_envs": {"randint": [1, 8]}}, "num_samples": 1_000})
    make_plan(spec, MACHINE)
    # The random points at the start, and the two ends for all others.
    assert len(measured) == 10 + 2
