"""How many trials run at once where their memory limits it: by a number, by CPUs, or beside packs."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import MACHINE, make_sweep_folder

from tune_jobs.plan.machine import Machine
from tune_jobs.plan.memory import cpus_that_hold, lowered_by_memory
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.ray_tune import run_trials
from tune_jobs.ray_tune.cluster import Connection
from tune_jobs.service.submitting import num_cpus_of
from tune_jobs.spec.file import load_spec, stored_spec
from tune_jobs.sweeps import drive

PIXELS: dict[str, Any] = {
    "env": {"id": "CartPole-v1", "pixels": True},
    "algorithm": "dqn",
    "engine": "rllib",
    "hyperparams": {
        "replay_capacity": 100_000, "hidden_sizes": [64], "conv_filters": [[32, 8, 4], [64, 4, 2], [64, 3, 1]],
    },
    "space": {"lr": {"uniform": [1e-4, 1e-3]}},
    "num_samples": 16,
    "stop": {"num_env_steps": 100_000},
}  # fmt: skip
MIXED: dict[str, Any] = {
    "env": {"id": "CartPole-v1", "pixels": True},
    "algorithm": "ppo",
    "hyperparams": {"hidden_sizes": [64], "train_batch_size": 4000, "minibatch_size": 4000, "num_envs": 4},
    "space": {
        "conv_filters": {"grid": [[[4, 16, 16]], [[64, 4, 1], [64, 4, 2]]]}, "lr": {"uniform": [1e-4, 1e-3]},
    },
    "num_samples": 16,
    "stop": {"num_env_steps": 20_000},
}  # fmt: skip


@pytest.mark.parametrize("num_bytes", [1e8, 6e8, 9e8, 1.1e9, 1.7e9, 2.7e9, 5e9, 9e9])
@pytest.mark.parametrize(("num_cpus", "cpus"), [(16, 1), (15, 2), (7, 1), (2.5, 1), (1, 1)])
def test_no_more_have_the_cpus_than_have_the_memory(num_bytes: float, num_cpus: float, cpus: int) -> None:
    machine, most = Machine(num_cpus, memory_bytes=16e9), int(num_cpus // cpus)
    fit, _ = lowered_by_memory(machine, num_bytes, most, cpus=cpus, algorithm="dqn")
    number, notes = lowered_by_memory(machine, num_bytes, most, cpus=cpus, algorithm="dqn", by_cpus=True)
    assert (number == most) == (fit == most)
    if number == most:
        return
    each = cpus_that_hold(machine, number)
    assert number == num_cpus // each <= fit
    # With one CPU fewer for each, more would run than fit.
    assert each == 1 or num_cpus // (each - 1) > fit
    assert notes[0].startswith((f"{number} trial", "Trials run one at a time"))


def test_on_a_cluster_the_setting_is_named_that_such_a_scheduler_takes() -> None:
    machine = Machine(16, memory_bytes=16e9, nodes=((16.0, 0.0),))
    _, (note,) = lowered_by_memory(machine, 5e9, 16, cpus=1, algorithm="dqn", by_cpus=True)
    assert "set resources.num_cpus; hyperparams.replay_capacity is what lowers it." in note
    # Which can be set.
    planned(PIXELS, 64e9, scheduler="pbt", resources={"num_cpus": 2})


# -- what the processes themselves take


@pytest.mark.parametrize(("num_cpus", "gb"), [(1, 1), (2, 3), (4, 6), (8, 12), (16, 24), (64, 96)])
def test_processes_do_not_count_where_there_is_memory_for_each_cpu(num_cpus: int, gb: float) -> None:
    machine = Machine(num_cpus, memory_bytes=gb * 1e9)
    half = gb * 1e9 / num_cpus / 2
    for num_bytes in (0, 2e6, 0.5 * half):
        assert lowered_by_memory(machine, num_bytes, num_cpus, cpus=1, algorithm="ppo") == (num_cpus, ())


def test_fewer_trials_run_at_once_where_their_processes_take_the_memory() -> None:
    machine = Machine(64, memory_bytes=8e9)
    number, (note,) = lowered_by_memory(machine, 2e6, 64, cpus=1, algorithm="ppo")
    assert number == 14
    what = "14 trials instead of 64 run at once: one trial and its process may take 352.0 MB of memory"
    assert note == f"{what}, and what this machine has available beside Ray's own processes is 5.2 GB."
    # Each with two env runners.
    number, (note,) = lowered_by_memory(machine, 2e6, 21, cpus=3, algorithm="ppo", num_processes=3)
    assert (number, "one trial and its processes may take 1.1 GB" in note) == (4, True)
    # A trial that plays at random imports less.
    assert lowered_by_memory(machine, 0, 64, cpus=1, algorithm="random")[0] == 39
    # None is trained alone.
    assert lowered_by_memory(machine, 0, 64, cpus=1, algorithm="ppo", num_processes=0) == (64, ())
    # One runs in any case.
    number, (note,) = lowered_by_memory(Machine(64, memory_bytes=2e9), 2e6, 64, cpus=1, algorithm="ppo")
    assert (number, note.startswith("Trials run one at a time: one trial and its process may take")) == (1, True)


def test_on_a_cluster_it_is_said_that_processes_take_the_memory() -> None:
    machine = Machine(64, memory_bytes=8e9, nodes=((64.0, 0.0),))
    number, (note,) = lowered_by_memory(machine, 2e6, 64, cpus=1, algorithm="ppo")
    assert number == 64
    assert note.endswith("may take 352.0 MB of memory: set resources.max_concurrent.")


def test_a_plan_counts_the_processes_of_trials_that_are_not_packed() -> None:
    source: dict[str, Any] = {"env": "CartPole-v1", "algorithm": "ppo", "num_samples": 64, "confirm": "none"}
    source["space"] = {"lr": {"uniform": [1e-4, 1e-3]}}
    machine = Machine(64, memory_bytes=8e9)
    alone = make_plan(load_spec(source | {"engine": "rllib"}), machine)
    assert alone.max_concurrent == 14
    assert any(note.startswith("14 trials instead of 64 run at once") for note in alone.notes)
    runners = make_plan(load_spec(source | {"engine": "rllib", "resources": {"num_env_runners": 2}}), machine)
    assert runners.max_concurrent == 4
    # A pack's process shares what it imports.
    packed = make_plan(load_spec(source), machine)
    assert (packed.max_concurrent, packed.notes) == (64, ())


def planned(fields: dict[str, Any], memory_bytes: float, **changes: Any) -> SweepPlan:
    return make_plan(load_spec(fields | changes), Machine(16, memory_bytes=memory_bytes))


@pytest.mark.parametrize("stop", [{"num_env_steps": 100_000}, {"num_env_steps": 10**8, "num_iterations": 100}])
def test_a_replay_memory_counts_as_large_as_the_training_fills_it(stop: dict[str, int]) -> None:
    small, large = (PIXELS["hyperparams"] | {"replay_capacity": capacity} for capacity in (100_000, 1_000_000))
    assert planned(PIXELS, 8e9, hyperparams=large, stop=stop).max_concurrent == 8
    most = planned(PIXELS, 8e9, stop=stop).max_env_steps_per_trial
    assert 100_000 <= most < 101_010
    whole = planned(PIXELS, 8e9, hyperparams=small | {"replay_capacity": most}, stop=stop)
    assert planned(PIXELS, 8e9, hyperparams=large, stop=stop).notes == whole.notes
    assert planned(PIXELS, 8e9, hyperparams=large, stop={"num_env_steps": 1_000_000}).max_concurrent == 1


@pytest.mark.parametrize("scheduler", ["pbt", "hyperband"])
def test_trials_that_wait_for_others_are_held_by_their_cpus(scheduler: str) -> None:
    plan = planned(PIXELS, 8e9, scheduler=scheduler)
    assert (plan.max_concurrent, plan.cpus_per_trial) == (8, 2)
    assert any(note.startswith("8 trials instead of 16 run at once") for note in plan.notes)
    assert planned(PIXELS, 64e9, scheduler=scheduler).cpus_per_trial == 1
    others = planned(PIXELS, 8e9)
    assert (others.max_concurrent, others.cpus_per_trial) == (8, 1)


def test_trials_alone_keep_their_limit_beside_packs() -> None:
    plan = planned(MIXED, 64e9, confirm="none")
    assert plan.packs is not None
    assert plan.engines == {"packed": 16, "rllib": 16}
    assert (plan.max_concurrent, plan.max_concurrent_alone) == (16, 1)
    assert any(note.startswith("1 trial instead of 16 runs at once") for note in plan.notes)
    assert num_cpus_of(plan) == 16
    again = SweepPlan.from_json(plan.to_json())
    assert again.max_concurrent_alone == 1
    # That of an older service.
    old = plan.to_json()
    del old["max_concurrent_alone"]
    assert SweepPlan.from_json(old).max_concurrent_alone == 16


def test_a_service_counts_the_cpus_of_trials_alone_where_packs_need_fewer() -> None:
    large = [[[64, 4, 1], [64, 4, 2]], [[64, 4, 1], [32, 4, 2]], [[32, 4, 1], [64, 4, 2]]]
    filters = {"grid": [[[4, 16, 16]], *large]}
    plan = planned(MIXED, 1e12, confirm="none", num_samples=2, space=MIXED["space"] | {"conv_filters": filters})
    assert plan.engines == {"packed": 2, "rllib": 6}
    assert plan.packs is not None
    assert plan.packs.num_packs * plan.packs.cpus_per_pack == 2
    assert num_cpus_of(plan) == 6


def test_a_run_has_the_number_of_trials_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    trial = store.trial("t0001")
    trial.write_record(trial.read_record().model_copy(update={"status": "pending"}))
    plan = dataclasses.replace(make_plan(stored_spec(store.read_record()), MACHINE), max_concurrent_alone=3)
    assert plan.max_concurrent == 4
    jobs: list[run_trials.RunJob] = []
    connection = Connection("here", is_client=False, machine=MACHINE)
    monkeypatch.setattr(drive, "connected", lambda *_, **__: contextlib.nullcontext(connection))
    monkeypatch.setattr(run_trials, "run_trials", lambda job, _: jobs.append(job))
    with store.lock(), drive.Shared() as shared:
        drive.run_trials_of(store, plan, shared, address=None, machine=MACHINE, progress="none")
    assert [(job.trial_ids, job.max_concurrent) for job in jobs] == [(("t0001",), 3)]
