"""`python -m tests.benchmarks`: the table of figures, every contender in the same run.

Run it on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import re
import statistics
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import yaml
from rich.console import Console
from rich.table import Table

from tests.benchmarks import dqn, workload
from tests.benchmarks.measure import Run, run

ROOT = Path(__file__).parents[2]
CLI = str(Path(sys.executable).with_name("tune-jobs"))
FIRST_RESULT = r"\([1-9][\d,]* env steps in all"


def machine_name() -> str:
    """Cores and processor of this machine."""
    cpuinfo = Path("/proc/cpuinfo")
    names = re.findall(r"^model name\s*:\s*(.+)$", cpuinfo.read_text(), re.MULTILINE) if cpuinfo.exists() else []
    return f"{len(os.sched_getaffinity(0))} cores of {names[0] if names else platform.machine()}"


def median(values: list[float]) -> float:
    """Median of some runs."""
    return statistics.median(values)


def trial_gaps(folder: Path) -> list[float]:
    """Seconds from a trial's end to the start of the next one's first iteration, in the same process."""
    by_process = defaultdict(list)
    for path in folder.glob("trials/*/trial.json"):
        record = json.loads(path.read_text())
        by_process[record["pid"]].append((record["started_at"], record["ended_at"]))
    gaps = []
    for spans in by_process.values():
        spans.sort()
        gaps += [later[0] - earlier[1] for earlier, later in itertools.pairwise(spans)]
    return gaps


def speeds(folder: Path) -> list[float]:
    """Env steps/s of each trial, its evaluations and checkpoints included; one core a trial."""
    records = [json.loads(path.read_text()) for path in folder.glob("trials/*/trial.json")]
    return [record["num_env_steps"] / record["time_s"] for record in records]


def bench_launch(repeats: int, num_env_steps: int) -> tuple[list[Run], list[Path]]:
    """`tune-jobs launch` of the workload, in a terminal; with best, evaluation, videos and report."""
    runs, folders = [], []
    for number in range(repeats):
        storage = Path(tempfile.mkdtemp())
        spec = storage / "bench.yaml"
        spec.write_text(yaml.safe_dump(workload.sweep_file(num_env_steps)))
        command = [CLI, "launch", str(spec), "--storage", str(storage), "--name", f"bench-{number}"]
        runs.append(run(command, cwd=ROOT, first=FIRST_RESULT, terminal=True))
        folders.append(storage / f"bench-{number}")
    return runs, folders


def bench_command(arguments: list[str], repeats: int) -> float:
    """Median seconds of a `tune-jobs` command."""
    return median([run([CLI, *arguments], cwd=ROOT).wall_s for _ in range(repeats)])


def bench_peer(module: str, repeats: int, num_env_steps: int) -> list[Run]:
    """A peer's script."""
    return [run([sys.executable, "-m", module, str(num_env_steps)], cwd=ROOT) for _ in range(repeats)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--env-steps", type=int, default=workload.NUM_ENV_STEPS, help="of each of the 20 trials")
    parser.add_argument("--dqn-env-steps", type=int, default=dqn.NUM_ENV_STEPS, help="of each DQN trial")
    parser.add_argument("--only", choices=["ppo", "dqn"], help="these rows alone")
    parser.add_argument("--no-peers", action="store_true")
    options = parser.parse_args()
    rows = [] if options.only == "dqn" else ppo_rows(options)
    if options.only != "ppo":
        rows += dqn.rows(options.repeats, options.dqn_env_steps, peers=not options.no_peers)
    table = Table(title=f"{machine_name()}, medians of {options.repeats}")
    for column in ("figure", "measured", "at most / at least"):
        table.add_column(column)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def ppo_rows(options: argparse.Namespace) -> list[tuple[str, str, str]]:
    """The tutorial's sweep, ours and the peers', and the commands that answer at once."""
    help_s = bench_command(["--help"], 5)
    dry_run_s = bench_command(["launch", "cartpole-ppo", "--dry-run"], 5)
    runs, folders = bench_launch(options.repeats, options.env_steps)
    ours = median([item.wall_s for item in runs])
    gaps = [gap for folder in folders for gap in trial_gaps(folder)]
    first = [item.first_match_s for item in runs if item.first_match_s is not None]
    rows = [
        ("launch, 20 trials, start to end", f"{ours:.1f} s", "85 s"),
        ("peak memory of all its processes", f"{max(item.peak_bytes for item in runs) / 2**30:.2f} GiB", "4 GiB"),
        ("next trial's first iteration after the last one's end", f"{max(gaps):.3f} s (worst)", "0.3 s"),
        (
            "env steps/s a core, median trial",
            f"{median([speed for folder in folders for speed in speeds(folder)]):,.0f}",
            "6,500",
        ),
        ("first result on the screen", f"{median(first):.1f} s", "10 s"),
        ("tune-jobs --help", f"{help_s:.2f} s", "0.5 s"),
        ("tune-jobs launch --dry-run", f"{dry_run_s:.2f} s", "0.5 s"),
    ]
    if not options.no_peers:
        stock = median(
            [item.wall_s for item in bench_peer("tests.benchmarks.stock_rllib", options.repeats, options.env_steps)]
        )
        sb3 = median(
            [
                item.wall_s
                for item in bench_peer("tests.benchmarks.stable_baselines", options.repeats, options.env_steps)
            ]
        )
        rows += [
            ("the same work, Ray Tune + RLlib", f"{stock:.1f} s, {stock / ours:.2f} x ours", ""),
            ("the same work, Stable-Baselines3, 2 processes", f"{sb3:.1f} s, {sb3 / ours:.2f} x ours", ""),
        ]
    return rows


if __name__ == "__main__":
    main()
