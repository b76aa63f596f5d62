"""What it means that a hyperparameter is idle; see `policies.idle.find`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Limits:
    """What a trial is bound by, beside its hyperparameters."""

    num_env_steps: int
    """The most that it makes."""
    num_iterations: int
    """The most that it makes."""
    max_episode_steps: int | None
    """Env steps after which an episode is cut; None: never."""
    is_packed: bool
    """Whether a pack trains it, whose batches are of one size always."""


@dataclass(frozen=True)
class Rule:
    """When a hyperparameter is idle."""

    why: str
    """A clause; {steps} is the most env steps of a trial."""
    holds: Callable[[Any, Limits], bool]
    """Of all hyperparameters and the limits."""
    reads: tuple[str, ...]
    """The hyperparameters that `holds` looks at."""
    of_value: bool = False
    """Whether one of them is the idle hyperparameter itself: then all values for which the rule holds act alike."""
    words: Callable[[Any, Limits], str] | None = None
    """Of hyperparameters for which it holds: `why`, with their values."""

    def reason(self, hyperparams: Any, limits: Limits) -> str:
        """`why`, of hyperparameters for which it holds."""
        if self.words is not None:
            return self.words(hyperparams, limits)
        return self.why.format(steps=f"{limits.num_env_steps:,}")


Rules = tuple[Rule, ...]
ALWAYS: Rules = ()


def equal_ends(start: str, final: str) -> Rule:
    """Of what says how fast a value moves from start to final."""
    return Rule(f"{final} is {start}", lambda h, _: getattr(h, start) == getattr(h, final), (start, final))
