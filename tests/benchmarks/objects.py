"""What a sweep takes in an object store beside one in a folder, with 20 ms before each of the store's answers."""

from __future__ import annotations

import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks import measure
from tests.benchmarks.ppo import BIN

_LATENCY_MS = 20
_MOST = 1.05


@contextlib.contextmanager
def distant_store(latency_ms: int = _LATENCY_MS) -> Iterator[str]:
    """Serve `tests.benchmarks.distant_store` for the block; gives its address."""
    command = [sys.executable, "-m", "tests.benchmarks.distant_store", str(latency_ms)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        if server.stdout is None:
            raise RuntimeError("The server says nothing.")
        try:
            yield server.stdout.readline().strip()
        finally:
            server.terminate()


def rows(repeats: int) -> list[tuple[str, str, str]]:
    """Run `launch cartpole-ppo` in a folder and in the store by turns, and return the row of their wall times."""
    # What the server takes as credentials: anything.
    os.environ |= {"AWS_ACCESS_KEY_ID": "bench", "AWS_SECRET_ACCESS_KEY": "bench"}
    times: dict[str, list[float]] = {"folder": [], "store": []}
    with tempfile.TemporaryDirectory(prefix="tune-jobs-bench-") as folder, distant_store() as endpoint:
        places = {"folder": f"{folder}/sweeps", "store": f"s3://bench/sweeps?endpoint={endpoint}"}
        for turn in range(repeats):
            for kind, place in places.items():
                begin = time.perf_counter()
                command = [str(BIN / "tune-jobs"), "launch", "cartpole-ppo", "--name", f"n{turn}"]
                measure.run([*command, "--storage", place, "--progress", "none"], cwd=Path(folder))
                times[kind].append(time.perf_counter() - begin)
    ratio = statistics.median(b / a for a, b in zip(times["folder"], times["store"], strict=True))
    told = ", ".join(f"{kind} {statistics.median(found):.1f} s" for kind, found in times.items())
    name = f"make sweep's sweep in an object store, {_LATENCY_MS} ms an answer, beside a folder"
    return [(name, f"{ratio:.3f} x ({told})", f"<= {_MOST} x")]
