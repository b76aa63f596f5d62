"""Trials are not held back beside other work on the same cores."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.ray

# A process that is not forked from ours, as none is on a machine with a GPU.
SCRIPT = """
import os
from tune_jobs.ray_tune.environment import prepare_environment
prepare_environment()
import ray
ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
of_a_task = ray.get(ray.remote(lambda: os.nice(0)).remote())
print("niceness", of_a_task - os.nice(0))
ray.shutdown()
"""


@pytest.mark.parametrize(("asked", "niceness"), [(None, 0), ("7", 7)])
def test_a_rays_processes_have_the_niceness_of_this_one_unless_the_user_says_otherwise(
    asked: str | None, niceness: int
) -> None:
    """Ray's own default of 15 leaves them 3 % of a core that anything else keeps busy."""
    environment = {name: value for name, value in os.environ.items() if name != "RAY_worker_niceness"}
    if asked is not None:
        environment["RAY_worker_niceness"] = asked
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.stdout.split() == ["niceness", str(niceness)], done.stderr
