"""The rules by which a hyperparameter is idle; see `policies.idle.find`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Limits:
    """The limits of a trial that its hyperparameters do not set."""

    num_env_steps: int
    """The most that it makes."""
    num_iterations: int
    """The most that it makes."""
    max_episode_steps: int | None
    """Env steps after which an episode is truncated; None: never."""
    is_packed: bool
    """Whether a pack trains the trial; the batches of a pack always have the same size."""


@dataclass(frozen=True)
class Rule:
    """A condition under which a hyperparameter is idle."""

    why: str
    """The reason, a clause; {steps} stands for the most env steps of a trial."""
    holds: Callable[[Any, Limits], bool]
    """Whether the rule holds, given all hyperparameters and the limits."""
    reads: tuple[str, ...]
    """The hyperparameters that `holds` looks at."""
    of_value: bool = False
    """Whether `holds` looks at the idle hyperparameter itself: then all values for which it holds act alike."""
    divides: bool = False
    """Whether `holds` divides hyperparameters by others: then it may hold at both ends of a range and not between."""
    words: Callable[[Any, Limits], str] | None = None
    """Makes the reason for hyperparameters for which the rule holds, with their values; None: `why` is the reason."""

    def reason(self, hyperparams: Any, limits: Limits) -> str:
        """Return the reason, for hyperparameters for which the rule holds."""
        if self.words is not None:
            return self.words(hyperparams, limits)
        return self.why.format(steps=f"{limits.num_env_steps:,}")


Rules = tuple[Rule, ...]
ALWAYS: Rules = ()


def equal_ends(start: str, final: str) -> Rule:
    """Return the rule for hyperparameters that say how a value moves from start to final: idle where both are equal."""
    return Rule(f"{final} is {start}", lambda h, _: getattr(h, start) == getattr(h, final), (start, final))
