"""Decide how many packs there are and how many trials each trains at once, by CPUs, GPUs, limits and memory."""

from __future__ import annotations

import bisect
import heapq
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from analysis.wording import bytes_text
from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.plan.machine import Machine
from tune_jobs.spec.sweep_spec import SweepSpec

MAX_SLOTS = 64
"""The most trials that one pack trains at once."""

AT_ONCE_BY_MODEL = 4
"""How many trials run at once where a model chooses the points, if there are neither more CPUs nor many trials.

The model learns from trials that have ended; about running trials it knows only that they run. A pack that trains
dozens at once would begin most points of a small sweep before the model has any results, which would be random search.
"""
SHARE_AT_ONCE_BY_MODEL = 0.1
"""Of a sweep's trials, those that run at once if these are more: what is found is as good (decision 40)."""

# The other half is for the processes themselves, for other programs, and for what the estimate leaves out.
SHARE_OF_MEMORY = 0.5
# What a pack's process has for itself alone, 45 to 65 MB with Ray 2.60, as it shares what it has imported with the one
# that it is forked from; and its part of what that one, Ray's own and those that wait have.
_PROCESS_BYTES = 100e6

_OTHERS = "other trials need the idle CPUs"


@dataclass(frozen=True)
class TrialToPack:
    """A trial that will be packed."""

    trial_id: str
    key: tuple[Any, ...] | None
    """The result of `engine_choice.pack_key`; None: its point is not known."""
    num_bytes: float
    """An estimate of the memory it takes, in bytes."""
    num_envs: int = 1
    """The number of its sub-environments; if its point is not known, the fewest that it may have."""


def plan_packs(spec: SweepSpec, machine: Machine, members: Sequence[TrialToPack], *, may_spread: bool) -> PackPlan:
    """Plan the packs of a sweep.

    Args:
        spec: The sweep.
        machine: The machine that it runs on; at least one process of a trial fits on it.
        members: The trials to be packed that have not ended, by index; at least one.
        may_spread: Whether idle CPUs may step environments; false: other trials need them.
    """
    cpus, gpus = float(spec.resources.num_cpus or 1), spec.resources.num_gpus
    num_packs, slots = _by_cpus(spec, machine.fitting(cpus, gpus), len(members))
    num_packs, slots, notes = _by_memory(machine, members, num_packs, slots, cpus)
    from policies.guard.guarded import measure_step
    from policies.packed.envs.make import choose_kind

    step = measure_step(spec.env.id, spec.env.wrapped_args, timeout_s=spec.iteration_timeout_s)
    # A pack's sub-environments are distributed over its processes, so more processes than these would be idle.
    most = slots * min(member.num_envs for member in members)
    spare, why_none = _spare_cpus(machine, num_packs, cpus, gpus, most) if may_spread else (0, _OTHERS)
    choice = choose_kind(step, spare_cpus=spare, why_none=why_none)
    num_processes = spare if choice.kind == "processes" else 0
    return PackPlan(
        num_packs=num_packs,
        slots=slots,
        cpus_per_pack=cpus + num_processes,
        gpus_per_pack=gpus,
        trial_ids=tuple(member.trial_id for member in _in_stacks(members)),
        env_kind=choice.kind,
        env_step_us=choice.step_us,
        num_env_processes=num_processes,
        notes=notes,
        reward=step.reward,
        largest=step.largest,
        why_env_kind=choice.why,
    )


def _by_cpus(spec: SweepSpec, fitting: float, num_members: int) -> tuple[int, int]:
    """Return how many packs and slots CPUs, GPUs and the limits on trials at once allow."""
    limit = math.inf if spec.resources.max_concurrent is None else spec.resources.max_concurrent
    if spec.search.has_model:
        tenth = int(SHARE_AT_ONCE_BY_MODEL * spec.num_samples * spec.seeds_per_point)
        limit = min(limit, max(AT_ONCE_BY_MODEL, tenth, fitting))
    num_packs = max(1, int(min(fitting, num_members, limit)))
    share = math.ceil(num_members / num_packs)
    # Trials run in several rounds of equal size, so that the last ones are not left to one pack.
    slots = math.ceil(share / math.ceil(share / MAX_SLOTS))
    return num_packs, max(1, int(min(slots, limit / num_packs)))


def _by_memory(
    machine: Machine, members: Sequence[TrialToPack], num_packs: int, slots: int, cpus: float
) -> tuple[int, int, tuple[str, ...]]:
    """Return how many of the packs and slots memory allows, and a note if they are fewer."""
    if machine.memory_per_process(num_packs, cpus) is None:
        return num_packs, slots, ()
    # Whichever trials meet in a pack, they need at most as much memory as the largest ones.
    totals = list(itertools.accumulate(heapq.nlargest(slots, (member.num_bytes for member in members))))
    wanted, fitting = (num_packs, slots), dict[int, int]()
    for number in range(num_packs, 0, -1):
        budget, are_processes = _budget(machine, number, cpus)
        fitting[number] = bisect.bisect_right(totals, budget)
        # Fewer packs than these would leave no more for trials, and CPUs idle.
        if fitting[number] and not are_processes:
            break
    # The first, of most packs, if as many trials run at once with fewer.
    num_packs = max(fitting, key=lambda number: number * fitting[number])
    slots = fitting[num_packs]
    if not slots:
        note = (
            f"Packs are planned smaller: one trial may take {bytes_text(totals[0])} of memory, more than half of what "
            f"{machine.has_available}, {bytes_text(budget)}. One pack trains one trial at a time."
        )
        return 1, 1, (note,)
    if (num_packs, slots) == wanted:
        return num_packs, slots, ()
    needed, available = wanted[0] * totals[-1], machine.memory_bytes or 0.0
    if _budget(machine, wanted[0], cpus)[1]:
        why = f"{bytes_text(needed + wanted[0] * _PROCESS_BYTES)} of memory with their processes, and what "
        why += f"{machine.has_available} is {bytes_text(available)}"
    else:
        why = f"{bytes_text(needed)} of memory, and half of what {machine.has_available} is "
        why += bytes_text(available * SHARE_OF_MEMORY)
    note = f"Packs are planned smaller: {wanted[0]} x {wanted[1]} trials at once may take {why}. "
    return num_packs, slots, (f"{note}{num_packs} x {slots} trials run at once.",)


def _budget(machine: Machine, num_packs: int, cpus: float) -> tuple[float, bool]:
    """Return the memory that the trials of each pack may take, and whether the packs' processes are what limits it."""
    share = machine.memory_per_process(num_packs, cpus) or 0.0
    half, beside = share * SHARE_OF_MEMORY, share - _PROCESS_BYTES
    # One runs in any case; on a cluster only what trials keep is counted.
    are_processes = num_packs > 1 and not machine.nodes and beside < half
    return (beside if are_processes else half), are_processes


def _spare_cpus(machine: Machine, num_packs: int, cpus: float, gpus: float, most: int) -> tuple[int, str]:
    """Return how many more CPUs each pack may use, so that as many packs still fit; and why, if there are none."""
    if most < 2:
        return 0, "there is only one sub-environment, which cannot be distributed"
    spare = 0
    while spare < most and machine.fitting(cpus + spare + 1, gpus) >= num_packs:
        spare += 1
    if spare or machine.num_cpus < num_packs * cpus + 1:
        return spare, "no CPU is idle"
    return 0, f"there is not an idle CPU for each of the {num_packs} packs"


def _in_stacks(members: Sequence[TrialToPack]) -> list[TrialToPack]:
    """Return the trials sorted by key, in the order of each key's first trial; those without a key come last."""
    stacks: dict[tuple[Any, ...] | None, list[TrialToPack]] = {}
    for member in members:
        stacks.setdefault(member.key, []).append(member)
    unknown = stacks.pop(None, [])
    return [member for stack in [*stacks.values(), unknown] for member in stack]
