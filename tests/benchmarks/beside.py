"""Sweeps of a few trials beside Stable-Baselines3 with the same settings: both on all cores, taking turns.

`python -m tests.benchmarks.beside WORK` is the peer: a process a core, which trains its share of the trials one after
the other, each with the program that the report offers for the trial's setting. It evaluates and saves nothing.
"""

from __future__ import annotations

import functools
import itertools
import json
import multiprocessing
import sys
import time
from collections import defaultdict
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

from policies.foreign_code import ForeignProgram, stable_baselines3_program
from policies.hyperparams import Algorithm, DQNHyperparams, PPOHyperparams, make_hyperparams
from tests.benchmarks import workload
from tests.benchmarks.measure import run
from tests.benchmarks.ppo import ROOT, Row, launch, median, records
from tune_jobs.spec.file import load_spec


@dataclass(frozen=True)
class Work:
    """So many trials of a setting, which differ in their learning rates."""

    title: str
    algorithm: Algorithm
    env_id: str
    num_trials: int
    num_env_steps: int
    at_least: str
    """How many times as fast as the peer the command is to be."""
    preset: str | None = None
    """The preset that the setting is of, but for `changes`."""
    changes: Mapping[str, Any] | None = None

    @functools.cached_property
    def hyperparams(self) -> dict[str, Any]:
        """The setting."""
        known = {} if self.preset is None else load_spec(self.preset).hyperparams
        return {**known, **(self.changes or {})}

    @functools.cached_property
    def lrs(self) -> list[float]:
        """A learning rate a trial, from a half of the setting's to the whole."""
        lr = float(self.hyperparams["lr"])
        return [lr * (0.5 + 0.5 * (number + 1) / self.num_trials) for number in range(self.num_trials)]

    def sweep_file(self) -> dict[str, Any]:
        """The work as a sweep file; each trial is evaluated once, at its end, which the peer's are not."""
        return {
            "env": self.env_id,
            "algorithm": self.algorithm,
            "hyperparams": {name: value for name, value in self.hyperparams.items() if name != "lr"},
            "space": {"lr": {"grid": self.lrs}},
            "stop": {"num_env_steps": self.num_env_steps},
            "evaluation": {"every_iterations": 100_000, "num_episodes": 10},
            "checkpoints": {"every_iterations": 100_000, "keep": 1},
        }


WORKS = {
    "lunarlander": Work("PPO on LunarLander, 8 trials", "ppo", "LunarLander-v3", 8, 100_000, "4 x", "lunarlander-ppo"),
    "hopper": Work(
        "PPO on Hopper, 4 trials, 256 x 256", "ppo", "Hopper-v5", 4, 50_000, "2.5 x",
        changes={
            # CleanRL's and RL Zoo's kind of setting for MuJoCo.
            "hidden_sizes": [256, 256], "activation": "tanh", "lr": 3e-4, "num_envs": 8, "train_batch_size": 4096,
            "minibatch_size": 128, "num_epochs": 10, "gae_lambda": 0.95, "normalize_observations": True,
        },
    ),
    "acrobot": Work(
        "PPO on Acrobot, 8 trials", "ppo", "Acrobot-v1", 8, 50_000, "4 x",
        # RL Zoo's kind of setting.
        changes={
            "hidden_sizes": [64, 64], "activation": "tanh", "lr": 3e-4, "num_envs": 16, "train_batch_size": 4096,
            "minibatch_size": 64, "num_epochs": 4, "gae_lambda": 0.94, "normalize_observations": True,
        },
    ),
    "cartpole-dqn": Work(
        "DQN on CartPole, tuned, 10 trials", "dqn", "CartPole-v1", 10, 20_000, "5 x", "cartpole-dqn-tuned",
        # Which the peer does not have.
        changes={"double_q": False},
    ),
    "cartpole-dqn-double": Work(
        "DQN on CartPole, tuned, ours with double Q-learning", "dqn", "CartPole-v1", 10, 20_000, "",
        "cartpole-dqn-tuned",
    ),
}  # fmt: skip


def peer_notes(work: Work) -> tuple[str, ...]:
    """Return what the peer's program leaves out of the settings, or does otherwise."""
    return peer_program(work, work.lrs[0]).notes


def peer_program(work: Work, lr: float) -> ForeignProgram:
    """Return the program that trains one of its trials with Stable-Baselines3."""
    hyperparams = make_hyperparams(work.algorithm, {**work.hyperparams, "lr": lr})
    assert isinstance(hyperparams, PPOHyperparams | DQNHyperparams)
    return stable_baselines3_program(hyperparams, env_id=work.env_id, env_args={}, num_env_steps=work.num_env_steps)


def train(work: Work, lrs: list[float]) -> list[float]:
    """Train trials with Stable-Baselines3, one after the other, and return the seconds in `learn` of each."""
    import torch

    torch.set_num_threads(1)
    seconds: list[float] = []
    for lr in lrs:
        # The last line trains.
        making, training = peer_program(work, lr).code.rsplit("\n", 1)
        names: dict[str, Any] = {}
        exec(making, names)
        start = time.perf_counter()
        exec(training, names)
        seconds.append(time.perf_counter() - start)
        assert names["model"].num_timesteps >= work.num_env_steps
    return seconds


def train_shares(work: Work) -> list[float]:
    """Train all trials in a process a core, and return the seconds in `learn` of each.

    What fails in one of the processes is raised here.
    """
    shares = [work.lrs[number :: workload.NUM_CPUS] for number in range(workload.NUM_CPUS)]
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workload.NUM_CPUS, mp_context=spawn) as processes:
        return list(itertools.chain.from_iterable(processes.map(functools.partial(train, work), shares)))


def rows(repeats: int) -> list[Row]:
    """A row for the whole command, from Enter to prompt, and one for training alone, of each work."""
    table: list[Row] = []
    for name, work in WORKS.items():
        found: dict[str, list[float]] = defaultdict(list)
        for _ in range(repeats):
            done, folder = launch(work.sweep_file(), "--no-finish")
            spans = [(record["started_at"], record["ended_at"]) for record in records(folder)]
            assert len(spans) == work.num_trials
            found["ours"].append(done.wall_s)
            found["our training"].append(max(end for _, end in spans) - min(start for start, _ in spans))
            peer = run([sys.executable, "-m", "tests.benchmarks.beside", name], cwd=ROOT)
            seconds = json.loads(peer.output.splitlines()[-1])
            found["theirs"].append(peer.wall_s)
            found["their training"].append(sum(seconds) / workload.NUM_CPUS)
        for title, ours, theirs, bar in (
            (f"{work.title}: the command", "ours", "theirs", work.at_least),
            ("  training alone", "our training", "their training", ""),
        ):
            ratios = [their / our for our, their in zip(found[ours], found[theirs], strict=True)]
            text = (
                f"{median(found[ours]):.1f} s, Stable-Baselines3 {median(found[theirs]):.1f} s: {median(ratios):.2f} x "
                f"({min(ratios):.2f} to {max(ratios):.2f})"
            )
            table.append((title, text, bar))
        table += [("  the peer differs", note, "") for note in peer_notes(work)]
    return table


if __name__ == "__main__":
    print(json.dumps(train_shares(WORKS[sys.argv[1]])))
