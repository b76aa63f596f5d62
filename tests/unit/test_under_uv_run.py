"""Under `uv run`, trials train in the Python that runs the sweep, and not in one that uv makes for them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

# As uv does: it stays, above the process that it has started.
UV = '"$PYTHON" -c "$CODE"\nexit $?\n'
CODE = """
import json
import ray
from ray._private.worker import _maybe_modify_runtime_env
from ray.util.client import _apply_uv_hook_for_client
from policies.errors import CannotRunError
from tune_jobs.ray_tune import cluster

found = []

def environments():
    return [_maybe_modify_runtime_env(None, False), _apply_uv_hook_for_client(None)]

def init(**_):
    found.append(environments())
    raise RuntimeError("far enough")

ray.init, ray.is_initialized, cluster.check_is_ray = init, lambda: False, lambda _: None
before = environments()
for address in (None, "host:6379", "ray://host:10001"):
    try:
        with cluster.connect(address, forked=None):
            pass
    except CannotRunError as error:
        assert "far enough" in str(error), error
print(json.dumps([before, *found, environments()]))
"""


@pytest.mark.parametrize("asked", [False, True])
def test_trials_are_not_put_into_an_environment_of_uvs_unless_the_user_asks(tmp_path: Path, *, asked: bool) -> None:
    (tmp_path / "run").write_text(UV)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    environment |= {"PYTHON": sys.executable, "CODE": CODE}
    if asked:
        environment["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "1"
    done = subprocess.run(
        ["uv", "run"], executable="/bin/sh", cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    before, *found, after = json.loads(done.stdout.splitlines()[-1])
    assert all(one["py_executable"].startswith("uv run") for one in before)  # where Ray does no such thing any more,
    assert after == before  # the rest is of no use
    assert found == [before if asked else [None, None]] * 3
