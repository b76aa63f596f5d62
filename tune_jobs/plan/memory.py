"""Lower how many trials run at once, each in a process of its own, to what fits into memory; packs have other rules.

What takes memory is the replay memory of DQN, 100,000 transitions of Atari's images are 5.6 GB, or the train batch of
PPO where observations are large: 4,000 of ViZDoom's screens as numbers of 32 bits, in three copies, are 11 GB.
"""

from __future__ import annotations

from dataclasses import dataclass

from analysis.wording import bytes_text, counted
from policies.hyperparams import Algorithm
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.pack_plan import SHARE_OF_MEMORY


@dataclass(frozen=True)
class AtOnce:
    """How many trials run at once, each in a process of its own."""

    number: int
    cpus: int
    """CPUs of each; more than the sweep asks for where nothing else holds the number."""
    notes: tuple[str, ...] = ()
    """A note where memory limits the number."""


def lowered_by_memory(
    machine: Machine, num_bytes: float, concurrent: int, *, cpus: int, algorithm: Algorithm, by_cpus: bool = False
) -> AtOnce:
    """Return how many trials run at once.

    Args:
        machine: The machine that they run on.
        num_bytes: The memory of the largest trial.
        concurrent: How many its CPUs and GPUs, and the sweep, allow.
        cpus: CPUs of each trial.
        algorithm: The sweep's; it says which hyperparameter takes the most.
        by_cpus: Whether CPUs alone hold the number, as with schedulers of which trials wait for others: those that wait
            count as running, so a limit on how many run would leave out some.
    """

    def share(at_once: int) -> float:
        return (machine.memory_per_process(at_once, cpus) or 0.0) * SHARE_OF_MEMORY

    if machine.memory_bytes is None or num_bytes <= share(concurrent):
        return AtOnce(concurrent, cpus)
    what = f"one trial may take {bytes_text(num_bytes)} of memory"
    lower = f"hyperparams.{'replay_capacity' if algorithm == 'dqn' else 'train_batch_size'} is what lowers it."
    if machine.nodes:
        # Trials that wait may begin on nodes that join, whatever is planned here.
        note = f"{counted(concurrent, 'trial')} at once get {bytes_text(share(concurrent))} of memory each, but {what}"
        setting = "num_cpus" if by_cpus else "max_concurrent"
        return AtOnce(concurrent, cpus, (f"{note}: set resources.{setting}; {lower}",))
    at_once = next((number for number in range(concurrent, 1, -1) if share(number) >= num_bytes), 1)
    if by_cpus:
        # The fewest CPUs of which no more trials have enough.
        cpus = max(cpus, int(machine.num_cpus // (at_once + 1)) + 1)
        at_once = max(1, min(at_once, int(machine.num_cpus // cpus)))
    if num_bytes > share(1):
        note = f"Trials run one at a time: {what}, more than half of what {machine.source} has available,"
    else:
        runs = "runs" if at_once == 1 else "run"
        note = f"{counted(at_once, 'trial')} instead of {concurrent} {runs} at once: {what}"
        note += f", and half of what {machine.source} has available is"
    return AtOnce(at_once, cpus, (f"{note} {bytes_text(share(1))}; {lower}",))
