"""Ray's end does not take the process with it."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.ray

PROGRAM = """
import gc
import ray
from tune_jobs.plan.machine import local_machine
from tune_jobs.ray_tune.cluster import connect

class Worker:
    def __init__(self, worker):
        self._worker = worker
    def __getattr__(self, name):
        return getattr(self._worker, name)
    def shutdown_driver(self):
        self._worker.shutdown_driver()
        # Where another thread may be in a collection: Ray's native part is gone, and Python has not forgotten it.
        cycle = [refs.pop()]
        cycle.append(cycle)
        del cycle
        [[] for _ in range(2 * gc.get_threshold()[0])]
        print("in the gap", flush=True)

with connect(None, local_machine()):
    refs = [ray.put(0)]
    worker = ray._private.worker.global_worker
    worker.core_worker = Worker(worker.core_worker)
assert gc.isenabled()
print("still here")
"""


def test_no_reference_is_freed_where_that_would_end_the_process() -> None:
    """Ray's native code ends it without a word if a reference is freed between two steps of its shutdown."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "in the gap\nstill here"), done.stderr
