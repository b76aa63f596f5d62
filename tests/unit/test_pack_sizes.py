"""Packs: how many there are, how many trials at once in each, and how their environments step."""

import dataclasses

import pytest
from pack_plans import DQN, TPE, fake_reasons, plan

from policies.packed import envs as packed_envs
from tune_jobs.machine import Machine


@dataclasses.dataclass(frozen=True)
class Choice:
    kind: str
    step_us: float
    why: str


@pytest.fixture
def slow_env(monkeypatch):
    """Let every environment be one whose steps take long; returns how many spare CPUs were offered."""
    offered = []

    def choose_kind(env_id, env_args, *, spare_cpus):
        offered.append(spare_cpus)
        return Choice("processes" if spare_cpus else "scalar", 5000.0, "a step takes 5,000 us")

    monkeypatch.setattr(packed_envs, "choose_kind", choose_kind)
    return offered


def packs(machine=2, **fields):
    made = plan(machine, **fields).packs
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
def test_packs_fill_the_machine(machine, fields, expected):
    assert packs(machine, **fields) == expected


def test_trials_at_once_are_those_of_all_packs():
    assert plan(2).max_concurrent == 10
    assert plan(3).max_concurrent == 10
    assert plan(2, num_samples=1000).max_concurrent == 2 * 63
    assert plan(2, resources={"max_concurrent": 5}).max_concurrent == 4
    made = plan(8, resources={"num_cpus": 3}).packs
    assert (made.cpus_per_pack, made.gpus_per_pack) == (3, 0)


@pytest.mark.parametrize(("cpus", "expected"), [(1, (1, 4)), (2, (2, 2)), (3, (3, 1)), (4, (4, 1)), (16, (16, 1))])
def test_few_trials_run_at_once_where_a_model_learns_from_those_that_ended(cpus, expected):
    assert packs(cpus, **TPE) == expected
    assert packs(cpus, **{**TPE, "resources": {"max_concurrent": 1}}) == (1, 1)


# -- memory

# Observations of 4 numbers, before and after, action, reward, discount: 48 bytes a transition.
MEMORY = {**DQN, "hyperparams": {"replay_capacity": 1_000_000}}
MEMBER = 48e6


def test_packs_are_smaller_where_memory_is_short():
    assert packs(**MEMORY) == (2, 5)
    roomy = plan(Machine(2, memory_bytes=2.1 * 10 * MEMBER), **MEMORY)
    assert (roomy.packs.slots, roomy.packs.notes) == (5, ())
    tight = plan(Machine(2, memory_bytes=2.1 * 6 * MEMBER), **MEMORY)
    assert (tight.packs.num_packs, tight.packs.slots) == (2, 3)
    (note,) = tight.packs.notes
    # Ten trials of 0.05 GB; half of what there is.
    assert "Packs are planned smaller: 2 x 5 trials at once may take 0.5 GB of memory" in note
    assert "half of what this machine has available is 0.3 GB. 2 x 3 trials run at once" in note
    assert tight.max_concurrent == 6


def test_fewer_packs_where_memory_is_shorter_still():
    made = plan(Machine(2, memory_bytes=2.1 * MEMBER), **MEMORY)
    assert (made.packs.num_packs, made.packs.slots) == (1, 1)
    assert "1 x 1 trials run at once" in made.packs.notes[0]


def test_a_trial_that_is_too_large_alone_has_a_pack_of_its_own():
    made = plan(Machine(2, memory_bytes=MEMBER), **MEMORY)
    assert (made.packs.num_packs, made.packs.slots) == (1, 1)
    (note,) = made.packs.notes
    assert "one trial may take 0.0 GB" in note or "one trial may take 0.1 GB" in note
    assert "One pack trains one trial at a time" in note
    assert made.engines == {"packed": 10}


def test_a_few_large_trials_do_not_make_all_places_large():
    space = {"replay_capacity": {"grid": [1_000, 10_000_000]}}
    machine = Machine(1, memory_bytes=2.1 * (10 * MEMBER * 2))
    # Two of them, and six small ones: all fit at once.
    assert packs(machine, **{**DQN, "space": {"replay_capacity": {"grid": [1_000]}}}) == (1, 10)
    made = plan(machine, **{**DQN, "space": space, "num_samples": 1, "seeds_per_point": 2})
    assert (made.packs.num_packs, made.packs.slots) == (1, 4)
    made = plan(machine, **{**DQN, "space": space, "num_samples": 1, "seeds_per_point": 3})
    assert (made.packs.num_packs, made.packs.slots) == (1, 2)


@pytest.mark.parametrize("search", [{}, {"search": {"type": "tpe", "num_startup_trials": 1}}])
def test_points_that_are_not_known_count_with_the_largest_memory(search):
    space = {"replay_capacity": {"qlograndint": [1000, 1_000_000, 1000]}}
    machine = Machine(1, memory_bytes=2.1 * 3 * MEMBER)
    fields = {**DQN, "space": space, "num_samples": 12}
    if search:
        assert packs(machine, **fields, **search) == (1, 3)
    else:
        # Known points, of which many are smaller.
        assert packs(machine, **fields)[1] > 3


def test_on_a_cluster_the_node_where_packs_get_least_decides():
    nodes = Machine(8, nodes=((4, 0), (4, 0)), memory_bytes=2.1 * 4 * MEMBER)
    # Two packs may come to lie on one node, which has half of the memory.
    made = plan(nodes, **{**MEMORY, "num_samples": 2}).packs
    assert (made.num_packs, made.slots) == (2, 1)
    made = plan(nodes, **{**MEMORY, "num_samples": 3}).packs
    assert (made.num_packs, made.slots) == (2, 1)


# -- environments


def test_the_plan_says_how_environments_step():
    made = plan().packs
    assert made.env_kind == "vectorised"
    assert made.num_env_processes == 0
    assert made.env_step_us is None or made.env_step_us > 0


def test_idle_cpus_step_slow_environments(slow_env):
    # One GPU, so one pack, and 7 CPUs beside it.
    made = plan(Machine(8, 1), resources={"num_gpus": 1}).packs
    assert (made.env_kind, made.num_env_processes, made.cpus_per_pack) == ("processes", 7, 8)
    assert (made.env_step_us, made.why_env_kind) == (5000.0, "a step takes 5,000 us")
    made = plan(Machine(64, 1), resources={"num_gpus": 1}).packs
    # No more than trials in a pack, whose environments stay together.
    assert (made.slots, made.num_env_processes) == (10, 10)
    # On one node, or the pack would wait for ever.
    made = plan(Machine(64, 1, nodes=((4, 1), (60, 0))), resources={"num_gpus": 1}).packs
    assert (made.num_env_processes, made.cpus_per_pack) == (3, 4)


def test_no_idle_cpus_no_processes(slow_env):
    assert plan(2).packs.env_kind == "scalar"
    # Each trial has a pack of its own, and nothing to share out.
    assert plan(16).packs.num_env_processes == 0
    assert slow_env == [0, 0]


def test_cpus_that_other_trials_need_are_not_idle(slow_env, monkeypatch):
    fake_reasons(monkeypatch, [0.2])
    space = {"space": {"lr": {"grid": [0.1, 0.2, 0.3]}}, "num_samples": 1, "resources": {"num_gpus": 1}}
    assert plan(Machine(8, 1), **space).packs.num_env_processes == 0
    assert slow_env == [0]
