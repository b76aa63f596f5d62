"""Check, in a process of a trial or a pack, the node that it was started on: it may have joined after the launch.

Nodes of the start are checked by `node_checks` before anything begins. One that joins later gets a process as soon as
it has room, so the process itself looks, before it trains anything.
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Mapping
from typing import Any

import ray

from policies.errors import NotFoundError, TuneJobsError
from tune_jobs.process.ran_with import versions
from tune_jobs.process.torch_build import uses_gpus
from tune_jobs.ray_tune.lost_nodes import NodeRefusedError
from tune_jobs.ray_tune.node_checks import problems_of, problems_of_gpus
from tune_jobs.store.opening import open_sweep


def refusal(config: Mapping[str, Any]) -> NodeRefusedError | None:
    """Return why this process's node can't take part in its sweep; None: it can.

    It is returned, as Tune tells nobody the kind of an error that is raised while a process is set up.

    Args:
        config: The settings that the process was started with: `sweep_place`, and from the driver of a sweep on a
            cluster `versions`, its own as JSON. Without these no node can have joined, and nothing is looked at.
    """
    if "versions" not in config:
        return None
    place = str(config["sweep_place"])
    told: dict[str, Any] = {"versions": versions(), "modules": {}, "question": ""}
    try:
        told["modules"] = _missing(open_sweep(place).read_record().allowed_modules)
    except NotFoundError:
        told["unseen"] = True
    except (TuneJobsError, OSError) as error:
        told["failed"] = ("read", str(error).partition("\n")[0])
    problems = problems_of(told, json.loads(config["versions"]), place, lambda _: True, here="the sweep's driver")
    if given := ray.get_gpu_ids():
        problems += problems_of_gpus({**told, "uses_gpus": uses_gpus()}, len(given))
    if not problems:
        return None
    node_id = str(ray.get_runtime_context().get_node_id())
    text = "; ".join(problem.text for problem in problems)
    hints = " ".join(dict.fromkeys(problem.hint for problem in problems))
    name = f"{ray.util.get_node_ip_address()} ({node_id[:8]})"
    return NodeRefusedError(f"Node {name} cannot take part in the sweep: it {text}.", hints, node_id)


def _missing(modules: tuple[str, ...]) -> dict[str, str]:
    """Return those of the user's modules that are not there; none is imported."""
    packages = {module: module.partition(".")[0] for module in modules}
    return {
        module: f"No module named {package!r}"
        for module, package in packages.items()
        if importlib.util.find_spec(package) is None
    }
