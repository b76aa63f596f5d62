"""DQN's speed: the preset `cartpole-dqn-tuned` beside plain RLlib DQN with the same settings, one trial at a time."""

from __future__ import annotations

import re
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from policies.hyperparams import DQNHyperparams, make_hyperparams
from tests.benchmarks.measure import run
from tests.benchmarks.ppo import pack_rows, pack_speed, speeds
from tune_jobs.spec.file import list_presets, load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

PRESET = "cartpole-dqn-tuned"
NUM_ENV_STEPS = 10_000
BUFFERS = ("uniform", "prioritized")
ROOT = Path(__file__).parents[2]
_CLI = str(Path(sys.executable).with_name("tune-jobs"))


def settings() -> tuple[SweepSpec, DQNHyperparams]:
    """The preset's sweep and its hyperparameters."""
    spec = load_spec(PRESET)
    hyperparams = make_hyperparams(spec.algorithm, spec.hyperparams)
    assert isinstance(hyperparams, DQNHyperparams)
    return spec, hyperparams


def ours(num_env_steps: int) -> float:
    """Env steps/s of one trial with the preset's hyperparameters that no return ends; checkpoints included.

    It is evaluated at the end alone, over 20 episodes: the peer is not evaluated at all.
    """
    storage = Path(tempfile.mkdtemp())
    changes = ["stop.evaluation_return=", "stop.training_return=", f"stop.num_env_steps={num_env_steps}"]
    changes += ["seeds_per_point=1", "resources.max_concurrent=1", "engine=rllib"]
    changes += ["evaluation.every_iterations=1000", "evaluation.num_episodes=20"]
    command = [_CLI, "launch", PRESET, "--storage", str(storage), "--name", "dqn", "--no-finish"]
    run([*command, *(part for change in changes for part in ("--set", change))], cwd=ROOT)
    (speed,) = speeds(storage / "dqn")
    return speed


def stock(buffer: str, num_env_steps: int) -> float:
    """Env steps/s of plain RLlib DQN with one of its replay buffers; it evaluates and saves nothing."""
    module = "tests.benchmarks.stock_dqn"
    output = run([sys.executable, "-m", module, buffer, str(num_env_steps)], cwd=ROOT).output
    found = re.search(r"env_steps_per_s=([\d.]+)", output)
    assert found is not None, output[-2000:]
    return float(found.group(1))


def rows(repeats: int, num_env_steps: int, *, peers: bool) -> list[tuple[str, str, str]]:
    """Rows of the benchmark's table; the contenders take turns, so that a slow minute hits them all."""
    if PRESET not in {preset.name for preset in list_presets()}:
        return [("DQN env steps/s a core", f"skipped: there is no preset {PRESET}", "2,500")]
    mine: list[float] = []
    packs: list[dict[str, Any]] = []
    theirs: dict[str, list[float]] = {buffer: [] for buffer in (BUFFERS if peers else ())}
    for _ in range(repeats):
        mine.append(ours(num_env_steps))
        packs.append(pack_speed("dqn", 20, 8))
        for buffer, values in theirs.items():
            values.append(stock(buffer, num_env_steps))
    speed = statistics.median(mine)
    table = [
        *pack_rows(f"pack of 20, {PRESET}", packs, "20 x one RLlib DQN"),
        (f"DQN env steps/s a core, {PRESET}, engine rllib", f"{speed:,.0f}", "2,500"),
    ]
    pack = statistics.median(float(item["env_steps_per_s"]) for item in packs)
    for buffer, values in theirs.items():
        peer = statistics.median(values)
        table.append(
            (
                f"the same, plain RLlib DQN, its {buffer} buffer",
                f"{peer:,.0f}; the pack of 20 makes {pack / peer:.0f} x",
                "",
            )
        )
    return table
