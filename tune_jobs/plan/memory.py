"""Lower how many trials run at once, each in a process of its own, to what fits into memory; packs have other rules.

What takes memory is the replay memory of DQN, 100,000 transitions of Atari's images are 5.6 GB, or the train batch of
PPO where observations are large: 4,000 of ViZDoom's screens as numbers of 32 bits, in three copies, are 11 GB.
"""

from __future__ import annotations

from analysis.wording import bytes_text, counted
from policies.hyperparams import Algorithm
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.pack_plan import SHARE_OF_MEMORY


def lowered_by_memory(
    machine: Machine, num_bytes: float, concurrent: int, *, cpus: float, algorithm: Algorithm, by_cpus: bool = False
) -> tuple[int, tuple[str, ...]]:
    """Return how many trials run at once, and a note where memory limits them.

    Args:
        machine: The machine that they run on.
        num_bytes: The memory of the largest trial.
        concurrent: How many its CPUs and GPUs, and the sweep, allow.
        cpus: CPUs of each trial.
        algorithm: The sweep's; it says which hyperparameter takes the most.
        by_cpus: Whether they are held to that by their CPUs, see `cpus_that_hold`: those of `pbt` and `hyperband` that
            wait for others count as running, so a limit on how many run would leave out some.
    """

    def share(at_once: int) -> float:
        return (machine.memory_per_process(at_once, cpus) or 0.0) * SHARE_OF_MEMORY

    if machine.memory_bytes is None or num_bytes <= share(concurrent):
        return concurrent, ()
    what = f"one trial may take {bytes_text(num_bytes)} of memory"
    lower = f"hyperparams.{'replay_capacity' if algorithm == 'dqn' else 'train_batch_size'} is what lowers it."
    if machine.nodes:
        # Trials that wait may begin on nodes that join, whatever is planned here.
        note = f"{counted(concurrent, 'trial')} at once get {bytes_text(share(concurrent))} of memory each, but {what}"
        setting = "num_cpus" if by_cpus else "max_concurrent"
        return concurrent, (f"{note}: set resources.{setting}; {lower}",)
    at_once = next((number for number in range(concurrent, 1, -1) if share(number) >= num_bytes), 1)
    if by_cpus:
        at_once = max(1, min(at_once, int(machine.num_cpus // cpus_that_hold(machine, at_once))))
    if num_bytes > share(1):
        note = f"Trials run one at a time: {what}, more than half of what {machine.source} has available,"
    else:
        runs = "runs" if at_once == 1 else "run"
        note = f"{counted(at_once, 'trial')} instead of {concurrent} {runs} at once: {what}"
        note += f", and half of what {machine.source} has available is"
    return at_once, (f"{note} {bytes_text(share(1))}; {lower}",)


def cpus_that_hold(machine: Machine, at_once: int) -> int:
    """Return the fewest CPUs that, if each trial has them, no more than so many trials have on a machine."""
    return int(machine.num_cpus // (at_once + 1)) + 1
