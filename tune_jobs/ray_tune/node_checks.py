"""Check every node of a cluster before anything starts there: its versions, the user's modules, and the storage.

All nodes are asked at once, and every one that cannot take part is named in one error.
"""

from __future__ import annotations

import contextlib
import functools
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import ray
from ray.exceptions import GetTimeoutError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from policies.errors import CannotRunError, TuneJobsError
from tune_jobs.process.ran_with import PACKAGES, versions
from tune_jobs.ray_tune.connected_ray import alive_nodes
from tune_jobs.store.opening import open_sweep

# The first process on a node imports torch and RLlib, from a disk that may be slow and cold.
_TIMEOUT_S = 180.0
_MOST_NAMED = 5
_NAMES = {"python": "Python", "ray": "Ray"}

_STORAGE = "Choose storage that every node reaches, and may write, (a network file system) with --storage."
_VERSIONS = "Install the same versions everywhere, or use one image for all nodes."
_WORKING = "Install the same version of tune-jobs on every node, or use its image."
_MODULES = "Install the modules of --allow-module on every node, or put their folder on PYTHONPATH before `ray start`."
_NO_CUDA = (
    "Install PyTorch's build for CUDA there, or start the node with `ray start --num-gpus=0`, so that it gets no trial "
    "that needs one."
)
_SILENT = "Check the nodes with `ray status`, and that their file systems respond."


@dataclass(frozen=True)
class Problem:
    """What keeps a node from taking part."""

    text: str
    """What is wrong, to be read behind the node's name."""
    hint: str


def check_nodes(sweep_place: str, modules: Sequence[str] = (), *, num_gpus: float = 0.0) -> tuple[str, ...]:
    """Check, by a worker on every node, what a sweep needs there.

    That is the versions that this process has (of Python and torch, those that matter), the user's own modules, and
    the sweep's folder: the node has to read, write, list, lock and delete there. A node that leaves meanwhile, as an
    autoscaler takes idle ones away, is left out.

    Args:
        sweep_place: The place of the sweep; its lock has to be held.
        modules: The user's own modules that the sweep needs.
        num_gpus: Of a trial; if it needs any, PyTorch has to be a build for them where there are some.

    Returns:
        Notes on differences that do not matter.

    Raises:
        CannotRunError: One or more nodes cannot take part; the message names them, and why.
    """
    with open_sweep(sweep_place).probing() as probe:
        # The function is sent as code, so that a node with another tune-jobs, or none, still answers.
        ask = ray.remote(num_cpus=0, max_retries=0)(_question())
        tasks = {}
        for node in alive_nodes():
            strategy = NodeAffinitySchedulingStrategy(node_id=node["NodeID"], soft=False)
            name = f"{node['NodeManagerAddress']} ({node['NodeManagerHostname']}, node {node['NodeID'][:8]})"
            task = ask.options(scheduling_strategy=strategy).remote(
                PACKAGES, tuple(modules), probe.place, node["NodeID"]
            )
            tasks[name] = (task, node)
        deadline = time.monotonic() + _TIMEOUT_S
        found: dict[str, list[Problem]] = {}
        notes: list[str] = []
        for name, (task, node) in tasks.items():
            told = _answer_of(task, max(0.0, deadline - time.monotonic()))
            if isinstance(told, Problem):
                if not _leaves(node["NodeID"]):
                    found[name] = [told]
                continue
            is_same = functools.partial(probe.is_same, machine=node["NodeID"])
            found[name] = problems_of(told, versions(), sweep_place, is_same)
            if num_gpus and node["Resources"].get("GPU"):
                found[name] += problems_of_gpus(told, node["Resources"]["GPU"])
            notes += _notes(name, told["versions"])
    refuse({name: problems for name, problems in found.items() if problems}, len(found))
    return tuple(notes)


def _question() -> Callable[..., dict[str, Any]]:  # noqa: C901 (it is sent in one piece)
    """Return what a node runs; a function within a function is sent as code, and not as a name to be imported."""

    def ask(packages: tuple[str, ...], modules: tuple[str, ...], place: str, machine: str) -> dict[str, Any]:
        import importlib
        import platform
        from importlib.metadata import PackageNotFoundError, version

        found = {"python": platform.python_version()}
        for package in packages:
            try:
                found[package] = version(package)
            except PackageNotFoundError:
                continue

        def said(error: BaseException) -> str:
            lines = str(error).strip().splitlines()
            return f"{type(error).__name__}: {lines[-1].strip() if lines else ''}"

        told: dict[str, Any] = {"versions": found, "modules": {}}
        try:
            from tune_jobs.process.torch_build import uses_gpus
            from tune_jobs.store.opening import answer
            from tune_jobs.store.probe import FailedOperationError
        except Exception as error:  # noqa: BLE001 (whatever its installation lacks)
            return {**told, "not_working": said(error)}
        told["uses_gpus"] = uses_gpus()
        try:
            told["question"] = answer(place, machine)
        except FailedOperationError as error:
            told["failed"] = (error.operation, error.reason)
        except FileNotFoundError:
            told["unseen"] = True
        except Exception as error:  # noqa: BLE001 (whatever a store raises)
            told["failed"] = ("use", said(error))
        for module in modules:
            try:
                importlib.import_module(module)
            except BaseException as error:  # noqa: BLE001 (a user's module may do anything, also end the process)
                told["modules"][module] = said(error)
        return told

    return ask


def _answer_of(task: Any, timeout_s: float) -> dict[str, Any] | Problem:
    try:
        told: dict[str, Any] = ray.get(task, timeout=timeout_s)
    except GetTimeoutError:
        return Problem(f"did not answer within {_TIMEOUT_S:.0f} s", _SILENT)
    except Exception as error:  # noqa: BLE001 (a worker that does not start, or dies)
        return Problem(f"cannot run a worker: {_last_line(error)}", _SILENT)
    return told


def _leaves(node_id: str) -> bool:
    """Whether a node has left the cluster, or is being drained: nothing will be trained there."""
    if node_id not in {node["NodeID"] for node in alive_nodes()}:
        return True
    state: Any = ray._private.state  # noqa: SLF001 (told nowhere else)
    # A client of `ray://` can't ask; what is drained is gone a little later.
    with contextlib.suppress(Exception):
        return node_id in state.state.get_draining_nodes()
    return False


def problems_of(
    told: Mapping[str, Any],
    ours: Mapping[str, str],
    place: str,
    is_same: Callable[[str], bool],
    here: str | None = None,
) -> list[Problem]:
    """Return what keeps a node from taking part, by its answer.

    Args:
        told: The answer.
        ours: The versions that it must have.
        place: The place of the sweep.
        is_same: Whether a node that read this question sees the same folder.
        here: What has the versions that it must have; None: this machine.
    """
    theirs = told["versions"]
    if "not_working" in told and theirs.get("tune-jobs") == ours.get("tune-jobs"):
        return [Problem(f"has no working tune-jobs: {told['not_working']}", _WORKING)]
    here = here or socket.gethostname()
    problems = [
        Problem(f"has {_NAMES.get(name, name)} {theirs[name]}, {here} has {version}", _VERSIONS)
        if name in theirs
        else Problem(f"has no {_NAMES.get(name, name)}, {here} has {version}", _VERSIONS)
        for name, version in ours.items()
        if _what_counts(name, theirs.get(name, "")) != _what_counts(name, version)
    ]
    if theirs.get("tune-jobs") != ours.get("tune-jobs"):
        # What another version finds in the storage, or does not, says nothing.
        return problems
    problems += [
        Problem(f"cannot import the module {module}: {said}", _MODULES) for module, said in told["modules"].items()
    ]
    if "unseen" in told:
        problems.append(Problem(f"does not see the sweep folder {place}", _STORAGE))
    elif "failed" in told:
        operation, reason = told["failed"]
        problems.append(Problem(f"cannot {operation} in the sweep folder {place}: {reason}", _STORAGE))
    elif not is_same(told["question"]):
        problems.append(Problem(f"sees another folder under the name {place}", _STORAGE))
    return problems


def problems_of_gpus(told: Mapping[str, Any], num_gpus: float) -> list[Problem]:
    """Return what keeps a node with GPUs from training on them, by its answer.

    Args:
        told: The answer.
        num_gpus: The GPUs that it offers.
    """
    if told.get("uses_gpus", True):
        return []
    text = f"offers {num_gpus:g} GPU{'s' * (num_gpus != 1)}, but its PyTorch {told['versions'].get('torch', '')} is a "
    return [Problem(f"{text}build for CPUs alone", _NO_CUDA)]


def _what_counts(name: str, version: str) -> str:
    """Return the part of a version that has to be the same everywhere."""
    if name == "python":
        return ".".join(version.split(".")[:2])
    # What a build is for (+cpu, +cu128) differs between nodes with and without GPUs.
    return version.partition("+")[0] if name == "torch" else version


def _notes(name: str, theirs: Mapping[str, str]) -> list[str]:
    ours = versions()["python"]
    return [] if theirs["python"] == ours else [f"Node {name} has Python {theirs['python']}, this machine {ours}."]


def refuse(found: Mapping[str, Sequence[Problem]], num_nodes: int) -> None:
    """Raise one error for all nodes that cannot take part; do nothing if there is none.

    Args:
        found: What is wrong with each of them, by name.
        num_nodes: The number of all nodes.

    Raises:
        CannotRunError: There are such nodes; at most five are named, the others counted.
    """
    if not found:
        return
    lines = [f"Node {name} {'; '.join(problem.text for problem in problems)}" for name, problems in found.items()]
    hints = " ".join(dict.fromkeys(problem.hint for problems in found.values() for problem in problems))
    if len(lines) == 1:
        raise CannotRunError(f"{lines[0].rstrip('.')}.", hints)
    named = lines[:_MOST_NAMED]
    if len(lines) > len(named):
        named.append(f"and {len(lines) - len(named)} more")
    listed = "".join(f"\n  {line}" for line in named)
    raise CannotRunError(f"{len(lines)} of {num_nodes} nodes cannot take part in the sweep:{listed}", hints)


def _last_line(error: Exception) -> str:
    if isinstance(error, TuneJobsError):
        return error.message
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].strip()
