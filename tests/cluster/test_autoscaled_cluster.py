"""A cluster that grows for a sweep, for no more than the sweep can use, and shrinks after it, also if it is killed."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.cluster

UNSHARE = ["unshare", "--pid", "--fork", "--mount-proc", "--mount", "--net"]


def test_a_cluster_grows_for_what_a_sweep_can_use_and_shrinks_after_it(tmp_path: Path) -> None:
    try:
        probe = subprocess.run([*UNSHARE, "ip", "link", "set", "lo", "up"], capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        pytest.skip(f"namespaces are not available here: {error}")
    if probe.returncode != 0:
        pytest.skip(f"namespaces are not available here: {probe.stderr.strip()}")
    script = 'ip link set lo up; exec "$0" -m tests.cluster.autoscaled "$1"'
    done = subprocess.run(
        [*UNSHARE, "sh", "-ec", script, sys.executable, str(tmp_path)],
        capture_output=True, text=True, check=False, timeout=590, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])

    large = found["large"]
    assert large["code"] == 5, large
    assert "One trial needs 2 CPUs" in large["said"]
    assert (
        "With all nodes that its autoscaler may add it would not fit either: small (1 CPU, 3 at most)." in large["said"]
    )
    # It had 120 s to wait.
    assert large["took_s"] < 60, large
    assert (large["most_asked"], large["most_nodes"], large["is_kept"]) == (0, 0, False), large

    # Two packs, or two trials, while there may be three nodes.
    killed = found["killed"]
    assert killed["is_training"], killed
    single = found["single"]
    assert single["code"] == 0, single
    assert "2 completed" in single["said"]
    for each in (killed, single):
        assert each["most_asked"] == 2, each
        # A node that was idle for a while on its way may be on its way out while another one comes.
        assert each["most_nodes"] in (2, 3), each
        assert (each["is_withdrawn"], each["is_small_again"]) == (True, True), each
