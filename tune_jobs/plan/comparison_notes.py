"""The note of a plan on a scheduler that can't compare trials as often as it asks for.

Trials are compared at their evaluations alone (decision 6): with one evaluation, at its end, no trial is ever ended
early or goes on from a copy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.wording import counted
from policies.hyperparams import Hyperparams, PPOHyperparams
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
    """Return the note on evaluations that are too rare for the scheduler, or none.

    Args:
        spec: The sweep.
        trials: For each point the sweep as it is for its trials, and hyperparameters that these may have: they say
            how long a trial is, and how far apart its evaluations are.
    """
    kind, every = spec.scheduler.type, spec.evaluation.every_iterations
    if kind == "none":
        return []
    known = list(trials)
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
