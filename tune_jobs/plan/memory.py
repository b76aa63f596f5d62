"""Lower how many trials run at once, each in a process of its own, to what fits into memory; packs have other rules.

What takes memory is the replay memory of DQN, 100,000 transitions of Atari's images are 5.6 GB, or the train batch of
PPO where observations are large: 4,000 of ViZDoom's screens as numbers of 32 bits, in three copies, are 11 GB. Where a
container has little memory and many CPUs, it is the processes themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from analysis.wording import bytes_text, counted
from policies.hyperparams import Algorithm
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.pack_plan import SHARE_OF_MEMORY

# Measured with Ray 2.60, and rounded up: what a process that trains CartPole has for itself alone, most of it for what
# it has imported; a process of Ray's that waits, of which there may be one for each CPU; the driver with Ray's others.
_RLLIB_BYTES = 350e6
_RANDOM_BYTES = 130e6
_WAITING_BYTES = 40e6
_RAY_BYTES = 250e6


def lowered_by_memory(
    machine: Machine,
    num_bytes: float,
    concurrent: int,
    *,
    cpus: float,
    algorithm: Algorithm,
    num_processes: int = 1,
    by_cpus: bool = False,
) -> tuple[int, tuple[str, ...]]:
    """Return how many trials run at once, and a note where memory limits them.

    Args:
        machine: The machine that they run on.
        num_bytes: The memory of the largest trial, without its processes' own.
        concurrent: How many its CPUs and GPUs, and the sweep, allow.
        cpus: CPUs of each trial.
        algorithm: The sweep's; it says which hyperparameter takes the most.
        num_processes: The processes of each trial: its own, and env runners.
        by_cpus: Whether they are held to that by their CPUs, see `cpus_that_hold`: those of `pbt` and `hyperband` that
            wait for others count as running, so a limit on how many run would leave out some.
    """
    if machine.memory_bytes is None:
        return concurrent, ()
    needs = _needs(machine, num_bytes, num_processes, algorithm)

    def unmet(at_once: int) -> _Need | None:
        return next((need for need in needs if need.num_bytes > need.share(at_once, cpus)), None)

    need = unmet(concurrent)
    if need is None:
        return concurrent, ()
    if machine.nodes:
        # Trials that wait may begin on nodes that join, whatever is planned here.
        note = f"{counted(concurrent, 'trial')} at once get {bytes_text(need.share(concurrent, cpus))} of memory each"
        setting = "num_cpus" if by_cpus else "max_concurrent"
        return concurrent, (f"{note}, but {need.what}: set resources.{setting}{need.remedy}",)
    at_once = next((number for number in range(concurrent, 1, -1) if unmet(number) is None), 1)
    need = unmet(at_once) or unmet(at_once + 1) or need
    if by_cpus:
        at_once = max(1, min(at_once, int(machine.num_cpus // cpus_that_hold(machine, at_once))))
    if need.num_bytes > need.share(1, cpus):
        note = f"Trials run one at a time: {need.what}, more than {need.of_what},"
    else:
        runs = "runs" if at_once == 1 else "run"
        note = f"{counted(at_once, 'trial')} instead of {concurrent} {runs} at once: {need.what}, and {need.of_what} is"
    return at_once, (f"{note} {bytes_text(need.share(1, cpus))}{need.remedy}",)


@dataclass(frozen=True)
class _Need:
    """Memory that each trial needs of its share of a machine's."""

    num_bytes: float
    machine: Machine
    part: float
    """The part of the machine's memory that is shared out."""
    what: str
    of_what: str
    remedy: str

    def share(self, at_once: int, cpus: float) -> float:
        return (self.machine.memory_per_process(at_once, cpus) or 0.0) * self.part


def _needs(machine: Machine, num_bytes: float, num_processes: int, algorithm: Algorithm) -> tuple[_Need, _Need]:
    """Return what a trial needs: for what it keeps, of half of the memory, and with its processes, of what Ray leaves.

    The first is larger, and alone matters, unless the processes take more than what the trial keeps.
    """
    lower = "replay_capacity" if algorithm == "dqn" else "train_batch_size"
    keeps = _Need(
        num_bytes,
        machine,
        SHARE_OF_MEMORY,
        f"one trial may take {bytes_text(num_bytes)} of memory",
        f"half of what {machine.has_available}",
        f"; hyperparams.{lower} is what lowers it.",
    )
    total = num_bytes + num_processes * (_RANDOM_BYTES if algorithm == "random" else _RLLIB_BYTES)
    rays = _RAY_BYTES + _WAITING_BYTES * machine.num_cpus
    takes = _Need(
        total,
        replace(machine, memory_bytes=max(0.0, (machine.memory_bytes or 0.0) - rays)),
        1.0,
        f"one trial and its {'process' if num_processes == 1 else 'processes'} may take {bytes_text(total)} of memory",
        f"what {machine.has_available} beside Ray's own processes",
        ".",
    )
    return keeps, takes


def cpus_that_hold(machine: Machine, at_once: int) -> int:
    """Return the fewest CPUs that, if each trial has them, no more than so many trials have on a machine."""
    return int(machine.num_cpus // (at_once + 1)) + 1
