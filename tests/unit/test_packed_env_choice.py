"""How the environments of a pack are stepped, and which cannot be packed."""

import pytest
from policy_factory import register_test_envs
from test_packed_envs import own_modules

from policies.errors import EnvError
from policies.packed.envs import check_seedable, choose_kind

__all__ = ["own_modules"]

register_test_envs()


def test_cartpole_is_vectorised():
    choice = choose_kind("CartPole-v1", {"max_episode_steps": 200}, spare_cpus=4)
    assert choice.kind == "vectorised"
    assert choice.step_us > 0
    assert choose_kind("CartPole-v1", {"frame_stack": 2}, spare_cpus=4).kind == "scalar"


def test_a_fast_env_stays_in_the_process():
    choice = choose_kind("Pendulum-v1", None, spare_cpus=4)
    assert choice.kind == "scalar"
    assert 0 < choice.step_us < 1000
    assert choice.why == f"a step takes {choice.step_us:.0f} us"


def test_a_slow_env_gets_processes_where_cpus_are_idle():
    choice = choose_kind("odd_envs:Slow", None, spare_cpus=2)
    assert choice.kind == "processes"
    assert 2000 < choice.step_us < 20_000
    assert choice.why.endswith("ms, and 2 CPUs would be idle")
    choice = choose_kind("odd_envs:Slow", None, spare_cpus=0)
    assert choice.kind == "scalar"
    assert choice.why.endswith("ms, but no CPU is idle")


@pytest.mark.parametrize("fail_at", [1, 2, 3, 50])
def test_an_env_that_raises_is_left_to_its_trial(fail_at):
    choice = choose_kind("TestWalk-v0", {"fail_at": fail_at}, spare_cpus=0)
    assert choice.kind == "scalar"
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
def test_envs_that_can_be_seeded(env_id, env_args):
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
def test_envs_that_cannot_be_seeded_are_refused_with_what_differs(name, words):
    with pytest.raises(EnvError, match=words) as caught:
        check_seedable(f"odd_envs:{name}", None)
    assert "engine: rllib" in caught.value.hint
