"""The notes of a plan on a scheduler that can't compare trials as often as it asks for, or that lets none learn.

Trials are compared at their evaluations alone (decision 6): with one evaluation, at its end, no trial is ever ended
early or goes on from a copy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.wording import counted
from policies.hyperparams import DQNHyperparams, Hyperparams, PPOHyperparams
from tune_jobs.plan.estimates import iteration_env_steps, planned_env_steps

if TYPE_CHECKING:
    from tune_jobs.spec.sweep_spec import SweepSpec

_MOST_RUNGS = 1_000
"""With a `reduction_factor` of hardly more than 1 there would be more."""


@dataclass(frozen=True)
class _Comparisons:
    """How often the scheduler compares a trial."""

    interval: int
    """The env steps from one evaluation to the next."""
    end: int
    """The env steps after which the trial ends."""
    num_wanted: int
    """The comparisons that the scheduler asks for before the end."""
    num_made: int
    """Those that there are, at evaluations."""
    first: int
    """The env steps of the first one."""


def comparison_notes(spec: SweepSpec, trials: Iterable[tuple[SweepSpec, Hyperparams]]) -> list[str]:
    """Return the notes on evaluations that are too rare for the scheduler, and on intervals too short to learn in.

    Args:
        spec: The sweep.
        trials: For each point the sweep as it is for its trials, and hyperparameters that these may have: they say
            how long a trial is, and how far apart its evaluations are.
    """
    if spec.scheduler.type == "none":
        return []
    known = list(trials)
    return [*_late_notes(spec, known), *_refill_notes(spec, known)]


def _late_notes(spec: SweepSpec, known: Sequence[tuple[SweepSpec, Hyperparams]]) -> list[str]:
    kind, every = spec.scheduler.type, spec.evaluation.every_iterations
    # Of thousands of trials few differ in these.
    cases = {(every * iteration_env_steps(values), planned_env_steps(own, values)) for own, values in known}
    found = [_comparisons(spec, interval, end) for interval, end in cases]
    given = spec.scheduler.grace_env_steps, spec.scheduler.perturb_every_env_steps
    # What nobody asked for may be halved without a word.
    least = 0.5 if given == (None, None) else 1.0
    late = [each for each in found if each.num_made < least * each.num_wanted]
    if not late:
        return []
    worst = min(late, key=lambda each: (each.num_made / each.num_wanted, -each.interval, -each.end))
    times = f"{counted(worst.num_made, 'time')}, first after {worst.first:,}" if worst.num_made else "never"
    by_batch = any(isinstance(values, PPOHyperparams) for _, values in known)
    iteration = "train_batch_size" if by_batch else "env_steps_per_iteration"
    lower = f"evaluation.every_iterations, {every}" if every > 1 else f"{iteration}, the env steps of an iteration"
    wanted = counted(worst.num_wanted, "time") if worst.num_wanted > 1 else "at least once"
    text = (
        f"{kind} is to compare each trial {wanted} before its end at {worst.end:,} env steps, but evaluations, where "
        f"it does so, are {worst.interval:,} env steps apart: {times}. Lower {lower}."
    )
    return [text]


def _refill_notes(spec: SweepSpec, known: Sequence[tuple[SweepSpec, Hyperparams]]) -> list[str]:
    """Return the note on a population whose trials fill their replay memories for as long as an interval, or none."""
    if not spec.scheduler.is_population:
        return []
    every = spec.perturb_every_env_steps
    replayed = [values for _, values in known if isinstance(values, DQNHyperparams) and values.replay != "none"]
    longest = max((max(values.learning_starts, values.train_batch_size) for values in replayed), default=0)
    if longest < every:
        return []
    text = (
        "A trial that goes on from a copy, or that gave its place away to others, fills its replay memory for "
        f"{longest:,} env steps before it learns on (learning_starts), and trials are compared every {every:,}: it may "
        "learn nothing between two comparisons. Lower learning_starts, or raise scheduler.perturb_every_env_steps."
    )
    return [text]


def _comparisons(spec: SweepSpec, interval: int, end: int) -> _Comparisons:
    if spec.scheduler.is_population:
        # From one comparison to the next; with closer evaluations there are as many as are wanted, or one less.
        every = spec.perturb_every_env_steps
        num_wanted = (end - 1) // every
        num_made = (end - 1) // interval if interval > every else num_wanted
        return _Comparisons(interval, end, num_wanted, num_made, max(interval, every))
    wanted = list(_rungs(spec, end))
    made = sorted({math.ceil(steps / interval) * interval for steps in wanted})
    made = [steps for steps in made if steps < end]
    return _Comparisons(interval, end, len(wanted), len(made), made[0] if made else end)


def _rungs(spec: SweepSpec, end: int) -> Iterator[int]:
    """Yield the env steps, before a trial's end, at which it is to be compared."""
    grace = spec.grace_env_steps
    if spec.scheduler.type == "median":
        # It compares at each evaluation from the first one on.
        yield from (grace,) if grace < end else ()
        return
    for number in range(_MOST_RUNGS):
        rung = grace * spec.scheduler.reduction_factor**number
        if rung >= end:  # it may be infinite
            return
        yield math.ceil(rung)
