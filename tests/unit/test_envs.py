from __future__ import annotations

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleEnv, CartPoleVectorEnv
from hostile_envs import Malformed
from policy_factory import register_test_envs

from policies.acting.baselines import ConstantPolicy
from policies.acting.evaluate import evaluate_policy
from policies.envs import modules as env_modules
from policies.envs.checked import CheckedEnvs
from policies.envs.make import check_env, make_env, make_vector_env, normalize_env_id
from policies.envs.modules import allow_modules
from policies.errors import EnvError
from policies.packed.envs.make import make_packed_envs
from tests.narrowing import present

register_test_envs()


@pytest.fixture(autouse=True)
def _own_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["hostile_envs"])


ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("env_id", "steps", "threshold"), [("CartPole-v0", 200, 195.0), ("CartPole-v1", 500, 475.0)])
def test_both_cartpoles_are_known_without_a_word(
    env_id: str, steps: int, threshold: float, capfd: pytest.CaptureFixture[str]
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        info = check_env(env_id, None, "ppo")
        cast("Any", make_env(env_id)).close()
        make_vector_env(env_id, None, 2).close()
    assert (info.env_id, info.max_episode_steps, info.threshold) == (env_id, steps, threshold)
    assert info.has_vector_entry_point
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("limit", [200, 500, 30])
def test_the_vectorised_cartpole_has_the_time_limit_of_the_scalar_one(limit: int) -> None:
    args = {"max_episode_steps": 30} if limit == 30 else {}
    env = make_vector_env("CartPole-v0" if limit == 200 else "CartPole-v1", args, 3)
    env.reset(seed=0)
    for step in range(1, limit + 1):
        state = env.unwrapped.state
        state[:] = 0.0  # upright for ever
        _, _, terminated, truncated, _ = env.step(np.zeros(3, np.int64))
        assert not terminated.any()
        assert truncated.all() == (step == limit)


def test_an_env_without_a_vectorised_version_is_looped_over_with_its_limit() -> None:
    info = check_env("Pendulum-v1", {"g": 9.0}, "ppo")
    assert not info.has_vector_entry_point
    env = make_vector_env("Pendulum-v1", {"g": 9.0}, 2)
    assert isinstance(env, gym.vector.SyncVectorEnv)
    assert [cast("Any", one.unwrapped).g for one in env.envs] == [9.0, 9.0]
    assert present(env.envs[0].spec).max_episode_steps == 200
    env.close()


def test_arguments_reach_the_env() -> None:
    assert cast("Any", make_env("CartPole-v1", {"sutton_barto_reward": True}).unwrapped)._sutton_barto_reward
    assert make_vector_env("CartPole-v1", {"sutton_barto_reward": True}, 2).unwrapped._sutton_barto_reward
    assert check_env("CartPole-v1", {"max_episode_steps": 7}, None).max_episode_steps == 7


def test_an_id_without_a_version_is_the_newest() -> None:
    assert normalize_env_id(" CartPole ") == "CartPole-v1"
    assert check_env("Pendulum", None, "ppo").env_id == "Pendulum-v1"


@pytest.mark.parametrize(
    ("env_id", "nearest"),
    [("cartpole-v1", "CartPole-v1"), ("CartPole-v7", "CartPole-v1"), ("Pendulm-v1", "Pendulum-v1")],
)
def test_an_unknown_id_names_the_nearest(env_id: str, nearest: str) -> None:
    with pytest.raises(EnvError, match=rf"{env_id!r}.*Did you mean .*{nearest!r}") as caught:
        check_env(env_id, None, None)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("env_id", "meant"),
    [
        ("badenvs.Base", "badenvs:Base"), ("a.b.Class", "a.b:Class"),
        ("my.env-v0", None), ("..Base", None), ("CartPole.v1", None),
    ],
)  # fmt: skip
def test_a_dot_in_the_place_of_the_colon_is_answered(env_id: str, meant: str | None) -> None:
    with pytest.raises(EnvError, match="is registered with Gymnasium") as caught:
        check_env(env_id, None, None)
    told = f"A class of a module is written module:Class: {meant!r}."
    assert (told in caught.value.message) is (meant is not None)
    assert "module:Class" not in caught.value.message.replace(told, "")


@pytest.mark.parametrize(
    ("env_id", "allowed", "told"),
    [
        ("Quarry-v0", ["test_shops"], "test_shops:Maze-v0"), ("Pendulm-v1", ["test_shops"], "test_shops:Maze-v0"),
        ("Xqzw-v0", [], "my_envs:Maze-v0"), ("Pendulm-v1", [], None),
    ],
)  # fmt: skip
def test_an_unknown_id_says_how_one_of_a_module_is_written(
    env_id: str, allowed: list[str], told: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set(allowed))
    with pytest.raises(EnvError, match="is registered with Gymnasium") as caught:
        check_env(env_id, None, None)
    assert ("module:id" in caught.value.hint) is (told is not None)
    assert told is None or told in caught.value.hint


@pytest.mark.parametrize("env_id", ["", "  ", None, 3, "a b c", "Nothing-v", "-v1", "x/y/z-v0"])
def test_what_is_no_id_is_refused(env_id: int | str | None) -> None:
    with pytest.raises(EnvError):
        check_env(env_id, None, None)  # type: ignore[arg-type]


def test_an_id_that_names_a_module_is_refused_and_the_module_is_not_imported(tmp_path: Path) -> None:
    (tmp_path / "evil_module.py").write_text("print('ran')")
    code = (
        "from policies.envs.make import *\n"
        "from policies.errors import EnvError\n"
        "for use in (check_env, make_env, lambda i, a: make_vector_env(i, a, 2)):\n"
        "    try: use('evil_module:CartPole-v1', None)\n"
        "    except EnvError as error:\n"
        "        assert 'colon' in error.message and '--allow-module evil_module' in error.hint, error\n"
        "    else: raise SystemExit('not refused')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_an_unknown_argument_names_the_nearest_and_all() -> None:
    with pytest.raises(EnvError, match=r"no argument 'sutton_barto' .*Did you mean 'sutton_barto_reward'") as caught:
        check_env("CartPole-v1", {"sutton_barto": True}, None)
    assert "max_episode_steps" in caught.value.hint


@pytest.mark.parametrize("name", ["render_mode", "num_envs", "wrappers", "disable_env_checker", "id"])
def test_arguments_that_are_set_elsewhere_are_refused(name: str) -> None:
    with pytest.raises(EnvError, match=name):
        make_env("CartPole-v1", {name: 1})


@pytest.mark.parametrize("limit", [0, -1, 2.5, "100", True, None])
def test_a_wrong_time_limit_is_refused(limit: bool | float | str | None) -> None:
    with pytest.raises(EnvError, match="max_episode_steps"):
        check_env("CartPole-v1", {"max_episode_steps": limit}, None)


def test_a_wrong_value_that_only_the_constructor_finds_is_an_env_error() -> None:
    with pytest.raises(EnvError, match="LunarLander-v3' cannot be made"):
        check_env("LunarLander-v3", {"gravity": 5.0}, None)


def test_a_constructor_that_fails_without_a_word_is_told_with_its_place() -> None:
    with pytest.raises(EnvError, match=r": AssertionError: at \S*hostile_envs.py:\d+ in assume\.\n") as caught:
        check_env("hostile_envs:Hostile", {"how": "assume", "where": "constructor"}, None)
    assert "documentation" in caught.value.hint


def test_a_constructor_that_fails_with_words_is_told_with_its_place_too() -> None:
    with pytest.raises(EnvError, match=r": ValueError: the motor broke \(\S*hostile_envs.py:\d+ in fail\)") as caught:
        check_env("hostile_envs:Hostile", {"how": "fail", "where": "constructor"}, None)
    assert "documentation" in caught.value.hint


@pytest.mark.parametrize(
    ("spaces", "words"),
    [
        ({"observation_space": gym.spaces.Box(0, 255, (8, 0, 3), np.uint8)}, "have 0 numbers"),
        ({"observation_space": gym.spaces.Dict(a=gym.spaces.Text(2))}, r"observation\['a'\] is of kind Text"),
        ({"action_space": gym.spaces.Text(3)}, r"action is of kind Text \(.*\), neither choices nor numbers"),
        ({"action_space": gym.spaces.Box(-1, 1, (0, 2))}, "of 0 numbers"),
        ({"action_space": gym.spaces.Dict(a=gym.spaces.Box(0, 1, (2,)), b=gym.spaces.Discrete(2))}, r"action\['a'\]"),
    ],
)
def test_spaces_that_cannot_be_taken_are_refused(spaces: dict[str, Any], words: str) -> None:
    with pytest.raises(EnvError, match=words):
        check_env("TestOdd-v0", spaces, "ppo")


def test_dqn_refuses_continuous_actions_and_says_what_to_do() -> None:
    assert check_env("Pendulum-v1", None, "ppo").action_space.shape == (1,)
    with pytest.raises(EnvError, match="DQN cannot train on Pendulum-v1") as caught:
        check_env("Pendulum-v1", None, "dqn")
    assert "ppo" in caught.value.hint


def test_a_reset_of_another_shape_than_declared_is_refused() -> None:
    class Liar(gym.Env[Any, Any]):
        observation_space = gym.spaces.Box(-1, 1, (2,))
        action_space = gym.spaces.Discrete(2)

        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[Any, dict[str, Any]]:
            return np.zeros(3, np.float32), {}

    gym.register("TestLiar-v0", cast("Any", Liar))
    try:
        with pytest.raises(EnvError, match=r"shape \(3,\) but declares \(2,\)"):
            check_env("TestLiar-v0", None, "ppo")
    finally:
        del gym.registry["TestLiar-v0"]


def test_a_vectorised_version_that_cannot_keep_the_time_limit_is_not_used() -> None:
    def without_limit(num_envs: int) -> None:
        raise AssertionError(num_envs)

    def with_limit(num_envs: int, max_episode_steps: int) -> None:
        raise AssertionError(num_envs)

    cartpole = "gymnasium.envs.classic_control:CartPoleEnv"
    for entry_point, used in ((without_limit, False), (with_limit, True)):
        gym.register("TestVector-v0", cartpole, vector_entry_point=cast("Any", entry_point), max_episode_steps=9)
        try:
            assert check_env("TestVector-v0", None, "ppo").has_vector_entry_point == used
            if not used:
                assert isinstance(make_vector_env("TestVector-v0", None, 2), gym.vector.SyncVectorEnv)
        finally:
            del gym.registry["TestVector-v0"]


@pytest.mark.parametrize(
    ("mode", "used"), [("NextStep", True), ("SameStep", False), ("Disabled", False), ("Soon", False)]
)
def test_a_vectorised_version_that_resets_at_another_time_is_not_used(mode: str, used: bool) -> None:
    class Vectorised(gym.vector.VectorEnv[Any, Any, Any]):
        metadata = {"autoreset_mode": mode}  # noqa: RUF012

        def __init__(self, num_envs: int) -> None:
            raise AssertionError(num_envs)

    gym.register(
        "TestVector-v0", "gymnasium.envs.classic_control:CartPoleEnv", vector_entry_point=cast("Any", Vectorised)
    )
    try:
        assert check_env("TestVector-v0", None, "ppo").has_vector_entry_point == used
    finally:
        del gym.registry["TestVector-v0"]


def test_a_vectorised_version_without_the_envs_mask_is_not_used() -> None:
    class Masked(CartPoleEnv):
        def action_masks(self) -> list[int]:
            return [0, 1]

    vectorised = cast("Any", CartPoleVectorEnv)
    gym.register("TestVector-v0", cast("Any", Masked), vector_entry_point=vectorised, max_episode_steps=9)
    cases: list[tuple[dict[str, Any], int]] = [({}, 6), ({"action_mask": False}, 4)]
    try:
        for args, size in cases:
            info, envs = check_env("TestVector-v0", args), make_vector_env("TestVector-v0", args, 2)
            assert info.observation_space.shape == envs.single_observation_space.shape == (size,)
            assert info.has_vector_entry_point == isinstance(envs.unwrapped, CartPoleVectorEnv) == (size == 4)
    finally:
        del gym.registry["TestVector-v0"]


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("alone", r"reset\(\) of \S+ returns array.* not the two values"),
        ("no info", "None as info, not a dict"),
        ("shape", r"observations of shape \(3,\) but declares \(2,\)"),
        ("none", r"observations of shape \(\) but declares \(2,\)"),
        ("text", "observations of dtype <U1 but declares float32"),
        ("nan", r"observations that are not finite: nan at \[1\]"),
        ("nothing", "None, not the two values"),
    ],
)
@pytest.mark.parametrize("limit", [None, 100])
def test_a_malformed_reset_is_refused_with_what_it_returns(fault: str, words: str, limit: int | None) -> None:
    args = {"reset": fault} | ({} if limit is None else {"max_episode_steps": limit})
    with pytest.raises(EnvError, match=words) as caught:
        check_env("hostile_envs:Malformed", args, "ppo")
    assert "(observation, info)" in caught.value.hint


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("four values", r"step\(\) of \S+ returns a tuple of 4, not the five values"),
        ("no reward", "None as reward, not a number"),
        ("text reward", "'1.0' as reward, not a number"),
        ("nan reward", "the reward nan"),
        ("huge reward", r"the reward 1e\+300, which is infinite in 32 bits"),
        ("huge observation", r"are not finite: 1e\+39 at \[1\], which is infinite in 32 bits"),
        ("two rewards", r"as reward, not a number: .*TransformReward\(env, sum\)"),
        ("rewards of agents", r"a list of 2 as reward, not a number: .*TransformReward\(env, sum\)"),
        ("rewards by name", r"as reward, not a number\.\n"),
        ("square of rewards", r"as reward, not a number\.\n"),
        ("empty reward", r"as reward, not a number\.\n"),
        ("uneven rewards", r"as reward, not a number\.\n"),
        ("texts as rewards", r"as reward, not a number\.\n"),
        ("number terminated", r"0 \(int\) as terminated, not a bool"),
        ("unshowable truncated", r"a value \(Unshowable\) as truncated, not a bool"),
        ("long text as reward", r"'x+\.\.\. as reward, not a number"),
        ("no truncated", r"None \(NoneType\) as truncated, not a bool"),
        ("shape", r"observations of shape \(2, 1\) but declares \(2,\)"),
        ("complex", "observations of dtype complex64 but declares float32"),
        ("infinite", r"observations that are not finite: inf at \[0\]"),
        ("no info", "a list of 2 as info, not a dict"),
        ("nothing", "None, not the five values"),
    ],
)
@pytest.mark.parametrize("limit", [None, 100])
def test_a_malformed_first_step_is_refused_with_what_it_returns(fault: str, words: str, limit: int | None) -> None:
    args = {"step": fault} | ({} if limit is None else {"max_episode_steps": limit})
    with pytest.raises(EnvError, match=words) as caught:
        check_env("hostile_envs:Malformed", args, "ppo")
    assert len(caught.value.message) < 300
    assert "(observation, reward, terminated, truncated, info)" in caught.value.hint


def test_what_is_named_for_several_rewards_makes_one_of_them() -> None:
    with pytest.raises(EnvError) as caught:
        check_env("hostile_envs:Malformed", {"step": "rewards of agents"}, "ppo")
    expression = present(re.search(r"gymnasium\S+\(env, sum\)", caught.value.message)).group()
    env: Any = eval(expression, {"gymnasium": gym, "env": Malformed(step="rewards of agents")})
    env.reset()
    assert env.step(0)[1] == 1.5


@pytest.mark.parametrize("kind", ["float64", "list", "reward in an array", "reward in a list", "infos"])
def test_what_is_harmless_in_a_step_passes_and_can_be_stepped(kind: str) -> None:
    args = {"step": kind}
    assert cast("Any", check_env("hostile_envs:Malformed", args, "ppo").action_space).n == 2

    vector = CheckedEnvs(make_vector_env("hostile_envs:Malformed", args, 2), "Malformed")
    vector.reset(seed=0)
    for _ in range(3):
        assert vector.step(np.zeros(2, np.int64))[1].tolist() == [1.0, 1.0]

    packed = make_packed_envs("hostile_envs:Malformed", args, 2, kind="scalar")
    packed.add("a", 0)
    assert packed.step(np.zeros(2, np.int64)).rewards.tolist() == [1.0, 1.0]
    assert not packed.errors

    episodes = evaluate_policy(
        ConstantPolicy(packed.observation_space, packed.action_space, 0, env_id="Malformed"),
        env_id="hostile_envs:Malformed", env_args=args, seeds=[0], max_episode_steps=3,
    )  # fmt: skip
    assert episodes.returns == (3.0,)


def test_a_first_step_that_raises_is_refused() -> None:
    with pytest.raises(EnvError, match=r"cannot be stepped, with the action [01] after a reset: ValueError: the motor"):
        check_env("hostile_envs:Hostile", {"how": "fail"}, "ppo")


def test_an_env_that_cannot_be_closed_is_none_the_worse() -> None:
    assert cast("Any", check_env("hostile_envs:Hostile", {"how": "fail", "where": "close"}, "ppo").action_space).n == 2


def test_environments_of_a_vector_get_plain_numbers_as_actions() -> None:
    """Some ask `isinstance(action, int)`, as the tests' walk does; arrays of actions hold NumPy's."""
    register_test_envs()
    envs = make_vector_env("TestWalk-v0", {"end": 100.0}, 2)
    envs.reset(seed=0)
    for _ in range(3):
        _, rewards, _, _, _ = envs.step(np.array([3, 4]))
    assert rewards[0] < rewards[1]
    envs.close()
