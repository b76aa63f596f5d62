"""Ask a joined cluster which nodes its autoscaler may add: a trial that fits on none of them would wait in vain."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from tune_jobs.ray_tune.connected_ray import alive_nodes

# A worker on the head, which may do much else, has to start.
_TIMEOUT_S = 30.0
_HEAD = "node:__internal_head__"


class NodeType(NamedTuple):
    """A kind of nodes that an autoscaler may add."""

    name: str
    num_cpus: float
    num_gpus: float
    most: int
    """How many of them there may be."""


def node_types() -> tuple[NodeType, ...]:
    """Return the kinds of nodes that the cluster's autoscaler may add; none: there is no autoscaler, or it can't tell.

    It can't in the container of its own that KubeRay gives it, nor if the resources of one of its kinds stand nowhere.
    """
    heads = [node["NodeID"] for node in alive_nodes() if _HEAD in node["Resources"]]
    if not heads:
        return ()
    strategy = NodeAffinitySchedulingStrategy(node_id=heads[0], soft=False)
    ask = ray.remote(num_cpus=0, max_retries=0)(_question())
    try:
        told = ray.get(ask.options(scheduling_strategy=strategy).remote(), timeout=_TIMEOUT_S)
        found = [NodeType(name, float(of["CPU"]), float(of.get("GPU", 0)), int(most)) for name, of, most in told]
    except Exception:  # noqa: BLE001 (whatever it is: nothing is known, and the wait has a limit)
        return ()
    return tuple(each for each in found if each.most > 0)


def _question() -> Callable[[], list[tuple[str, dict[str, float], int]]]:
    """Return what the head runs; a function within a function is sent as code, and not as a name to be imported."""

    def ask() -> list[tuple[str, dict[str, float], int]]:
        from pathlib import Path

        import ray
        import yaml

        any_number = 1_000_000
        # What Ray 2.60 asks itself, and only some providers tell (ray pull request 63012).
        told = ray._private.state.state.get_cluster_config()  # noqa: SLF001
        if told is not None and told.node_group_configs:
            groups = told.node_group_configs
            counts = [any_number if each.max_count < 0 else each.max_count for each in groups]
            return [(each.name, dict(each.resources), most) for each, most in zip(groups, counts, strict=True)]
        here = f"--gcs-address={ray.get_runtime_context().gcs_address}"
        for process in Path("/proc").glob("[0-9]*"):
            try:
                words = (process / "cmdline").read_text(encoding="utf-8", errors="replace").split("\0")
                files = [word.partition("=")[2] for word in words if word.startswith("--autoscaling-config=")]
                if not files or here not in words:
                    continue
                path = (process / "cwd").readlink() / Path(files[0]).expanduser()
                config = yaml.safe_load(path.read_text(encoding="utf-8"))
            except OSError:
                # It has ended meanwhile, or is another user's.
                continue
            everywhere = int(config.get("max_workers", any_number))
            types = dict(config["available_node_types"])
            head = types.pop(config.get("head_node_type"), {})
            found = [
                (str(name), dict(of.get("resources") or {}), min(everywhere, int(of.get("max_workers", everywhere))))
                for name, of in types.items()
            ]
            if head.get("max_workers"):
                found.append((config["head_node_type"], dict(head.get("resources") or {}), int(head["max_workers"])))
            return found
        return []

    return ask
