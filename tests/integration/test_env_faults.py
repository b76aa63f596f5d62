"""Environments that raise what ends processes, or give numbers that are none: one trial fails, and says why."""

from __future__ import annotations

import dataclasses
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np
import pytest
from fake_engine import make_task
from odd_envs import RAISED
from policy_factory import make_policy
from test_packed_envs import assert_equal_bits, go_on, make, own_modules, seen_by

from policies.acting.evaluate import Evaluator, evaluate_policy
from policies.acting.policy import RandomPolicy
from policies.envs import faults as env_faults
from policies.envs.checked import CheckedEnvs, is_sound
from policies.envs.failures import FailureRule
from policies.envs.make import make_env, make_vector_env
from policies.envs.wrappers import FailurePenalty
from policies.errors import EnvError
from policies.packed.evaluation import evaluate_many
from tune_jobs.training.baseline import BaselineEngine

if TYPE_CHECKING:
    from policies.packed.envs.vector import PackedEnvs

__all__ = ["make", "own_modules"]

FAULTY = "odd_envs:Faulty"
NUMBERS = {"nan": "NaN", "inf": "infinite", "-inf": "minus infinity", "1e39": r"1e\+39|infinite"}


@pytest.fixture(autouse=True)
def in_a_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a trial's process, where signals are noted; none came."""
    monkeypatch.setattr(env_faults, "_notes_signals", True)
    monkeypatch.setattr(env_faults, "_signalled", False)


# -- packs


STEPS = (
    [({"raises": name}, rf"{FAULTY} raised an error in step\(\): {name}") for name in RAISED]
    + [
        ({"where": "reward", "number": number}, f"reward of env step 3 of an episode of {FAULTY} was ({words})")
        for number, words in NUMBERS.items()
    ]
    + [
        (
            {"where": "observation", "number": number},
            rf"observation after env step 3 of an episode of {FAULTY} was ({words}) \(number 1 of its 2",
        )
        for number, words in NUMBERS.items()
    ]
)


# In processes it is the same code: one of each sort.
@pytest.mark.parametrize(
    ("kind", "fault", "words"),
    [("scalar", *case) for case in STEPS] + [("processes", *STEPS[number]) for number in (0, 1, 4, 9)],
)
@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
def test_a_faulty_env_fails_its_member_alone(
    make: Callable[..., PackedEnvs], kind: str, fault: dict[str, str], words: str
) -> None:
    envs = make(FAULTY, kind, env_args={**fault, "action": 1}, members={"a": 1, "b": 2, "c": 3}, num_processes=2)
    alone = make(FAULTY, "scalar", members={"a": 1, "c": 3})
    for index in range(12):
        # The third step of the second episode.
        step, expected = go_on(envs, "b", 1 if index == 9 else 0), go_on(alone)
        for member_id in ("a", "c"):
            assert_equal_bits([seen_by(envs, step, member_id)], [seen_by(alone, expected, member_id)])
        assert list(envs.errors) == (["b"] if index >= 9 else [])
        if index >= 9:
            assert all((values == 0).all() for values in seen_by(envs, step, "b").values())
    with pytest.raises(EnvError, match=words):
        raise envs.errors["b"]


@pytest.mark.parametrize("kind", ["scalar", "processes"])
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"raises": "SystemExit"}, r"raised an error in reset\(\): SystemExit: 3"),
        ({"raises": "KeyboardInterrupt"}, r"raised an error in reset\(\): KeyboardInterrupt"),
        ({"number": "nan"}, r"observation from reset\(\), at the beginning of an episode of .* was NaN"),
    ],
)
def test_a_reset_that_goes_wrong_makes_no_member(
    make: Callable[..., PackedEnvs], kind: str, fault: dict[str, str], words: str
) -> None:
    args = {"where": "reset", "seed": 13, **fault}
    envs = make(FAULTY, kind, num_envs=2, env_args=args, members={"a": 2}, num_processes=2)
    with pytest.raises(EnvError, match=words):
        envs.add("b", 12)  # its second sub-environment, in another process than the first
    assert envs.member_ids == ("a",)
    assert envs.errors == {}
    go_on(envs)
    envs.add("b", 14)
    go_on(envs)
    assert envs.errors == {}


@pytest.mark.parametrize("kind", ["scalar", "processes"])
def test_an_env_that_cannot_be_closed_harms_nobody(make: Callable[..., PackedEnvs], kind: str) -> None:
    args = {"where": "close", "raises": "SystemExit"}
    envs = make(FAULTY, kind, env_args=args, members={"a": 1, "b": 2}, num_processes=2)
    go_on(envs)
    envs.remove("a")
    go_on(envs)
    assert envs.member_ids == ("b",)
    assert envs.errors == {}


@pytest.mark.parametrize("name", RAISED)
def test_a_constructor_may_raise_anything(name: str) -> None:
    makers: tuple[Callable[..., object], ...] = (make_env, lambda *args: cast("Any", make_vector_env)(*args, 2))
    for make_one in makers:
        with pytest.raises(EnvError, match=f"cannot be made.*{name}"):
            make_one(FAULTY, {"where": "init", "raises": name})


def test_the_message_names_the_line_in_the_env_and_not_in_what_is_around_or_inside_it(
    make: Callable[..., PackedEnvs],
) -> None:
    envs = make("odd_envs:Deep", "scalar", members={"a": 1})
    go_on(envs)
    with pytest.raises(EnvError, match=r"JSONDecodeError: .* \(/.*/odd_envs\.py:\d+ in parse\)"):
        raise envs.errors["a"]


# -- vector environments


@pytest.mark.parametrize("name", RAISED)
@pytest.mark.parametrize("where", ["reset", "step"])
def test_a_vector_env_fails_as_scalar_ones_do(name: str, where: str) -> None:
    envs = CheckedEnvs(make_vector_env(FAULTY, {"where": where, "raises": name}, 2), FAULTY)
    with pytest.raises(EnvError, match=rf"{FAULTY} raised an error in {where}\(\): {name}") as caught:
        step_vector(envs, 3)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("where", ["reward", "observation"])
def test_a_vector_env_says_what_is_not_finite(number: str, where: str) -> None:
    args = {"where": where, "number": number, "action": 1}
    envs = CheckedEnvs(make_vector_env(FAULTY, args, 2), FAULTY)
    # Seven steps, one that resets, and two of the next episode.
    step_vector(envs, 10)
    at = "of env step 3" if where == "reward" else "after env step 3"
    with pytest.raises(EnvError, match=rf"{where} {at} of an episode of {FAULTY} was ({NUMBERS[number]})"):
        envs.step(np.array([0, 1]))


def step_vector(envs: CheckedEnvs, num_steps: int) -> None:
    envs.reset(seed=5)
    for _ in range(num_steps):
        envs.step(np.zeros(2, dtype=np.int64))


class Vectorised(gym.vector.VectorEnv[Any, Any, Any]):
    """Its steps return what it is given."""

    def __init__(self, num_envs: int, returned: tuple[Any, ...]) -> None:
        self.num_envs, self.returned = num_envs, returned
        self.single_observation_space = gym.spaces.Box(-1, 1, (3,))
        self.single_action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return [[0, 0, 0]] * self.num_envs, {"x": 5}

    def step(self, actions: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.returned


ROWS = np.zeros((2, 3), np.float32)


@pytest.mark.parametrize(
    "returned",
    [
        ([[0, 0, 0]] * 2, [1, 2], [False, True], (False, False), {"x": 5}),
        (ROWS, np.array([[1], [2]]), np.array([[0], [1]]), np.zeros((2, 1)), None),
    ],
)
def test_what_a_vectorised_version_returns_is_arrays(returned: tuple[Any, ...]) -> None:
    envs = CheckedEnvs(Vectorised(2, returned), "Mine-v0")
    observations, _ = envs.reset()
    assert observations.shape == (2, 3)
    observations, rewards, terminated, truncated, infos = envs.step([0, 0])
    assert (observations.shape, rewards.tolist(), infos) == ((2, 3), [1, 2], {})
    assert (terminated.tolist(), truncated.tolist()) == ([False, True], [False, False])
    assert (terminated.dtype, truncated.dtype) == (np.bool_, np.bool_)


def test_a_vectorised_version_may_write_all_its_steps_into_the_same_arrays() -> None:
    rows, rewards, ends = np.zeros((2, 3), np.float32), np.zeros(2), np.zeros(2, bool)
    envs = CheckedEnvs(Vectorised(2, (rows, rewards, ends, ends, {})), "Mine-v0")
    envs.reset()
    step = envs.step([0, 0])
    rows += 1
    rewards += 1
    ends[:] = True
    assert not any(returned.any() for returned in step[:4])


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        ((ROWS[:, :2], [1, 2], [0, 0], [0, 0], {}), r"observations of shape \(2, 2\).* not numbers of shape \(2, 3\)"),
        ((ROWS, 1.0, [0, 0], [0, 0], {}), r"rewards of shape \(\).* not numbers of shape \(2,\)"),
        ((ROWS, [1, None], [0, 0], [0, 0], {}), "rewards of shape .* and dtype object"),
        ((ROWS, [1, 2], [[0], [0, 0]], [0, 0], {}), "terminated of shape .* and dtype object"),
        ((ROWS, [1, 2], [0, 0], "no", {}), "truncated of shape .* and dtype <U2"),
    ],
)
def test_what_a_vectorised_version_returns_wrong_is_told(returned: tuple[Any, ...], told: str) -> None:
    envs = CheckedEnvs(Vectorised(2, returned), "Mine-v0")
    envs.reset()
    with pytest.raises(EnvError, match=f"The vectorised Mine-v0 returned {told}"):
        envs.step([0, 0])


def test_whole_rewards_do_not_cut_off_a_penalty() -> None:
    returned: tuple[Any, ...] = (ROWS, np.array([1, 2]), np.array([False, True]), np.array([False, False]), {})
    envs = FailurePenalty(Vectorised(2, returned), FailureRule(), -0.5)
    assert envs.step([0, 0])[1].tolist() == [1.0, -0.5]


# -- greedy episodes


FAULTS = [{"raises": name} for name in RAISED] + [
    {"where": where, "number": number} for where in ("reward", "observation") for number in ("nan", "inf", "-inf")
]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: "-".join(fault.values()))
def test_greedy_episodes_say_what_the_env_did(fault: dict[str, str]) -> None:
    words = fault.get("raises") or NUMBERS[fault["number"]]
    for policy in (make_policy(FAULTY), RandomPolicy.for_env(FAULTY)):
        with pytest.raises(EnvError, match=rf"(?s){FAULTY}.*{words}"):
            evaluate_policy(policy, env_id=FAULTY, env_args=fault, seeds=[5, 6])
    with Evaluator(FAULTY, fault, [5, 6]) as evaluator:
        results = evaluate_many(evaluator, [make_policy(FAULTY, seed=seed) for seed in (1, 2)])
    assert all(isinstance(result, EnvError) for result in results)


def test_an_evaluator_whose_envs_cannot_be_closed_is_closed() -> None:
    evaluator = Evaluator(FAULTY, {"where": "close", "raises": "SystemExit"}, [5])
    assert evaluator.run(make_policy(FAULTY)).lengths == (7,)
    evaluator.close()


# -- baselines


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: "-".join(fault.values()))
def test_a_baseline_s_trial_says_what_the_env_did(tmp_path: Path, fault: dict[str, str]) -> None:
    task = dataclasses.replace(make_task(tmp_path), algorithm="random", env_id=FAULTY, env_args=fault)
    engine = BaselineEngine()
    engine.build(task, None)
    with pytest.raises(EnvError, match=fault.get("raises") or NUMBERS[fault["number"]]):
        engine.train_iteration()
    engine.close()


# -- signals

CHILD = """
import os, signal, sys
import gymnasium as gym, numpy as np
from policies.envs.faults import note_signals
from policies.envs.modules import allow_modules
from policies.envs.wrappers import FailurePenalty
from policies.errors import EnvError
from policies.packed.envs.sub_envs import SubEnvs

signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(5))
note_signals()
allow_modules(["signalling"])
envs = SubEnvs("signalling:Env", {"signal": sys.argv[1]})
envs.add("a", [1])
print("raised", *envs.step(np.zeros(1, int)).errors, flush=True)
"""
ENV = """
import os, signal, sys
import gymnasium as gym, numpy as np
class Env(gym.Env):
    observation_space, action_space = gym.spaces.Box(-1, 1, (1,)), gym.spaces.Discrete(2)
    def __init__(self, signal): self.signal = signal
    def reset(self, *, seed=None, options=None): return np.zeros(1, np.float32), {}
    def step(self, action):
        if self.signal == "none": sys.exit(5)
        os.kill(os.getpid(), getattr(signal, self.signal))
        for _ in range(1000): os.getpid()
        raise ZeroDivisionError
"""


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 5), ("SIGINT", -2), ("none", 0)])
def test_a_signal_to_the_process_is_no_fault_of_the_env(tmp_path: Path, name: str, code: int) -> None:
    (tmp_path / "signalling.py").write_text(ENV)
    paths = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])
    child = subprocess.run(
        [sys.executable, "-c", CHILD, name], env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True,
        timeout=600, check=False,
    )  # fmt: skip
    assert child.returncode == code, child.stderr
    assert child.stdout == ("raised a\n" if name == "none" else "")


def test_ctrl_c_in_the_process_of_whoever_launched_is_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_faults, "_notes_signals", False)
    with pytest.raises(KeyboardInterrupt):
        evaluate_policy(make_policy(FAULTY), env_id=FAULTY, env_args={"raises": "KeyboardInterrupt"}, seeds=[5])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble])
def test_numbers_are_looked_at_in_every_precision(dtype: type[np.floating[Any]]) -> None:
    assert is_sound(np.array([-1, np.finfo(np.float16).max], dtype))
    for value in (np.nan, np.inf, -np.inf):
        assert not is_sound(np.array([0, value], dtype))
