"""A training engine that does as a script says, and an evaluator to go with it: seconds of trials in no time."""

import dataclasses
import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from policy_factory import make_portable

from policies.acting.evaluate import Episodes
from policies.acting.policy import Policy, WeightsPolicy
from policies.errors import CheckpointError
from policies.portable.file import Layer, PolicyNetwork, PortablePolicy, read_policy
from tune_jobs.spec.sections import CheckpointSpec, EvaluationSpec, StopSpec
from tune_jobs.training.protocol import IterationStats, TrialTask


class FakeEngine:
    """Iteration i gives `episodes(i)`; its policy's bias is i, or NaN from `nan_from` on.

    Args:
        episodes: Iteration -> returns of the whole episodes that end in it.
        steps: Env steps an iteration.
        nan_from: First iteration whose weights are not finite.
        raise_at: Iteration that raises.
        says: What its error says.
    """

    def __init__(
        self,
        episodes: Callable[[int], Sequence[float]] = lambda iteration: (20.0,),
        *,
        steps: int = 100,
        nan_from: int | None = None,
        raise_at: int | None = None,
        says: str = "the cart left the track",
    ) -> None:
        self.episodes, self.steps, self.nan_from, self.raise_at = episodes, steps, nan_from, raise_at
        self.says = says
        self.iteration = 0
        self.builds: list[str | None] = []

    def build(self, task: TrialTask, checkpoint: Path | None) -> None:
        self.builds.append(None if checkpoint is None else checkpoint.name)
        self.iteration = 0
        if checkpoint is not None:
            self.iteration = json.loads((checkpoint / "engine.json").read_text())["iteration"]
            if read_policy(checkpoint).training["iteration"] != self.iteration:
                raise CheckpointError("Engine and policy of the checkpoint differ.")

    def train_iteration(self) -> IterationStats:
        self.iteration += 1
        if self.iteration == self.raise_at:
            raise ZeroDivisionError(self.says)
        returns = self.episodes(self.iteration)
        return IterationStats(
            num_env_steps=self.iteration * self.steps,
            episodes=tuple((value, 7) for value in returns),
            learner={"total_loss": 1.0 / self.iteration},
        )

    def policy(self) -> PortablePolicy:
        portable = small_policy()
        nan = self.nan_from is not None and self.iteration >= self.nan_from
        *layers, last = portable.network.layers
        last = Layer(last.weight, np.full(2, np.nan if nan else self.iteration, np.float32), last.activation)
        return dataclasses.replace(
            portable,
            network=PolicyNetwork(portable.network.kind, (*layers, last)),
            training={"iteration": self.iteration},
        )

    def save(self, folder: Path) -> None:
        (folder / "rllib").mkdir()
        (folder / "engine.json").write_text(json.dumps({"iteration": self.iteration}))

    def close(self) -> None:
        pass


@functools.cache
def small_policy() -> PortablePolicy:
    """The policy whose bias is changed: to ask the environment for its spaces takes longer than all else of a trial."""
    return make_portable("CartPole-v1", hidden=(2,))


class FakeEvaluator:
    """Gives the policy of iteration i the mean return `scores(i)`, from two episodes of different returns."""

    def __init__(self, scores: Callable[[int], float] = float) -> None:
        self.scores = scores
        self.evaluated: list[int] = []

    def run(self, policy: Policy) -> Episodes:
        policy.check_finite()  # as the real one
        assert isinstance(policy, WeightsPolicy)
        iteration = round(float(policy.portable.network.layers[-1].bias[0]))
        self.evaluated.append(iteration)
        score = self.scores(iteration)
        return Episodes((1, 2), (score - 1.0, score + 1.0), (5, 5))


class FakeClock:
    """Seconds that pass only by command, or so many at each look."""

    def __init__(self, step: float = 0.0) -> None:
        self.now, self.step = 1_000.0, step

    def __call__(self) -> float:
        self.now += self.step
        return self.now


def make_task(folder: Path, **changes: Any) -> TrialTask:
    """A trial that nothing stops for 100 iterations; evaluated at each, with a checkpoint at every tenth."""
    sections: dict[str, Callable[..., Any]] = {
        "stop": StopSpec,
        "evaluation": EvaluationSpec,
        "checkpoints": CheckpointSpec,
    }
    values: dict[str, Any] = {
        "stop": {"num_iterations": 100},
        "evaluation": {"every_iterations": 1},
        "checkpoints": {"every_iterations": 10, "keep": 2},
        "hyperparams": {},
    } | changes
    values = {name: sections[name](**value) if name in sections else value for name, value in values.items()}
    return TrialTask(
        sweep_place=str(folder), trial_id="t0000", seed=1024, algorithm="ppo", env_id="CartPole-v1",
        env_args={}, evaluation_seeds=(1, 2), **values,
    )  # fmt: skip
