"""Packs: how many there are, how many trials at once in each, and how their environments step."""

from typing import Any

import pytest
from pack_plans import DQN, TPE, fake_reasons, plan

from policies.guard import guarded
from policies.packed.envs.make import StepTime
from tests.narrowing import present
from tune_jobs.plan import pack_plan
from tune_jobs.plan.machine import Machine


@pytest.fixture
def slow_env(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every environment be one whose steps take long."""
    monkeypatch.setattr(guarded, "measure_step", lambda env_id, env_args, *, timeout_s: StepTime(5000.0))


def packs(machine: float | Machine = 2, **fields: Any) -> tuple[int, int]:
    made = present(plan(machine, **fields).packs)
    return made.num_packs, made.slots


# -- sizes


@pytest.mark.parametrize(
    ("machine", "fields", "expected"),
    [
        (2, {}, (2, 5)),
        (1, {}, (1, 10)),
        (3.5, {}, (3, 4)),
        (64, {}, (10, 1)),
        (2, {"num_samples": 1}, (1, 1)),
        # 500 trials a pack in 8 turns, of 63 at most: no turn of a few that one pack trains alone.
        (2, {"num_samples": 1000}, (2, 63)),
        (2, {"num_samples": 200}, (2, 50)),
        (2, {"resources": {"max_concurrent": 1}}, (1, 1)),
        (2, {"resources": {"max_concurrent": 5}}, (2, 2)),
        (2, {"resources": {"max_concurrent": 100}}, (2, 5)),
        (8, {"resources": {"num_cpus": 3}}, (2, 5)),
        (Machine(8, nodes=((5, 0), (3, 0))), {"resources": {"num_cpus": 2}}, (3, 4)),
        (Machine(8, 1), {"resources": {"num_gpus": 1}}, (1, 10)),
        (Machine(8, 2), {"resources": {"num_gpus": 0.5}}, (4, 3)),
        (Machine(8, 1, nodes=((2, 1), (6, 0))), {"resources": {"num_gpus": 0.25}}, (2, 5)),
    ],
)
def test_packs_fill_the_machine(machine: float | Machine, fields: dict[str, Any], expected: tuple[int, int]) -> None:
    assert packs(machine, **fields) == expected


def test_trials_at_once_are_those_of_all_packs() -> None:
    assert plan(2).max_concurrent == 10
    assert plan(3).max_concurrent == 10
    assert plan(2, num_samples=1000).max_concurrent == 2 * 63
    assert plan(2, resources={"max_concurrent": 5}).max_concurrent == 4
    made = present(plan(8, resources={"num_cpus": 3}).packs)
    assert (made.cpus_per_pack, made.gpus_per_pack) == (3, 0)


@pytest.mark.parametrize(("cpus", "expected"), [(1, (1, 4)), (2, (2, 2)), (3, (3, 1)), (4, (4, 1)), (16, (16, 1))])
def test_few_trials_run_at_once_where_a_model_learns_from_those_that_ended(
    cpus: int, expected: tuple[int, int]
) -> None:
    assert packs(cpus, **TPE) == expected
    assert packs(cpus, **{**TPE, "resources": {"max_concurrent": 1}}) == (1, 1)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"num_samples": 49}, (2, 2)),
        ({"num_samples": 100}, (2, 5)),
        ({"num_samples": 32, "seeds_per_point": 3}, (2, 4)),
        ({"num_samples": 1_000}, (2, 50)),
        ({"num_samples": 10_000}, (2, 64)),
        ({"num_samples": 100, "resources": {"max_concurrent": 6}}, (2, 3)),
    ],
)
def test_a_tenth_of_many_trials_run_at_once_where_a_model_learns(
    fields: dict[str, Any], expected: tuple[int, int]
) -> None:
    assert packs(**{**TPE, **fields}) == expected


# -- memory

# Observations of 4 numbers, before and after, action, reward, discount: 48 bytes a transition.
LONG: dict[str, Any] = {**DQN, "stop": {"num_env_steps": 10_000_000}}
MEMORY: dict[str, Any] = {**LONG, "hyperparams": {"replay_capacity": 1_000_000}}
MEMBER = 48e6


def test_packs_are_smaller_where_memory_is_short() -> None:
    assert packs(**MEMORY) == (2, 5)
    roomy = plan(Machine(2, memory_bytes=2.1 * 10 * MEMBER), **MEMORY)
    assert (present(roomy.packs).slots, present(roomy.packs).notes) == (5, ())
    tight = plan(Machine(2, memory_bytes=2.1 * 6 * MEMBER), **MEMORY)
    assert (present(tight.packs).num_packs, present(tight.packs).slots) == (2, 3)
    (note,) = present(tight.packs).notes
    # Ten trials of 48 MB; half of what there is.
    assert "Packs are planned smaller: 2 x 5 trials at once may take 481.5 MB of memory" in note
    assert "half of what this machine has available is 302.4 MB. 2 x 3 trials run at once" in note
    assert tight.max_concurrent == 6


def test_fewer_packs_where_memory_is_shorter_still() -> None:
    made = plan(Machine(2, memory_bytes=2.1 * MEMBER), **MEMORY)
    assert (present(made.packs).num_packs, present(made.packs).slots) == (1, 1)
    assert "1 x 1 trials run at once" in present(made.packs).notes[0]


def test_fewer_packs_where_their_processes_take_the_memory() -> None:
    assert packs(Machine(64, memory_bytes=8e9), num_samples=64) == (64, 1)
    made = present(plan(Machine(64, memory_bytes=4e9), num_samples=64).packs)
    assert (made.num_packs, made.slots) == (39, 1)
    (note,) = made.notes
    assert note.startswith("Packs are planned smaller: 64 x 1 trials at once may take 6.5 GB of memory with their ")
    assert note.endswith("processes, and what this machine has available is 4.0 GB. 39 x 1 trials run at once.")


@pytest.mark.parametrize(("num_cpus", "gb", "expected"), [(32, 2, (15, 16)), (64, 4, (30, 16)), (64, 16, (64, 16))])
def test_packs_are_fewer_rather_than_tiny_where_their_processes_take_the_memory(
    num_cpus: int, gb: float, expected: tuple[int, int]
) -> None:
    members = [pack_plan.TrialToPack(f"t{index:04}", None, 2e6) for index in range(1024)]
    num_packs, slots, notes = pack_plan._by_memory(Machine(num_cpus, memory_bytes=gb * 1e9), members, num_cpus, 16, 1)
    assert (num_packs, slots) == expected
    if num_packs == num_cpus:
        assert notes == ()
        return
    # Their trials alone take about half.
    assert "of memory with their processes, and what this machine has available is" in notes[0]
    assert notes[0].endswith(f"{num_packs} x 16 trials run at once.")


def test_no_pack_is_given_up_for_a_trial_more() -> None:
    members = [pack_plan.TrialToPack(f"t{index:04}", None, 48e6) for index in range(128)]
    # One pack could train 63.
    (num_packs, slots, (note,)) = pack_plan._by_memory(Machine(2, memory_bytes=63.5 * 96e6), members, 2, 64, 1)
    assert (num_packs, slots) == (2, 31)
    assert "and half of what this machine has available is 3.0 GB" in note


def test_a_trial_that_is_too_large_alone_has_a_pack_of_its_own() -> None:
    made = plan(Machine(2, memory_bytes=MEMBER), **MEMORY)
    assert (present(made.packs).num_packs, present(made.packs).slots) == (1, 1)
    (note,) = present(made.packs).notes
    assert "one trial may take 48.2 MB of memory, more than half of what this machine has available, 24.0 MB" in note
    assert "One pack trains one trial at a time" in note
    assert made.engines == {"packed": 10}


def test_a_few_large_trials_do_not_make_all_places_large() -> None:
    space = {"replay_capacity": {"grid": [1_000, 10_000_000]}}
    machine = Machine(1, memory_bytes=2.1 * (10 * MEMBER * 2))
    # Two of them, and six small ones: all fit at once.
    assert packs(machine, **{**LONG, "space": {"replay_capacity": {"grid": [1_000]}}}) == (1, 10)
    made = plan(machine, **LONG, space=space, num_samples=1, seeds_per_point=2)
    assert (present(made.packs).num_packs, present(made.packs).slots) == (1, 4)
    made = plan(machine, **LONG, space=space, num_samples=1, seeds_per_point=3)
    assert (present(made.packs).num_packs, present(made.packs).slots) == (1, 2)


@pytest.mark.parametrize("search", [{}, {"search": {"type": "tpe", "num_startup_trials": 1}}])
def test_points_that_are_not_known_count_with_the_largest_memory(search: dict[str, Any]) -> None:
    space = {"replay_capacity": {"qlograndint": [1000, 1_000_000, 1000]}}
    machine = Machine(1, memory_bytes=2.1 * 3 * MEMBER)
    fields = {**LONG, "space": space, "num_samples": 12}
    if search:
        assert packs(machine, **fields, **search) == (1, 3)
    else:
        # Known points, of which many are smaller.
        assert packs(machine, **fields)[1] > 3


def test_a_memory_counts_as_large_as_the_training_fills_it() -> None:
    machine, larger = Machine(2, memory_bytes=2.1 * 10 * MEMBER), {"replay_capacity": 100_000_000}
    assert packs(machine, **{**MEMORY, "hyperparams": larger, "stop": {"num_env_steps": 1_000_000}}) == (2, 5)
    assert packs(machine, **{**MEMORY, "hyperparams": larger, "stop": {"num_env_steps": 2_000_000}}) == (2, 2)
    # By iterations, of 1,000 env steps each, it ends too.
    stop = {"num_env_steps": 2_000_000, "num_iterations": 1_000}
    assert packs(machine, **{**MEMORY, "hyperparams": larger, "stop": stop}) == (2, 5)


def test_on_a_cluster_the_node_where_packs_get_least_decides() -> None:
    nodes = Machine(8, nodes=((4, 0), (4, 0)), memory_bytes=2.1 * 4 * MEMBER)
    # Two packs may come to lie on one node, which has half of the memory.
    made = plan(nodes, **{**MEMORY, "num_samples": 2}).packs
    assert (present(made).num_packs, present(made).slots) == (2, 1)
    made = plan(nodes, **{**MEMORY, "num_samples": 3}).packs
    assert (present(made).num_packs, present(made).slots) == (2, 1)


# -- environments


def test_the_plan_says_how_environments_step() -> None:
    made = present(plan().packs)
    assert made.env_kind == "vectorised"
    assert made.num_env_processes == 0
    assert made.env_step_us is None or made.env_step_us > 0


ONE_GPU = {"resources": {"num_gpus": 1}}
FOUR_ENVS = {"hyperparams": {"num_envs": 4, "train_batch_size": 64, "minibatch_size": 32}}


@pytest.mark.parametrize(
    ("machine", "fields", "packs", "processes"),
    [
        # One GPU, so one pack of ten trials, and 7 CPUs beside it.
        (Machine(8, 1), ONE_GPU, 1, 7),
        # On one node, or the pack would wait for ever.
        (Machine(64, 1, nodes=((4, 1), (60, 0))), ONE_GPU, 1, 3),
        # No more than sub-environments: four of each of ten trials, of one.
        (Machine(64, 1), {**ONE_GPU, **FOUR_ENVS}, 1, 40),
        (Machine(64), {"num_samples": 1, **FOUR_ENVS}, 1, 4),
        # One trial alone has its sub-environments to share out.
        (4, {"num_samples": 1, **FOUR_ENVS}, 1, 3),
        (2, {"num_samples": 1, **FOUR_ENVS}, 1, 1),
        # As many for each pack.
        (4, {"num_samples": 2, **FOUR_ENVS}, 2, 1),
        (9, {"num_samples": 2, **FOUR_ENVS}, 2, 3),
        (16, {"resources": {"max_concurrent": 2}, **FOUR_ENVS}, 2, 4),
        (8, {"num_samples": 1, "resources": {"num_cpus": 3}, **FOUR_ENVS}, 1, 4),
        # Chosen when it starts, a point has as many as those that are known.
        (4, {**TPE, "num_samples": 12, "resources": {"max_concurrent": 1}, **FOUR_ENVS}, 1, 3),
    ],
)
def test_idle_cpus_step_slow_environments(
    slow_env: None, machine: float | Machine, fields: dict[str, Any], packs: int, processes: int
) -> None:
    made = present(plan(machine, **fields).packs)
    assert (made.env_kind, made.num_packs, made.num_env_processes) == (
        "processes",
        packs,
        processes,
    )
    assert made.cpus_per_pack == fields.get("resources", {}).get("num_cpus", 1) + processes
    idle = "one CPU" if processes == 1 else f"{processes} CPUs"
    assert (made.env_step_us, made.why_env_kind) == (
        5000.0,
        f"a step takes 5.0 ms, and {idle} would be idle",
    )


@pytest.mark.parametrize(
    ("machine", "fields", "why"),
    [
        (2, {}, "no CPU is idle"),
        (1, {"num_samples": 1}, "no CPU is idle"),
        # Ten packs, and six CPUs beside them.
        (16, {}, "there is not an idle CPU for each of the 10 packs"),
        (16, {"num_samples": 1, "hyperparams": {"num_envs": 1}}, "there is only one sub-environment"),
    ],
)
def test_no_idle_cpus_no_processes(slow_env: None, machine: int, fields: dict[str, Any], why: str) -> None:
    made = present(plan(machine, **fields).packs)
    assert (made.env_kind, made.num_env_processes) == ("scalar", 0)
    assert made.why_env_kind.startswith(f"a step takes 5.0 ms, but {why}")


def test_cpus_that_other_trials_need_are_not_idle(slow_env: None, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_reasons(monkeypatch, [0.2])
    space: dict[str, Any] = {"space": {"lr": {"grid": [0.1, 0.2, 0.3]}}, "num_samples": 1, "resources": {"num_gpus": 1}}
    made = present(plan(Machine(8, 1), **space).packs)
    assert made.num_env_processes == 0
    assert made.why_env_kind.endswith("but other trials need the idle CPUs")
