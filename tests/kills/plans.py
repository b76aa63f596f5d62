"""Which kills there are: of which engine's driver, in which way, at which moment."""

from __future__ import annotations

import itertools
import random
from dataclasses import dataclass

ENGINES = ("packed", "rllib")
HOWS = ("driver", "group", "tree")
# How often each, of 26.
MOMENTS = {"start": 5, "training": 8, "checkpoint": 7, "finish": 6}

_COMMON = """
env: CartPole-v1
algorithm: ppo
engine: {engine}
seed: {seed}
hyperparams: {{train_batch_size: 256, minibatch_size: 128, num_epochs: 2, hidden_sizes: [16]}}
space: {{lr: {{loguniform: [1e-4, 1e-2]}}}}
num_samples: {num_samples}
stop: {{num_env_steps: {num_env_steps}}}
evaluation: {{every_iterations: 3, num_episodes: 2}}
checkpoints: {{every_iterations: 1, keep: 3}}
resources: {resources}
"""


@dataclass(frozen=True)
class Kill:
    """One kill, and the sweep it comes to."""

    number: int
    engine: str
    how: str
    """Who gets SIGKILL: the driver alone, its process group, or it and all that it has started."""
    moment: str
    """While Ray starts, trials train, a checkpoint is written, or the best is chosen, filmed and reported."""
    delay_s: float
    """After that moment has come."""
    num_env_runners: int

    @property
    def finishes(self) -> bool:
        """Whether the sweep also chooses its best, films it and writes its report."""
        return self.moment == "finish"

    def spec(self, seed: int) -> str:
        """The sweep file."""
        packed = self.engine == "packed"
        resources = "{max_concurrent: 4}" if packed else f"{{num_env_runners: {self.num_env_runners}}}"
        # Long enough for the moment to come while something trains.
        num_env_steps = 4_000 if self.finishes else 24_000 if packed else 12_000
        return _COMMON.format(
            engine=self.engine,
            seed=seed,
            num_samples=4 if packed else 2,
            num_env_steps=num_env_steps,
            resources=resources,
        )


def make_plan(num_kills: int, seed: int) -> list[Kill]:
    """So many kills, engines and ways in turn, moments shuffled."""
    rng = random.Random(seed)
    total = sum(MOMENTS.values())
    moments = [name for name, number in MOMENTS.items() for _ in range(number)]
    moments = [moments[i * total // num_kills % total] for i in range(num_kills)]
    rng.shuffle(moments)
    # Up to how long each lasts on an idle machine.
    longest = {"start": 5.0, "training": 2.0, "checkpoint": 0.0, "finish": 6.0}
    pairs = itertools.cycle(itertools.product(HOWS, ENGINES))
    return [
        Kill(number, engine, how, moment, round(rng.uniform(0, longest[moment]), 2), rng.randrange(2))
        for number, (how, engine), moment in zip(itertools.count(1), pairs, moments, strict=False)
    ]
