"""Environments outside of trials: whatever they do, this process goes on, and says what they did."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from signal import Signals
from typing import Any, cast

import pytest
from policy_factory import make_policy, register_test_envs

from policies.acting.evaluate import evaluate_policy
from policies.acting.policy import NetworkPolicy, RandomPolicy
from policies.envs import modules as env_modules
from policies.envs.modules import allow_modules
from policies.errors import EnvError, EnvFailedError
from policies.guard import guarded
from policies.guard.guard import EnvGuard, guarding
from tests.narrowing import present

register_test_envs()

HOSTILE = "hostile_envs:Hostile"
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _own_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["hostile_envs"])


def policy_for_hostile() -> RandomPolicy:
    info = guarded.check_env(HOSTILE, {})
    return RandomPolicy(info.observation_space, info.action_space, env_id=info.env_id)


def is_running(pid: int | None) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def until(condition: Callable[[], Any], what: str, timeout_s: float = 600.0) -> Any:
    deadline = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < deadline, f"not within {timeout_s:g} s: {what}"
        time.sleep(0.05)
    return found


# -- the plan's check


@pytest.mark.parametrize("how", ["hang", "hang_without_python"])
@pytest.mark.parametrize("where", ["constructor", "reset", "step", "close"])
def test_an_env_that_hangs_is_cut_off_with_its_place(how: str, where: str) -> None:
    place = "its constructor" if where == "constructor" else rf"{where}\(\)"
    with pytest.raises(EnvFailedError, match=f"{HOSTILE} hangs in {place}.* nothing came back for 0.7 s") as caught:
        guarded.check_env(HOSTILE, {"how": how, "where": where}, timeout_s=0.7)
    function = "hang" if how == "hang" else "hang_without_python"
    assert re.search(rf'File "[^"]*hostile_envs.py", line \d+ in {function}\n', caught.value.message)
    assert "policies" not in caught.value.message
    assert "iteration_timeout_s" in caught.value.hint


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("exit", "ended with exit code 7 in"),
        ("segfault", r"was ended by SIGSEGV \(segmentation fault\) in"),
    ],
)
@pytest.mark.parametrize("where", ["constructor", "step"])
def test_an_env_that_ends_its_process_ends_another_one(how: str, words: str, where: str) -> None:
    place = "its constructor" if where == "constructor" else r"step\(\)"
    with pytest.raises(EnvFailedError, match=f"{HOSTILE} {words} {place}"):
        guarded.check_env(HOSTILE, {"how": how, "where": where})
    # The next job has a child again.
    assert cast("Any", guarded.check_env(HOSTILE, {}).action_space).n == 2


@pytest.mark.parametrize(
    ("where", "words"),
    [("constructor", "cannot be made .*: SystemExit: 5"), ("step", "cannot be stepped.*: SystemExit: 5")],
)
def test_an_env_that_raises_what_ends_a_process_has_failed(where: str, words: str) -> None:
    with pytest.raises(EnvError, match=words):
        guarded.check_env(HOSTILE, {"how": "leave", "where": where})


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("say_no_text", r"ValueError: \\udcff"),
        ("say_much", r"ValueError: x+ \[... [0-9,]+ characters"),
        ("say_nothing", "MuteError: it cannot be shown"),
    ],
)
@pytest.mark.parametrize("where", ["constructor", "step"])
def test_whatever_an_env_says_can_be_told(how: str, words: str, where: str) -> None:
    with pytest.raises(EnvError, match=words) as caught:
        guarded.check_env(HOSTILE, {"how": how, "where": where})
    assert len(caught.value.message) < 4_000
    caught.value.message.encode()


def test_a_segmentation_fault_is_told_with_its_place() -> None:
    with pytest.raises(EnvFailedError, match=r'hostile_envs.py", line \d+ in segfault'):
        guarded.check_env(HOSTILE, {"how": "segfault"})


def test_the_import_of_a_module_is_a_call_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "endless_module.py").write_text("while True: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    allow_modules(["endless_module"])
    with pytest.raises(EnvFailedError, match=r"hangs in the import of its module.*\n.*endless_module.py"):
        guarded.check_env("endless_module:Env", {}, timeout_s=0.7)


COUNTS_THREADS = """
import json, pathlib
from gymnasium.envs.classic_control import CartPoleEnv
from threadpoolctl import threadpool_info

class Env(CartPoleEnv):
    def __init__(self, file):
        super().__init__()
        counts = [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]
        pathlib.Path(file).write_text(json.dumps(counts))
"""


@pytest.mark.skipif(len(os.sched_getaffinity(0)) == 1, reason="there is one core, and so one thread in any case")
@pytest.mark.parametrize(("said", "threads"), [(None, 1), ("2", 2)])
def test_matrices_are_multiplied_by_one_thread_unless_the_user_says_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: str | None, threads: int
) -> None:
    (tmp_path / "counting_threads.py").write_text(COUNTS_THREADS)
    monkeypatch.syspath_prepend(tmp_path)
    allow_modules(["counting_threads"])
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    if said is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", said)
    file = tmp_path / "threads.json"
    with guarding():
        guarded.check_env("counting_threads:Env", {"file": str(file)})
    found = json.loads(file.read_text())
    assert found
    assert set(found) == {threads}


def test_what_the_child_finds_wrong_is_raised_as_here() -> None:
    with pytest.raises(EnvError, match="No environment 'Nothing-v0' is registered") as caught:
        guarded.check_env("Nothing-v0", {})
    assert not isinstance(caught.value, EnvFailedError)
    assert caught.value.hint
    here = guarded.check_env("Pendulum-v1", {"g": 9.0}, "ppo")
    from policies.envs.make import check_env

    assert here == check_env("Pendulum-v1", {"g": 9.0}, "ppo")
    assert guarded.check_env("CartPole-v1", {}).failure == check_env("CartPole-v1", {}).failure


def test_an_env_that_only_this_process_registered_is_refused_as_trials_would() -> None:
    with pytest.raises(EnvError, match="'TestWalk-v0' is registered with Gymnasium in this process alone") as caught:
        guarded.check_env("TestWalk-v0", {})
    assert "my_envs:TestWalk-v0" in caught.value.hint


def test_arguments_that_no_file_holds_are_refused() -> None:
    with pytest.raises(EnvError, match="cannot be written to a sweep file"):
        guarded.check_env(HOSTILE, {"how": object()})


# -- episodes


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("hang", r"hangs in step\(\), step 17 after reset\(\)"),
        ("exit", r"ended with exit code 7 in step\(\), step 17 after reset\(\)"),
        ("fail", r"raised an error in step\(\) of the episode with seed 3, after 16 steps: ValueError: the motor"),
    ],
)
def test_an_env_that_fails_later_fails_in_words(how: str, words: str) -> None:
    args = {"how": how, "at": 17}
    with pytest.raises(EnvFailedError, match=words):
        guarded.evaluate_policy(policy_for_hostile(), env_id=HOSTILE, env_args=args, seeds=[3], timeout_s=0.7)


def test_time_counts_by_call_and_not_by_episode() -> None:
    args = {"step_s": 0.05, "num_steps": 40}
    done = guarded.evaluate_policy(policy_for_hostile(), env_id=HOSTILE, env_args=args, seeds=[1], timeout_s=1.5)
    # Two seconds in all.
    assert done.lengths == (40,)


@pytest.mark.parametrize("make", [make_policy, RandomPolicy.for_env])
@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_episodes_are_those_of_this_process(make: Callable[..., NetworkPolicy], env_id: str) -> None:
    policy = make(env_id)
    expected = evaluate_policy(policy, env_id=env_id, seeds=range(5, 12), max_episode_steps=60)
    assert guarded.evaluate_policy(policy, env_id=env_id, seeds=range(5, 12), max_episode_steps=60) == expected


@pytest.mark.parametrize(("how", "where"), [("hang", "render"), ("exit", "step"), ("fail", "step")])
def test_a_film_that_breaks_off_leaves_nothing(tmp_path: Path, how: str, where: str) -> None:
    args = {"how": how, "where": where, "at": 5}
    policy = policy_for_hostile()
    with pytest.raises(EnvFailedError, match=rf" in {where}\(\)"):
        guarded.record_video(
            policy, env_id=HOSTILE, env_args=args, seeds=1, mp4=tmp_path / "a.mp4", gif=tmp_path / "a.gif",
            timeout_s=1.0,
        )  # fmt: skip
    assert list(tmp_path.iterdir()) == []


# -- the child


def test_what_an_env_prints_is_not_on_standard_output(tmp_path: Path) -> None:
    (tmp_path / "loud_envs.py").write_text(
        "import os\nfrom hostile_envs import Hostile\n"
        "class Loud(Hostile):\n"
        "    def reset(self, **kwargs):\n"
        "        print('by Python', flush=True)\n"
        "        os.write(1, b'by the system\\n')\n"
        "        return super().reset(**kwargs)\n"
    )
    code = "from policies.guard import guarded; print(guarded.check_env('loud_envs:Loud', {}).env_id)"
    paths = os.pathsep.join([str(tmp_path), str(ROOT / "tests" / "unit"), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": paths, "TUNE_JOBS_ALLOWED_MODULES": "loud_envs"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "loud_envs:Loud\n"
    assert "by Python" in done.stderr
    assert "by the system" in done.stderr


def test_a_child_is_used_again_and_ends_with_its_block() -> None:
    with EnvGuard() as guard:
        guard.start()
        pid = present(guard._child).process.pid
        for _ in range(2):
            guard.run("check_env", "CartPole-v1", env_args={}, algorithm=None)
        assert present(guard._child).process.pid == pid
    assert not is_running(pid)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, None])
@pytest.mark.parametrize("has_worked", [True, False])
def test_a_child_that_died_while_nobody_asked_is_replaced(number: Signals | None, has_worked: bool) -> None:
    """By the system, where memory is scarce; None: an env's own thread ended it."""
    with EnvGuard() as guard:
        guard.start()
        if has_worked or number is None:
            guard.run("check_env", "CartPole-v1", env_args={}, algorithm=None)
        process = present(guard._child).process
        if number is None:
            present(guard._child).connection.send_bytes(b"no JSON")
        # Again and again: while Python starts, a KeyboardInterrupt is lost if a callback of an import raises it.
        while process.poll() is None:
            if number is not None:
                process.send_signal(number)
            time.sleep(0.05)
        assert guard.run("check_env", "CartPole-v1", env_args={}, algorithm=None)["env_id"] == "CartPole-v1"


def test_a_child_that_another_thread_started_is_replaced_before_it_ends_with_that() -> None:
    """Linux ends a child with the thread that started it, which may be while it works for another one."""
    with EnvGuard() as guard:
        has_begun, may_end = threading.Event(), threading.Event()

        def starting() -> None:
            guard.start()
            has_begun.set()
            may_end.wait()

        # A daemon: a failure below must not leave a thread that pytest waits for.
        thread = threading.Thread(target=starting, daemon=True)
        thread.start()
        assert has_begun.wait(60)
        pids = [present(guard._child).process.pid]
        for _ in range(2):
            told = guard.run("check_env", "CartPole-v1", env_args={}, algorithm=None)
            assert told["env_id"] == "CartPole-v1"
            pids.append(present(guard._child).process.pid)
            may_end.set()
            thread.join()
    assert pids[0] != pids[1] == pids[2]


def test_one_block_within_another_shares_its_guard() -> None:
    with guarding() as outer, guarding() as inner:
        assert inner is outer


def test_modules_that_are_allowed_no_more_are_seen_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with EnvGuard() as guard:
        guard.run("check_env", HOSTILE, env_args={}, algorithm=None)
        monkeypatch.setattr(env_modules, "_allowed", set())
        with pytest.raises(EnvError, match="hostile_envs' is not allowed"):
            guard.run("check_env", HOSTILE, env_args={}, algorithm=None)


def test_a_child_does_not_outlive_a_killed_parent(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    code = (
        "from policies.guard import guarded\n"
        f"guarded.check_env({HOSTILE!r}, {{'how': 'hang_without_python', 'where': 'step', 'pids': {str(pids)!r}}})\n"
    )
    paths = os.pathsep.join([str(ROOT / "tests" / "unit"), str(ROOT)])
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": paths, "TUNE_JOBS_ALLOWED_MODULES": "hostile_envs"},
    )
    try:
        child, its_parent = map(int, until(lambda: pids.exists() and pids.read_text().split(), "the env is reset"))
        assert its_parent == parent.pid
        parent.send_signal(signal.SIGKILL)
    finally:
        parent.kill()
        parent.wait()
    until(lambda: not is_running(child), "the child has ended")


def test_an_interrupted_parent_ends_its_child(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    code = (
        "from policies.guard import guarded\n"
        "try:\n"
        f"    guarded.check_env({HOSTILE!r}, {{'how': 'hang', 'where': 'step', 'pids': {str(pids)!r}}})\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted')\n"
    )
    paths = os.pathsep.join([str(ROOT / "tests" / "unit"), str(ROOT)])
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": paths, "TUNE_JOBS_ALLOWED_MODULES": "hostile_envs"},
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        child, _ = map(int, until(lambda: pids.exists() and pids.read_text().split(), "the env is reset"))
        parent.send_signal(signal.SIGINT)
        out, _ = parent.communicate(timeout=600)
    finally:
        parent.kill()
        parent.wait()
    assert (parent.returncode, out) == (0, "interrupted\n")
    assert not is_running(child)


def test_a_child_is_ended_though_its_closing_is_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    guard = EnvGuard()
    guard.start()
    process = present(guard._child).process
    wait = process.wait

    def interrupt(timeout: float | None = None) -> None:
        monkeypatch.setattr(process, "wait", wait)
        raise KeyboardInterrupt

    monkeypatch.setattr(process, "wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        guard.close()
    assert not is_running(process.pid)


def test_a_child_that_cannot_begin_is_told_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("policies.guard.guard._BOOTSTRAP", "raise SystemExit(9)")
    with EnvGuard() as guard:
        guard.start()
        present(guard._child).process.wait()
        with pytest.raises(EnvFailedError, match="ended with exit code 9") as caught:
            guard.run("check_env", "CartPole-v1", env_args={}, algorithm=None)
    assert "printed" in caught.value.hint


def test_a_child_that_ended_before_it_began_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    """As by a signal while Python starts, which then ends with 1 as by an error of its own."""
    with EnvGuard() as guard:
        with monkeypatch.context() as patch:
            patch.setattr("policies.guard.guard._BOOTSTRAP", "raise SystemExit(1)")
            guard.start()
        present(guard._child).process.wait()
        assert guard.run("check_env", "CartPole-v1", env_args={}, algorithm=None)["env_id"] == "CartPole-v1"
