"""Plans: the trials of a sweep, what fits on a machine, and what is refused with its numbers."""

import json
import math
import os
from pathlib import Path
from typing import Any

import pytest

from analysis.records import ReplicationRecord
from policies.acting.evaluate import MAX_EPISODE_STEPS
from policies.errors import CannotRunError, EnvError, SpecError
from policies.guard import guarded
from policies.packed.envs.make import StepTime
from tune_jobs.plan import machine as machine_module
from tune_jobs.plan.machine import Machine, local_machine
from tune_jobs.plan.points import trial_id
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.seeds import SEEDS_PER_TRIAL

TWO_CORES = Machine(num_cpus=2)


def plan(*overrides: str, machine: Machine = TWO_CORES, source: str | dict[str, Any] = "cartpole-ppo") -> SweepPlan:
    return make_plan(load_spec(source, overrides), machine)


def test_the_tutorials_sweep() -> None:
    made = plan()
    assert (len(made.trials), made.num_points) == (20, 20)
    assert (made.cpus_per_trial, made.gpus_per_trial, made.max_concurrent) == (1, 0, 20)
    assert made.engines == {"packed": 20}
    assert [trial.trial_id for trial in made.trials[:2]] == ["t0000", "t0001"]
    assert len(made.evaluation_seeds) == 20
    assert len(made.confirmation_seeds) == 100
    assert made.env.env_id == "CartPole-v0"
    assert made.notes == ()


def test_each_trial_has_all_hyperparameters_its_point_among_them() -> None:
    for trial in plan().trials:
        assert trial.hyperparams["num_epochs"] == 6
        assert trial.hyperparams["grad_clip"] is None
        assert {name: trial.hyperparams[name] for name in trial.point} == trial.point
        assert sorted(trial.point) == ["activation", "hidden_sizes", "lr"]
    json.dumps(plan().to_json())


@pytest.mark.parametrize(
    ("env", "step_us", "is_told"),
    [
        ({"id": "Blackjack-v1"}, 6000.0, True),
        ({"id": "Blackjack-v1"}, 5999.0, False),
        ({"id": "Blackjack-v1"}, None, False),
        ({"id": "Blackjack-v1", "args": {"max_episode_steps": 500}}, 6000.0, False),
        ({"id": "Taxi-v3"}, 6000.0, False),
    ],
)
def test_slow_episodes_that_may_never_end_are_noted(
    env: dict[str, Any], step_us: float | None, *, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guarded, "measure_step", lambda *_, timeout_s: StepTime(step_us))
    made = plan(source={"env": env, "algorithm": "dqn", "evaluation": {"num_episodes": 7}})
    notes = [note for note in made.notes if "sets no limit to the env steps of an episode" in note]
    assert bool(notes) is is_told
    for note in notes:
        assert "one takes 6.0 ms" in note
        assert f"cut off after {MAX_EPISODE_STEPS:,}, which take 1 min" in note
        assert "Each evaluation plays 7 episodes" in note


def test_seeds_per_point_repeat_a_point_with_other_seeds() -> None:
    made = plan("seeds_per_point=3", "num_samples=2")
    assert (len(made.trials), made.num_points) == (24, 8)
    assert [(trial.point_index, trial.seed_index) for trial in made.trials[:4]] == [
        (0, 0),
        (0, 1),
        (0, 2),
        (1, 0),
    ]
    assert made.trials[0].point == made.trials[2].point
    assert len({trial.seed for trial in made.trials}) == 24


def test_more_samples_append_trials() -> None:
    assert plan("num_samples=7").trials[:20] == plan().trials


@pytest.mark.parametrize(
    "change", ["resources.max_concurrent=1", "stop.num_env_steps=1000", "evaluation.num_episodes=3"]
)
def test_trials_do_not_depend_on_anything_else(change: str) -> None:
    assert plan(change, machine=Machine(num_cpus=64)).trials == plan().trials


@pytest.mark.parametrize(
    ("overrides", "machine", "expected"),
    [
        ([], Machine(1), 1),
        ([], Machine(1.5), 1),
        ([], Machine(64), 20),
        (["resources.max_concurrent=3"], Machine(64), 3),
        (["resources.num_env_runners=1"], Machine(5), 2),
        (["resources.num_cpus=3"], Machine(8), 2),
        (["resources.num_cpus=3"], Machine(8, nodes=((4, 0), (4, 0))), 2),
        (["resources.num_cpus=3"], Machine(10, nodes=((5, 0), (5, 0))), 2),
        (["resources.num_env_runners=2"], Machine(6, nodes=((2, 0), (2, 0), (2, 0))), 2),
        (["resources.num_gpus=1"], Machine(64, 2), 2),
        (["resources.num_gpus=0.3333333333333333"], Machine(64, 2), 6),
        (["resources.num_gpus=0.6"], Machine(64, 2), 2),
        (["resources.num_gpus=1"], Machine(64, 1, nodes=((4, 1), (60, 0))), 1),
    ],
)
def test_as_many_trials_at_once_as_fit(overrides: list[str], machine: Machine, expected: int) -> None:
    assert plan("engine=rllib", *overrides, machine=machine).max_concurrent == expected


@pytest.mark.parametrize(
    ("overrides", "machine", "parts"),
    [
        (
            ["resources.num_env_runners=2"],
            TWO_CORES,
            ["3 CPUs (1 process and 2 env runners)", "has 2", "at most 1"],
        ),
        (
            ["resources.num_cpus=4"],
            TWO_CORES,
            ["needs 4 CPUs", "this machine has 2", "resources.num_cpus to at most 2"],
        ),
        (["resources.num_gpus=0.5"], TWO_CORES, ["needs 0.5 GPUs", "has 0"]),
        (
            ["resources.num_cpus=4"],
            Machine(6, 0, "the cluster at auto", ((3, 0), (3, 0))),
            ["the cluster at auto", "3 and 0"],
        ),
        (["resources.num_gpus=1"], Machine(4, 1, "c", ((0, 1), (4, 0))), ["1 CPU and 1 GPU on one node"]),
        ([], Machine(0.5), ["needs 1 CPU;", "has 0.5"]),
    ],
)
def test_what_would_wait_for_ever_is_refused_with_the_numbers(
    overrides: list[str], machine: Machine, parts: list[str]
) -> None:
    with pytest.raises(CannotRunError) as caught:
        plan(*overrides, machine=machine)
    assert caught.value.exit_code == 5
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("given", "told", "followed"),
    [
        ({"num_env_runners": 4}, "resources.num_env_runners to at most 3", {"num_env_runners": 3}),
        ({"num_cpus": 8}, "resources.num_cpus to at most 4", {"num_cpus": 4}),
        (
            {"num_cpus": 8, "num_env_runners": 2},
            "resources.num_cpus to at most 4",
            {"num_cpus": 4, "num_env_runners": 2},
        ),
        (
            {"num_cpus": 8, "num_env_runners": 4},
            "resources.num_cpus to at most 4 and resources.num_env_runners to at most 3",
            {"num_cpus": 4, "num_env_runners": 3},
        ),
    ],
)
def test_a_trial_fits_with_the_settings_that_are_told(
    given: dict[str, int], told: str, followed: dict[str, int]
) -> None:
    source = {"env": "CartPole-v1", "algorithm": "ppo"}
    with pytest.raises(CannotRunError) as caught:
        plan(source={**source, "resources": given}, machine=Machine(4))
    assert caught.value.hint.startswith(f"Set {told}, or launch on")
    assert plan(source={**source, "resources": followed}, machine=Machine(4)).cpus_per_trial == 4


def test_values_that_contradict_each_other_are_told_with_their_point() -> None:
    with pytest.raises(SpecError) as caught:
        plan("hyperparams.minibatch_size=", "space.minibatch_size={grid: [256, 2048]}")
    assert caught.value.exit_code == 2
    assert "point 1 (hidden_sizes [32], activation linear" in caught.value.message
    assert "minibatch_size 2048 is larger than train_batch_size 1024" in caught.value.message
    assert "t0001" in caught.value.message


def test_sub_environments_have_to_fit_into_a_trials_seeds() -> None:
    machine = Machine(64)
    assert plan("hyperparams.num_envs=512", "resources.num_env_runners=2", machine=machine).max_concurrent == 20
    with pytest.raises(SpecError, match=f"1536 sub-environments.*{SEEDS_PER_TRIAL}"):
        plan("hyperparams.num_envs=512", "resources.num_env_runners=3", machine=machine)


def test_what_is_made_of_observations_is_told() -> None:
    told = plan("env=FrozenLake-v1").notes
    assert "Observations of FrozenLake-v1 are made vectors of shape (16,): Discrete(16)." in told
    assert not [note for note in plan().notes if "are made" in note]


@pytest.mark.usefixtures("env_plugin")
def test_what_actions_are_made_of_is_told() -> None:
    told = plan("env=TestReply-v0").notes
    assert "Actions of TestReply-v0 are made of 2 choices: MultiDiscrete([2 3], start=[ 1 -1])." in told
    told = plan("env=TestReply-v0", "env.args.kind=matrix").notes
    assert "Actions of TestReply-v0 are made of vectors: Box(-1.0, 1.0, (2, 1), float64)." in told


@pytest.mark.parametrize(
    ("overrides", "part"),
    [
        (["env=CartPole-v7"], "CartPole-v7"),
        (["env=os:CartPole-v1"], "os:CartPole-v1"),
        (["env.args.x=3"], "'x'"),
    ],
)
def test_environments_that_cannot_be_used(overrides: list[str], part: str) -> None:
    with pytest.raises(EnvError, match=part):
        plan(*overrides)


def test_dqn_needs_discrete_actions() -> None:
    with pytest.raises(EnvError, match="Pendulum-v1"):
        plan(source={"env": "Pendulum-v1", "algorithm": "dqn"})
    assert len(plan(source={"env": "Pendulum-v1", "algorithm": "ppo"}).trials) == 1


def test_far_too_many_trials_are_refused_before_they_are_drawn() -> None:
    with pytest.raises(SpecError, match="4,000,000 trials"):
        plan("num_samples=1000000")


def test_env_steps_are_bounded_by_the_cap_and_one_iteration_a_trial() -> None:
    # 1,024 steps an iteration, 8 at a time, of which the last 8 may be one too many.
    assert plan("num_samples=1").max_env_steps == 4 * (99_999 + 1_032)
    assert plan("num_samples=1", "stop.num_iterations=2").max_env_steps == 4 * 2 * 1_032
    dqn = {"env": "CartPole-v1", "algorithm": "dqn", "stop": {"num_env_steps": 5_000}}
    assert plan(source=dqn).max_env_steps == 4_999 + 999 + 4
    # An iteration may end with a whole sampling phase more than it needs.
    values = {"env_steps_per_iteration": 1_000, "train_freq": 256, "num_envs": 8}
    assert plan(source=dqn | {"hyperparams": values}).max_env_steps == 4_999 + 999 + 255 + 8


def test_disk_grows_with_networks_checkpoints_and_trials() -> None:
    least = plan("num_samples=1").max_disk_bytes
    assert least < 50e6
    assert plan().max_disk_bytes > least
    assert plan("num_samples=1", "checkpoints.keep=4").max_disk_bytes > least
    # The latest is one of the newest, and is kept in any case.
    none, one = (plan("num_samples=1", f"checkpoints.keep={keep}").max_disk_bytes for keep in (0, 1))
    assert none == one < least
    wide = plan("num_samples=1", "space.hidden_sizes=", "hyperparams.hidden_sizes=[1024, 1024]").max_disk_bytes
    # Two networks of a million weights, 4 bytes each, with Adam's two moments, in four checkpoints, for two
    # trials.
    assert wide - least > 2 * 4 * 2 * 1e6 * 4 * 3


def test_disk_counts_what_convolutions_make_of_an_image() -> None:
    """64 channels of nearly every pixel are far more numbers than the image has."""
    source = {
        "env": {"id": "CartPole-v1", "pixels": True},
        "algorithm": "dqn",
        "hyperparams": {"hidden_sizes": [16], "conv_filters": [[64, 3, 1]]},
    }
    made = 38 * 58 * 64  # of 40 x 60 pixels
    narrow = plan(source=source | {"hyperparams": {"hidden_sizes": [16], "conv_filters": [[4, 8, 4]]}}).max_disk_bytes
    # 4 bytes a weight, in four checkpoints at least.
    assert plan(source=source).max_disk_bytes - narrow > 4 * 4 * 16 * (made - 9 * 14 * 4)


def test_notes_tell_what_may_not_be_meant() -> None:
    assert "repeats every point" in plan("space.lr=").notes[0]
    assert "below CartPole-v0's threshold 195" in plan("stop.training_return=100").notes[0]
    assert "only 2 trials can run" in plan("resources.max_concurrent=8", "engine=rllib").notes[0]
    few = 'space={"lr": {"choice": [0.001, 0.01]}, "activation": {"choice": ["relu", "tanh"]}}'
    assert "has 4 different points, so some of the 5 that num_samples" in plan(few, "num_samples=5").notes[0]
    assert "so some of the 30" in plan(few, "num_samples=30", "search=gp").notes[0]
    assert plan(few, "num_samples=4").notes == ()
    assert plan("space=", "num_samples=1").notes == ()


def test_trial_ids_sort_and_stay_distinct() -> None:
    assert [trial_id(index) for index in (0, 7, 9_999, 10_000)] == ["t0000", "t0007", "t9999", "t10000"]


def test_this_machine_has_no_more_cpus_than_may_be_used() -> None:
    machine = local_machine()
    assert 1 <= machine.num_cpus <= len(os.sched_getaffinity(0))
    assert machine.num_cpus == math.floor(machine.num_cpus)
    # /proc/meminfo is there wherever the affinity is.
    assert machine.memory_bytes is not None
    assert 1e6 < machine.memory_bytes < 1e15


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"cpu.max": "150000 100000\n"}, 1.5),
        ({"cpu.max": "max 100000\n"}, None),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None),
        ({}, None),
    ],
)
def test_container_limits_are_read(tmp_path: Path, files: dict[str, str], expected: float | None) -> None:
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    assert machine_module._cgroup_quota(tmp_path) == expected


V1 = {"memory/memory.limit_in_bytes": "5000\n", "memory/memory.usage_in_bytes": "4000\n"}
V2 = {"memory.max": "5000\n", "memory.current": "4000\n"}


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (V2 | {"memory.stat": "anon 3000\ninactive_file 700\n"}, 1700),
        (V2 | {"memory.max": "max\n", "memory.stat": "inactive_file 700\n"}, None),
        (V2 | {"memory.current": "7000\n", "memory.stat": "inactive_file 700\n"}, 0),
        (V1 | {"memory/memory.stat": "inactive_file 1\ntotal_inactive_file 700\n"}, 1700),
        (V2, None),
        ({}, None),
    ],
)
def test_a_containers_limit_of_memory_is_read_without_the_files_it_keeps(
    tmp_path: Path, files: dict[str, str], expected: int | None
) -> None:
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    assert machine_module._cgroup_memory(tmp_path) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [("MemTotal: 9 kB\nMemAvailable:    3 kB\n", 3072), ("MemTotal: 9 kB\n", None), ("MemAvailable:\n", None)],
)
def test_available_memory_is_read(tmp_path: Path, text: str, expected: int | None) -> None:
    (tmp_path / "meminfo").write_text(text)
    assert machine_module._available_memory(tmp_path / "meminfo") == expected
    assert machine_module._available_memory(tmp_path / "none") is None


@pytest.mark.parametrize(("visible", "expected"), [("", 0), ("-1", 0), ("0", 1), ("0,2", 2)])
def test_gpus_are_those_that_cuda_would_see(monkeypatch: pytest.MonkeyPatch, visible: str, expected: int) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.setattr(machine_module, "uses_gpus", lambda: True)
    assert (local_machine().num_gpus, local_machine().unusable_gpus) == (expected, 0)


def test_gpus_that_pytorch_cannot_use_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    monkeypatch.setattr(machine_module, "uses_gpus", lambda: False)
    machine = local_machine()
    assert (machine.num_gpus, machine.unusable_gpus) == (0, 2)
    spec = load_spec({"env": "CartPole-v1", "algorithm": "ppo"}, ["resources.num_gpus=0.5"])
    with pytest.raises(CannotRunError, match=r"needs 0\.5 GPUs; this machine has 2, .* for CPUs alone") as caught:
        make_plan(spec, machine)
    assert "PyTorch's build for CUDA" in str(caught.value)


def test_replications_add_seeds_to_points_and_change_no_trial() -> None:
    spec = load_spec(
        {"env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"uniform": [1e-4, 1e-2]}}, "num_samples": 3}
    )
    before = make_plan(spec, Machine(1))
    added = [ReplicationRecord(num_points=3, points=(2, 0, 2))]
    after = make_plan(spec, Machine(1), replications=added)
    assert after.trials[:3] == before.trials
    new = after.trials[3:]
    assert [(trial.trial_id, trial.point_index, trial.seed_index) for trial in new] == [
        ("t0003", 2, 1), ("t0004", 0, 1), ("t0005", 2, 2),
    ]  # fmt: skip
    assert [trial.point for trial in new] == [before.trials[index].point for index in (2, 0, 2)]
    assert [trial.hyperparams for trial in new] == [before.trials[index].hyperparams for index in (2, 0, 2)]
    assert len({trial.seed for trial in after.trials}) == 6
    assert after.max_env_steps == 2 * before.max_env_steps
    # Points that are added later come behind them, and draw what they would have drawn.
    more = make_plan(spec.model_copy(update={"num_samples": 5}), Machine(1), replications=added)
    assert more.trials[:6] == after.trials
    longer = make_plan(spec.model_copy(update={"num_samples": 5}), Machine(1))
    assert [trial.point for trial in more.trials[6:]] == [trial.point for trial in longer.trials[3:]]
