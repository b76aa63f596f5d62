"""What a pack evaluates in breaks: the trial that it breaks for is retried, and neither others nor later ones fail."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fake_pack import FakePackEngine, Pack, statuses

from policies.acting.baselines import ConstantPolicy
from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.policy import Policy
from policies.errors import EnvError
from policies.packed.envs.sub_envs import HostDiedError
from policies.packed.evaluation import evaluate_many
from tune_jobs.training.protocol import IterationStats

ENV = "TestBreaks-v0"


class Breaks(gym.Env[Any, Any]):
    """It breaks once, as a simulator that ends: whatever it is asked for from then on, it fails."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    breaks_now = False
    refused = 0
    """How many more can't be made."""
    num_open = 0

    def __init__(self) -> None:
        if Breaks.refused:
            Breaks.refused -= 1
            raise RuntimeError("the port is still taken")
        Breaks.num_open += 1
        self.is_broken = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._check()
        self.num_steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if Breaks.breaks_now:
            Breaks.breaks_now, self.is_broken = False, True
        self._check()
        self.num_steps += 1
        return np.zeros(2, np.float32), 1.0, self.num_steps == 3, False, {}

    def close(self) -> None:
        Breaks.num_open -= 1
        self._check()

    def _check(self) -> None:
        if self.is_broken:
            raise RuntimeError("the simulator is gone")


@pytest.fixture
def evaluator(monkeypatch: pytest.MonkeyPatch) -> Iterator[Evaluator]:
    gym.register(ENV, lambda **_: Breaks())
    for name, value in {"breaks_now": False, "refused": 0, "num_open": 0}.items():
        monkeypatch.setattr(Breaks, name, value)
    with Evaluator(ENV, {}, (1, 2, 3)) as made:
        yield made
    assert Breaks.num_open == 0
    del gym.registry[ENV]


def policies(num: int) -> list[Policy]:
    return [ConstantPolicy(Breaks.observation_space, Breaks.action_space, 0, env_id=ENV)] * num


def sound(results: Sequence[Episodes | Exception]) -> list[bool]:
    return [not isinstance(result, Exception) for result in results]


def breaking_in(evaluator: Evaluator, number: int) -> Callable[..., Sequence[Episodes | Exception]]:
    """What a pack evaluates with, whose environment breaks once, in so many rounds of evaluations."""
    rounds = list[int]()

    def evaluate(_: Evaluator, members: Sequence[Policy]) -> Sequence[Episodes | Exception]:
        rounds.append(len(members))
        if len(rounds) == number:
            Breaks.breaks_now = True
        return evaluate_many(evaluator, policies(len(members)))

    return evaluate


def test_one_trial_is_retried_and_those_beside_and_after_it_know_nothing_of_it(
    tmp_path: Path, evaluator: Evaluator
) -> None:
    pack = Pack(tmp_path, max_retries=1, stop={"num_iterations": 6})
    pack.loop._evaluate = breaking_in(evaluator, 4)
    pack.add("t0000", "t0001", "t0002").run()
    pack.add("t0003").run()
    assert statuses(pack) == dict.fromkeys(("t0000", "t0001", "t0002", "t0003"), "completed")
    (failed,) = [report for report in pack.reports if report.error is not None]
    assert (failed.trial_id, failed.retried) == ("t0000", True)
    assert "the simulator is gone" in (failed.error or "")


def test_what_broke_is_closed_and_what_takes_its_place_may_come_late(evaluator: Evaluator) -> None:
    assert sound(evaluate_many(evaluator, policies(2))) == [True, True]
    assert Breaks.num_open == 3
    Breaks.breaks_now, Breaks.refused = True, 1
    _, refused, last = results = evaluate_many(evaluator, policies(3))
    assert sound(results) == [False, False, True]
    assert isinstance(refused, EnvError)
    assert "the port is still taken" in refused.message
    assert isinstance(last, Episodes)
    assert last.returns == (3.0, 3.0, 3.0)
    assert Breaks.num_open == 3


class InOneProcess(FakePackEngine):
    """The environments of all members are in one process at first, which ends; then each has one, and t0001's ends."""

    def train_iteration(self, held: Collection[str] = ()) -> dict[str, IterationStats | Exception]:
        results = super().train_iteration(held)
        if self.num_iterations == 3:
            error = HostDiedError("A process ended.")
            error.in_company = True
            results = dict.fromkeys(results, error)
        elif self.num_iterations > 4 and "t0001" in results:
            results["t0001"] = HostDiedError("A process ended.")
        return results


def test_what_another_one_may_have_ended_costs_no_retry(tmp_path: Path) -> None:
    pack = Pack(tmp_path, max_retries=1, stop={"num_iterations": 6})
    pack.engine = pack.loop._engine = InOneProcess()
    pack.add("t0000", "t0001", num_failures=1).run()
    told = {name: [(one.retried, one.counts) for one in pack.of(name) if one.error] for name in ("t0000", "t0001")}
    assert told == {"t0000": [(True, False)], "t0001": [(True, False), (False, True)]}
    assert pack.last("t0000").status == "completed"
