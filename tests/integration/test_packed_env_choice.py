"""How the environments of a pack are stepped, and which cannot be packed."""

import re
from typing import Any

import pytest
from policy_factory import register_test_envs
from test_packed_envs import own_modules

from policies.envs.first_step import Carried
from policies.envs.make import check_env
from policies.errors import EnvError
from policies.guard import guarded
from policies.packed.envs.make import StepTime, check_seedable, choose_kind, measure_step
from tests.narrowing import present

__all__ = ["own_modules"]

register_test_envs()


@pytest.mark.parametrize("env_id", ["CartPole-v1", "MountainCarContinuous-v0", "Pendulum-v1"])
def test_classic_control_is_vectorised(env_id: str) -> None:
    step = measure_step(env_id, {"max_episode_steps": 200})
    assert present(step.us) > 0
    assert choose_kind(step, spare_cpus=4).kind == "vectorised"
    assert choose_kind(measure_step(env_id, {"frame_stack": 2}), spare_cpus=4).kind == "scalar"


def test_a_fast_env_stays_in_the_process() -> None:
    step = measure_step("policy_factory:Walk", None)
    assert present(step.us) > 0
    choice = choose_kind(StepTime(80.4), spare_cpus=4)
    assert (choice.kind, choice.why) == ("scalar", "a step takes 80 us")


def test_a_slow_env_gets_processes_where_cpus_are_idle() -> None:
    step = measure_step("odd_envs:Slow", None)
    assert present(step.us) > 2000
    choice = choose_kind(step, spare_cpus=2)
    assert choice.kind == "processes"
    assert choice.why.endswith("ms, and 2 CPUs would be idle")
    choice = choose_kind(step, spare_cpus=0, why_none="no CPU is idle")
    assert choice.kind == "scalar"
    assert choice.why.endswith("ms, but no CPU is idle")


def test_a_step_longer_than_all_the_time_for_measuring_is_measured() -> None:
    step = measure_step("odd_envs:VerySlow", None)
    assert present(step.us) > 250_000
    assert choose_kind(step, spare_cpus=1).kind == "processes"


@pytest.mark.parametrize("fail_at", [1, 2, 3, 50])
def test_an_env_that_raises_is_left_to_its_trial(fail_at: int) -> None:
    step = measure_step("TestWalk-v0", {"fail_at": fail_at})
    assert (step.us is None) == (fail_at == 1)
    assert choose_kind(step, spare_cpus=0).kind == "scalar"
    check_seedable("TestWalk-v0", {"fail_at": fail_at})


@pytest.mark.parametrize(
    ("env_id", "env_args"),
    [
        ("CartPole-v1", None),
        ("CartPole-v1", {"pixels": True}),
        ("Pendulum-v1", None),
        ("TestWalk-v0", {"end": 1.0}),
        ("odd_envs:Slow", None),
    ],
)
def test_envs_that_can_be_seeded(env_id: str, env_args: dict[str, Any] | None) -> None:
    check_seedable(env_id, env_args)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Unseedable", "odd_envs:Unseedable cannot be seeded.* the observation at first .*of it.* is .* one time and "),
        ("ForgetsLater", "odd_envs:ForgetsLater cannot be seeded.* the next episode's first observation after 7 steps"),
        (
            "Sharing",
            "odd_envs:Sharing depends on other environments in the same process.* the observation after 1 step ",
        ),
    ],
)
def test_envs_that_cannot_be_seeded_are_refused_with_what_differs(name: str, words: str) -> None:
    with pytest.raises(EnvError, match=words) as caught:
        check_seedable(f"odd_envs:{name}", None)
    assert "engine: rllib" in caught.value.hint


def test_the_guard_tells_of_what_cannot_be_seeded_too() -> None:
    assert guarded.check_env("odd_envs:Slow", None).unrepeated is None
    assert re.fullmatch(
        r"\[0\] is -?[\d.]+ and then -?[\d.]+", present(guarded.check_env("odd_envs:Unseedable", None).unrepeated)
    )


def test_the_guard_tells_what_an_episode_leaves_to_the_next() -> None:
    assert guarded.check_env("odd_envs:Accumulates", None).carried == Carried("its reward is 1 and then 2")
    # In a process of its own, where no wrapper is seen, what it does is.
    alone = guarded.check_env("odd_envs:Scaled", {"own_process": True})
    assert re.fullmatch(r"its reward is -?[\d.]+ and then -?[\d.]+", present(alone.carried.step))
    assert not alone.carried.scales_rewards
    assert guarded.check_env("odd_envs:Scaled", None).carried.scales_rewards


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Taxi-v3", "policy_factory:Walk"])
def test_the_guard_tells_what_is_told_without_it(env_id: str) -> None:
    assert guarded.check_env(env_id, None) == check_env(env_id, None)
