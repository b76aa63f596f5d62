"""A Ray that is started for sweeps of this machine has no processes that nobody asks anything."""

from __future__ import annotations

from typing import Any

import pytest
import ray._private.node

from policies.errors import CannotRunError
from tune_jobs.plan.machine import Machine
from tune_jobs.ray_tune.cluster import connect

UNUSED = ("start_monitor", "start_log_monitor", "start_api_server")
NODE: Any = ray._private.node.Node


def test_those_are_not_started_and_another_ray_of_this_process_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    before = [getattr(NODE, name) for name in UNUSED]  # a Ray in which they have other names is noticed here
    started: list[object] = []

    def init(**_: Any) -> None:
        node = NODE.__new__(NODE)
        started.extend(getattr(node, name)(include_dashboard=False, raise_on_failure=False) for name in UNUSED)
        raise RuntimeError("far enough")

    monkeypatch.setattr("ray.is_initialized", lambda: False)
    monkeypatch.setattr("ray.init", init)
    with pytest.raises(CannotRunError, match="far enough"), connect(None, Machine(num_cpus=1, num_gpus=0)):
        pass
    assert started == [None, None, None]
    assert [getattr(NODE, name) for name in UNUSED] == before
