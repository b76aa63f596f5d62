"""How many trials run at once on a machine; a trial that would wait forever is refused, with the numbers."""

from __future__ import annotations

from analysis.wording import counted
from policies.errors import CannotRunError
from tune_jobs.plan.machine import Machine
from tune_jobs.spec.sweep_spec import SweepSpec

FOR_EVER = "It would wait forever."
"""The end of the messages that a machine is too small."""


def max_concurrent(spec: SweepSpec, machine: Machine, num_trials: int) -> int:
    """Return how many trials run at once, each in a process of its own.

    Raises:
        CannotRunError: One trial needs more than the machine has.
    """
    cpus, gpus = spec.cpus_per_trial, spec.resources.num_gpus
    refuse_too_large(spec, machine)
    # Env runners are placed one by one and may be on other nodes; the rest of a trial is one process on one node.
    whole = cpus if spec.resources.num_env_runners == 0 else 0
    limits = [machine.fitting(whole, gpus), machine.num_cpus // cpus, num_trials]
    if spec.resources.max_concurrent is not None:
        limits.append(spec.resources.max_concurrent)
    return max(1, int(min(limits)))


def refuse_too_large(spec: SweepSpec, machine: Machine) -> None:
    """Refuse a sweep of which not even one trial fits on a machine.

    Raises:
        CannotRunError: One trial needs more than the machine has; the message has both numbers.
    """
    cpus, gpus, runners = spec.cpus_per_trial, spec.resources.num_gpus, spec.resources.num_env_runners
    made_of = (
        f" (1 process and {counted(runners, 'env runner')})" if runners and spec.resources.num_cpus is None else ""
    )
    if cpus > machine.num_cpus:
        hint = machine.more
        if machine.num_cpus >= 1:
            hint = f"set {_settings_that_fit(spec, int(machine.num_cpus))}, or {hint}"
        raise CannotRunError(
            f"One trial needs {counted(cpus, 'CPU')}{made_of}; {machine.source} has {machine.num_cpus:g}. {FOR_EVER}",
            f"{hint[0].upper()}{hint[1:]}.",
        )
    if gpus > machine.num_gpus:
        needs = f"One trial needs {gpus:g} GPU{'s' * (gpus != 1)}"
        if machine.unusable_gpus:
            raise CannotRunError(
                f"{needs}; {machine.source} has {machine.unusable_gpus:g}, but its PyTorch is a build for CPUs alone.",
                "Install PyTorch's build for CUDA (pytorch.org/get-started has the command), or set "
                "resources.num_gpus to 0.",
            )
        raise CannotRunError(
            f"{needs}; {machine.source} has {machine.num_gpus:g}. {FOR_EVER}",
            "Set resources.num_gpus to 0 before the launch, or take a machine, or with --address a cluster, with GPUs.",
        )
    main = cpus - runners
    if machine.nodes and not any(main <= node_cpus and gpus <= node_gpus for node_cpus, node_gpus in machine.nodes):
        nodes = ", ".join(f"{node_cpus:g} and {node_gpus:g}" for node_cpus, node_gpus in machine.nodes)
        raise CannotRunError(
            f"One trial's process needs {counted(main, 'CPU')} and {gpus:g} GPU{'s' * (gpus != 1)} on one node; no "
            f"node of {machine.source} has both (CPUs and GPUs of its nodes: {nodes}). {FOR_EVER}",
            "Lower resources.num_cpus or resources.num_gpus.",
        )


def _settings_that_fit(spec: SweepSpec, most: int) -> str:
    """Return which settings to lower, and how far, for a trial that takes so many CPUs at most."""
    runners, found = spec.resources.num_env_runners, []
    if spec.resources.num_cpus is not None:
        found.append(f"resources.num_cpus to at most {most}")
    # Each needs a CPU, beside the trial's own process, also where num_cpus asks for the CPUs.
    if 1 + runners > most:
        found.append(f"resources.num_env_runners to at most {most - 1}")
    return " and ".join(found)
