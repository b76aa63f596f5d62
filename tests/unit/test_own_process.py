"""Environments in processes of their own: they do what they do in this one, whatever happens there."""

from __future__ import annotations

import gc
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import lone_envs
import numpy as np
import odd_envs
import pytest
from policy_factory import make_policy

from policies.acting.baselines import ConstantPolicy
from policies.acting.evaluate import Episodes, Evaluator, evaluate_policy
from policies.acting.policy import RandomPolicy
from policies.envs import modules as env_modules
from policies.envs import own_process
from policies.envs.faults import close_env
from policies.envs.make import check_env, make_env, make_vector_env
from policies.envs.modules import allow_modules
from policies.envs.wrappers import constructor_args
from policies.errors import EnvError, EnvFailedError, SpecError
from policies.packed.envs.make import check_seedable, make_packed_envs, measure_step
from policies.packed.evaluation import evaluate_many
from tests.narrowing import present
from tune_jobs.plan.env_checks import check_env_args
from tune_jobs.spec.sweep_spec import SweepSpec

ALONE = {"own_process": True}


@pytest.fixture(autouse=True)
def _allowed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["lone_envs", "odd_envs"])
    yield
    lone_envs._alive.clear()


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_several_of_what_a_process_can_hold_one_only() -> None:
    envs = [make_env("lone_envs:Lone", ALONE) for _ in range(3)]
    pids = {env.reset(seed=0)[1]["pid"] for env in envs}
    assert len(pids | {os.getpid()}) == 4
    for env in envs:
        close_env(env)
    assert not any(map(is_alive, pids))
    assert lone_envs._alive == []


def test_without_it_the_error_names_it() -> None:
    first = make_env("lone_envs:Lone")
    with pytest.raises(EnvError, match="multiple instances per process") as failure:
        make_env("lone_envs:Lone")
    assert "env.own_process: true" in failure.value.hint
    close_env(first)


def test_it_is_the_same_environment_seen_from_outside() -> None:
    env = make_env("lone_envs:Lone", {**ALONE, "length": 4, "action_mask": False}, render_mode="rgb_array")
    inner: Any = env.unwrapped
    observation, info = env.reset(seed=3, options={"a": 1})
    assert info["options"] == {"a": 1}
    assert env.observation_space.contains(observation)
    assert env.render_mode == inner.render_mode == "rgb_array"
    assert env.metadata["render_fps"] == 7
    assert (inner.length, inner.steps, inner.action_masks().tolist()) == (4, 0, [False, False, True])
    assert [env.step(2)[1:4] for _ in range(4)] == [(1.0, False, False)] * 3 + [(1.0, True, False)]
    assert cast("Any", env.render())[0, 0].tolist() == [4, 4, 4]
    assert inner.steps == 4
    assert [inner.skip(3, back=1), inner.skip(1), inner.steps] == [6, 7, 7]
    for name in ("nothing", "_nothing"):
        assert not hasattr(inner, name)
    with pytest.raises(ZeroDivisionError, match="it is broken"):
        _ = inner.broken
    close_env(env)


def test_a_method_of_what_is_behind_a_wrapper_is_found() -> None:
    assert check_env("lone_envs:Behind", ALONE).mask == "action_masks()"


@pytest.mark.parametrize("alone", [{}, ALONE], ids=str)
def test_a_method_that_needs_arguments_is_no_mask(alone: dict[str, Any]) -> None:
    assert check_env("lone_envs:AsksForState", {**alone, "action_mask": "mask"}).mask == "info['mask']"
    assert check_env("lone_envs:AsksForState", {**alone, "action_mask": None}).mask == "action_masks()"
    env = make_env("lone_envs:AsksForState", {**alone, "action_mask": "mask"})
    env.reset(seed=0)
    inner: Any = env.unwrapped
    # It can be called as it is there.
    assert inner.mask(0, sure=False).tolist() == [False, False, False]
    assert inner.mask(state=1).tolist() == [True, True, True]
    close_env(env)


@pytest.mark.parametrize("threads", [None, "3"])
def test_it_multiplies_with_one_thread_unless_more_are_asked_for(
    monkeypatch: pytest.MonkeyPatch, threads: str | None
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", threads or "")
    if threads is None:
        monkeypatch.delenv("OMP_NUM_THREADS")
    env = make_env("lone_envs:Lone", ALONE)
    assert env.reset(seed=0)[1]["threads"] == (threads or "1")
    close_env(env)


def test_ctrl_c_in_a_terminal_is_left_to_its_parent_and_it_is_closed_as_here(tmp_path: Path) -> None:
    env = make_env("lone_envs:Lone", {**ALONE, "last_words": str(tmp_path / "words")})
    os.kill(env.reset(seed=0)[1]["pid"], signal.SIGINT)
    env.step(2)
    close_env(env)
    assert (tmp_path / "words").read_text() == "closed"


def test_its_arguments_are_checked_and_its_mask_and_failure_are_found() -> None:
    info = check_env("lone_envs:Lone", {**ALONE, "length": 5, "max_episode_steps": 3}, "dqn")
    assert (info.env_args["own_process"], info.max_episode_steps, info.mask) == (True, 3, "action_masks()")
    assert info.failure is not None
    with pytest.raises(EnvError, match=r"takes no argument 'lenght'.*'length'"):
        make_env("lone_envs:Lone", {**ALONE, "lenght": 5})
    with pytest.raises(EnvError, match="own_process is 'yes'; it must be true or false"):
        make_env("lone_envs:Lone", {"own_process": "yes"})
    with pytest.raises(EnvError, match="own_process is true and atari is set"):
        make_env("lone_envs:Lone", {**ALONE, "atari": {}})


@pytest.mark.parametrize("env_id", ["CartPole-v1", "lone_envs:Pole", "Pendulum-v1", "Hopper-v5"])
def test_episodes_are_what_they_are_here_to_the_last_bit(env_id: str) -> None:
    if env_id.startswith("Hopper"):
        pytest.importorskip("mujoco")
    policy = RandomPolicy.for_env(env_id)
    args = {"max_episode_steps": 30}
    here, there = (
        evaluate_policy(policy, env_id=env_id, env_args=given, seeds=range(5)) for given in (args, args | ALONE)
    )
    assert here == there


@pytest.mark.parametrize("alone", [{}, ALONE], ids=str)
def test_arguments_may_be_called_as_ours_are(alone: dict[str, Any]) -> None:
    given = {"env_id": "a", "name": "b", "make": "c", "creator": "d"}
    env: Any = make_env("lone_envs:Pole", given | alone)
    vector: Any = make_vector_env("lone_envs:Pole", given | alone, 1)
    assert env.unwrapped.given == vector.unwrapped.envs[0].unwrapped.given == ["a", "b", "c", "d"]
    vector.close()
    close_env(env)


def test_few_processes_play_many_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    original = own_process.InOwnProcess.__init__

    def counting(self: Any, env_id: str, **env_args: Any) -> None:
        made.append(env_id)
        original(self, env_id, **env_args)

    monkeypatch.setattr(own_process.InOwnProcess, "__init__", counting)
    # A policy of a network, which acts for several episodes at once.
    policy = make_policy("CartPole-v1")
    here, there = (
        evaluate_policy(policy, env_id="CartPole-v1", env_args=given, seeds=range(20), max_episode_steps=9)
        for given in ({}, ALONE)
    )
    assert here == there
    assert len(made) == 4


def test_a_vector_of_them_and_a_packs() -> None:
    vector: Any = make_vector_env("CartPole-v1", ALONE, 2)
    assert [type(env.unwrapped).__name__ for env in vector.unwrapped.envs] == ["InOwnProcess"] * 2
    plain: Any = make_vector_env("lone_envs:Pole", {}, 2)
    assert np.array_equal(vector.reset(seed=[1, 2])[0], plain.reset(seed=[1, 2])[0])
    vector.close()
    plain.close()
    assert not measure_step("CartPole-v1", ALONE).is_vectorised
    for kind in ("scalar", "processes"):
        envs = make_packed_envs("lone_envs:Lone", ALONE, 3, kind=kind, num_processes=1)
        envs.add("a", 5)
        envs.step(np.full(3, 2))
        envs.close()


def test_what_all_in_a_process_share_they_do_not() -> None:
    with pytest.raises(EnvError, match=r"with env\.own_process: true each would be alone"):
        check_seedable("odd_envs:Sharing", None)
    check_seedable("odd_envs:Sharing", ALONE)


@pytest.mark.parametrize(
    ("where", "how", "words"),
    [
        ("constructor", "divides", r"ZeroDivisionError: division by zero"),
        ("constructor", "ends", "RuntimeError: its own process ended with exit code 7"),
        ("reset", "own error", r"RuntimeError: SelfMadeError: code 3 \(.*lone_envs.py:\d+ in _fail\)"),
        ("reset", "is killed", "RuntimeError: its own process was killed by SIGKILL"),
        ("step", "divides", r"ZeroDivisionError: division by zero \(.*lone_envs.py:\d+ in _fail\)"),
        ("step", "exits", r"SystemExit: 5 \(.*lone_envs.py:\d+ in _fail\)"),
    ],
)
def test_what_goes_wrong_there_is_said_here(where: str, how: str, words: str) -> None:
    with pytest.raises(EnvError, match=words) as failure:
        check_env("lone_envs:Failing", {**ALONE, "where": where, "how": how, "action_mask": False})
    assert isinstance(failure.value, EnvFailedError) == (where != "constructor")


def test_what_cannot_be_sent_is_said_and_the_environment_goes_on() -> None:
    env = make_env("lone_envs:Failing", {**ALONE, "where": "", "how": "sends a function", "action_mask": False})
    env.reset(seed=0)
    with pytest.raises(TypeError, match="what it returns can't be sent to another process"):
        env.step(0)
    env.reset(seed=0)
    close_env(env)


def test_one_that_hangs_is_killed_when_it_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_process, "_PATIENCE_S", 0.2)
    env: Any = make_env("lone_envs:Failing", {**ALONE, "where": "step", "how": "hangs", "action_mask": False})
    pid = env.reset(seed=0)[1]["pid"]
    env.unwrapped._connection.send(("step", (0,), {}))
    assert is_alive(pid)
    env.close()
    assert not is_alive(pid)


def test_whoever_is_interrupted_as_it_waits_gets_no_answer_of_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_process, "_PATIENCE_S", 0.2)
    env = make_env("lone_envs:Failing", {**ALONE, "where": "step", "how": "hangs", "action_mask": False})
    pid = env.reset(seed=0)[1]["pid"]

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    try:
        with pytest.raises(KeyboardInterrupt):
            env.step(0)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert not is_alive(pid)
    with pytest.raises(RuntimeError, match="its own process was killed by SIGKILL"):
        env.reset(seed=0)


def test_one_that_ends_in_an_evaluation_fails_that_one_alone(tmp_path: Path) -> None:
    args = {**ALONE, "at": str(tmp_path / "now"), "action_mask": False}
    with Evaluator("lone_envs:EndsOnce", args, (1, 2)) as evaluator:
        env = evaluator._envs[0]
        right = ConstantPolicy(env.observation_space, env.action_space, 2, env_id="lone_envs:EndsOnce", env_args=args)
        (tmp_path / "now").touch()
        failed, *others = evaluate_many(evaluator, [right] * 2)
        assert isinstance(failed, EnvFailedError)
        assert "its own process ended with exit code 139" in failed.message
        expected = Episodes((1, 2), (3.0, 3.0), (3, 3))
        assert [*others, *evaluate_many(evaluator, [right])] == [expected] * 2


def test_that_it_ends_is_noticed_though_what_it_has_forked_lives_on() -> None:
    env = make_env("odd_envs:Helped", ALONE)
    env.reset(seed=0)
    before = time.monotonic()
    with pytest.raises(RuntimeError, match="its own process ended with exit code 7"):
        env.step(odd_envs.EXIT)
    assert time.monotonic() - before < 6
    close_env(env)


def test_what_cannot_be_sent_there_is_not_sent() -> None:
    env = make_env("lone_envs:Lone", ALONE)
    env.reset(seed=0)
    with pytest.raises(Exception, match="pickle"):
        env.reset(seed=0, options={"f": lambda: None})
    assert env.step(2)[1] == 1
    close_env(env)


def test_what_nothing_holds_any_more_ends() -> None:
    env = make_env("lone_envs:Lone", ALONE)
    pid = env.reset(seed=0)[1]["pid"]
    del env
    gc.collect()
    assert not is_alive(pid)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, None])
def test_it_ends_with_the_process_that_it_is_for(how: signal.Signals | None) -> None:
    program = """
import os, sys, threading, time
from policies.envs.make import make_env
from policies.envs.modules import allow_modules
allow_modules(["lone_envs"])
env = make_env("lone_envs:Failing", {"own_process": True, "where": "step", "how": "hangs", "action_mask": False})
print(env.reset(seed=0)[1]["pid"], flush=True)
if sys.argv[1] == "None":
    sys.exit()
env.step(0)
"""
    folders = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
    parent = subprocess.Popen(
        [sys.executable, "-c", program, str(how)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
    )
    with parent, present(parent.stdout) as output:
        pid = int(output.readline())
        if how is not None:
            time.sleep(0.5)
            assert is_alive(pid)
            parent.send_signal(how)
        parent.wait(30)
        # The pipe is the child's too: it is closed when both have ended.
        assert select.select([output], [], [], 30)[0]
        assert output.read() == b""


def test_a_sweep_asks_for_it_beside_the_id() -> None:
    def spec(env: dict[str, Any]) -> SweepSpec:
        return SweepSpec.model_validate({"env": {"id": "CartPole-v1", **env}, "algorithm": "ppo"})

    asked = spec({"own_process": True})
    assert asked.env.wrapped_args == ALONE
    assert constructor_args({**asked.env.wrapped_args, "length": 3}) == {"length": 3}
    # Versions without the field read sweeps that don't use it.
    assert asked.model_dump(mode="json")["env"]["own_process"] is True
    assert "own_process" not in spec({}).model_dump(mode="json")["env"]
    assert spec({"own_process": False}).env.wrapped_args == {}
    with pytest.raises(SpecError, match=r"env\.args\.own_process is True, but own_process is not an argument"):
        check_env_args(spec({"args": ALONE}))
