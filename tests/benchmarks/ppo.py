"""PPO's figures: the tutorial's sweep by both engines and by the peers, packs by themselves, and a thousand trials."""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from tests.benchmarks import workload
from tests.benchmarks.measure import Run, run

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
CLI = str(BIN / "tune-jobs")
FIRST_RESULT = r"[1-9][\d,]* of at most"
MANY = 1000
Row = tuple[str, str, str]


def median(values: list[float]) -> float:
    """Median of some runs."""
    return statistics.median(values)


def launch(spec: dict[str, Any], *options: str) -> tuple[Run, Path]:
    """`tune-jobs launch` of a sweep file, in a terminal; returns the run and the sweep's folder."""
    storage = Path(tempfile.mkdtemp())
    path = storage / "bench.yaml"
    # The peers train no setting twice.
    path.write_text(yaml.safe_dump({**spec, "confirm": "none"}))
    command = [CLI, "launch", str(path), "--storage", str(storage), "--name", "bench", *options]
    return run(command, cwd=ROOT, first=FIRST_RESULT, terminal=True), storage / "bench"


def records(folder: Path) -> list[dict[str, Any]]:
    """A sweep's trial records."""
    return [json.loads(path.read_text()) for path in folder.glob("trials/*/trial.json")]


def speeds(folder: Path) -> list[float]:
    """Env steps/s of each trial, its evaluations and checkpoints included; one core a trial."""
    return [record["num_env_steps"] / record["time_s"] for record in records(folder)]


def trial_gaps(folder: Path) -> list[float]:
    """Seconds from a trial's end to the start of the next one's first iteration, in the same process."""
    by_process = defaultdict(list)
    for record in records(folder):
        by_process[record["pid"]].append((record["started_at"], record["ended_at"]))
    gaps = []
    for spans in by_process.values():
        spans.sort()
        gaps += [later[0] - earlier[1] for earlier, later in itertools.pairwise(spans)]
    return gaps


@contextmanager
def running_cluster() -> Iterator[str]:
    """A Ray cluster of this machine's cores that is up before anything is launched; gives its address."""
    ray = str(BIN / "ray")
    start = [ray, "start", "--head", "--port", "0", "--num-cpus", str(workload.NUM_CPUS), "--include-dashboard=false"]
    subprocess.run([*start, "--disable-usage-stats"], check=True, capture_output=True)
    try:
        yield "auto"
    finally:
        subprocess.run([ray, "stop"], check=True, capture_output=True)


def pack_speed(algorithm: str, num_members: int, num_iterations: int) -> dict[str, Any]:
    """What `tests.benchmarks.pack_speed` measures, in a process of its own."""
    module = ["-m", "tests.benchmarks.pack_speed", "--algorithm", algorithm]
    command = [sys.executable, *module, "--members", str(num_members), "--iterations", str(num_iterations)]
    found: dict[str, Any] = json.loads(run(command, cwd=ROOT).output.splitlines()[-1])
    return found


def pack_rows(name: str, measured: list[dict[str, Any]], goal: str) -> list[Row]:
    """Speed of a pack, and how far that is from what the core's matrix product would allow."""
    middle = sorted(measured, key=lambda item: float(item["env_steps_per_s"]))[len(measured) // 2]
    parts = ", ".join(f"{part} {share:.0f}%" for part, share in middle["profile_percent"].items() if share >= 1)
    limit = (
        f"{middle['update_flops_per_env_step']:,} operations an env step, {middle['matrix_product_gflops']} billion/s: "
        f"at most {middle['limit_env_steps_per_s']:,}; reached {100 * middle['share_of_limit']:.0f}%"
    )
    return [
        (f"env steps/s a core, {name}", f"{middle['env_steps_per_s']:,}", goal),
        ("  limit of its products", limit, ""),
        ("  profile", parts, ""),
    ]


def rows(options: argparse.Namespace) -> list[Row]:
    """All of PPO's rows; the contenders take turns, so that a slow minute hits them all."""
    found: dict[str, list[float]] = defaultdict(list)
    packs: dict[int, list[dict[str, Any]]] = defaultdict(list)
    gaps: list[float] = []
    first: list[float] = []
    peak = 0
    for _ in range(options.repeats):
        spec = workload.sweep_file(options.env_steps)
        done, _ = launch(spec)
        found["auto"].append(done.wall_s)
        first += [] if done.first_match_s is None else [done.first_match_s]
        peak = max(peak, done.peak_bytes)
        found["trials"].append(launch(spec, "--no-finish")[0].wall_s)
        with running_cluster() as address:
            found["up"].append(launch(spec, "--no-finish", "--address", address)[0].wall_s)
        done, folder = launch({**spec, "engine": "rllib"})
        found["rllib"].append(done.wall_s)
        found["rllib speed"].append(median(speeds(folder)))
        gaps += trial_gaps(folder)
        for num_members in (20, 1):
            packs[num_members].append(pack_speed("ppo", num_members, 40))
        if not options.no_peers:
            for peer in ("stock_rllib", "stable_baselines"):
                command = [sys.executable, "-m", f"tests.benchmarks.{peer}", str(options.env_steps)]
                found[peer].append(run(command, cwd=ROOT).wall_s)
    ours = median(found["auto"])
    table = [
        ("launch, 20 trials, start to end", f"{ours:.1f} s", "15 s"),
        ("  without best, videos, report", f"{median(found['trials']):.1f} s", ""),
        ("  the same, once Ray is up", f"{median(found['up']):.1f} s", "5 s"),
        ("  peak memory of all its processes (the most of all runs)", f"{peak / 2**30:.2f} GiB", "4 GiB"),
        ("  first result on the screen", f"{median(first):.1f} s", "10 s"),
        *pack_rows("pack of 20", packs[20], "140,000"),
        *pack_rows("one trial alone in a pack", packs[1], "40,000"),
        ("engine rllib: launch, start to end", f"{median(found['rllib']):.1f} s", "85 s"),
        ("  env steps/s a core, median trial", f"{median(found['rllib speed']):,.0f}", "11,000"),
        ("  next trial's first iteration after the last one's end", f"{max(gaps):.3f} s (worst)", "0.3 s"),
    ]
    for peer, name in (("stock_rllib", "Ray Tune + RLlib"), ("stable_baselines", "Stable-Baselines3, 2 processes")):
        if found[peer]:
            seconds = median(found[peer])
            total = workload.NUM_SAMPLES * 4 * options.env_steps
            speed = total / seconds / workload.NUM_CPUS
            text = f"{seconds:.1f} s, {seconds / ours:.2f} x ours; {speed:,.0f} env steps/s a core"
            table.append((f"the same work, {name}", text, ""))
    return table


def command_rows() -> list[Row]:
    """The commands that answer at once."""

    def seconds(*arguments: str) -> float:
        return median([run([CLI, *arguments], cwd=ROOT).wall_s for _ in range(5)])

    return [
        ("tune-jobs --help (median of 5)", f"{seconds('--help'):.2f} s", "0.5 s"),
        (
            "tune-jobs launch --dry-run (median of 5)",
            f"{seconds('launch', 'cartpole-ppo', '--dry-run'):.2f} s",
            "0.5 s",
        ),
    ]


def many_rows(num_env_steps: int) -> list[Row]:
    """A thousand trials, once, and what a trial of them costs beside one of a hundred."""
    table: list[Row] = []
    costs = {}
    for num_trials, goal in ((MANY // 10, ""), (MANY, "360 s, 6 GiB")):
        done, folder = launch(workload.sweep_file(num_env_steps, num_samples=num_trials // 4))
        spans = [(record["started_at"], record["ended_at"]) for record in records(folder)]
        costs[num_trials] = (max(end for _, end in spans) - min(start for start, _ in spans)) / num_trials
        text = f"{done.wall_s:.0f} s, {done.peak_bytes / 2**30:.2f} GiB"
        table.append((f"launch, {num_trials:,} trials, start to end (one run)", text, goal))
    ratio = costs[MANY] / costs[MANY // 10]
    table.append(("  cost of a trial of them, beside one of a hundred (one run)", f"{ratio:.2f} x", "1.1 x"))
    return table


def machine_name() -> str:
    """Cores and processor of this machine."""
    cpuinfo = Path("/proc/cpuinfo")
    names = re.findall(r"^model name\s*:\s*(.+)$", cpuinfo.read_text(), re.MULTILINE) if cpuinfo.exists() else []
    return f"{len(os.sched_getaffinity(0))} cores of {names[0] if names else platform.machine()}"
