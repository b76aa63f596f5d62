"""Packs whose members do as scripts say, run by Ray Tune as a sweep runs its own: no training, a few seconds."""

from __future__ import annotations

import signal
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from unittest import mock

from analysis.records import SweepRecord, TrialRecord
from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.policy import NetworkPolicy, Policy
from policies.portable.file import PortablePolicy
from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.spec.file import load_spec
from tune_jobs.store.record_keeper import Listener
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.training.protocol import IterationStats, PackEngine, TrialTask

if TYPE_CHECKING:
    from tune_jobs.ray_tune.pack_trainable import PackTrainable

STEPS = 100


def make_sweep(folder: Path, num_trials: int, **changes: Any) -> SweepStore:
    """The folder of a sweep that has not begun; an iteration is 100 env steps."""
    spec = load_spec(
        {
            "env": "CartPole-v1",
            "algorithm": "ppo",
            "space": {"lr": {"loguniform": [1e-4, 1e-2]}},
            "num_samples": num_trials,
            "stop": {"num_env_steps": 1_000},
            "evaluation": {"every_iterations": 2, "num_episodes": 1},
            "checkpoints": {"every_iterations": 2, "keep": 1},
        }
        | changes
    )
    store = SweepStore(folder)
    store.create()
    for index in range(num_trials):
        record = TrialRecord(trial_id=f"t{index:04d}", index=index, point_index=index, seed=1024 * index, point={})
        store.trial(record.trial_id).write_record(record)
    store.write_record(
        SweepRecord(
            name=store.name, state="running", spec=spec.model_dump(mode="json"), evaluation_seeds=(1,),
            confirmation_seeds=(2,), num_trials=num_trials, created_at=0.0,
        )
    )  # fmt: skip
    return store


def scripted_trainable(scripts: dict[str, dict[str, Any]], pause_s: float) -> type[PackTrainable]:  # noqa: C901 (a class in a function)
    """A `PackTrainable` whose members do as scripts say.

    Args:
        scripts: Of a trial, by its id: `score`, its evaluation return (the iteration, if it has none); `raise_at`, the
            iteration that always raises; `kill_at`, the iteration that kills the process, for the first `kills` times;
            `hang_at`, the iteration that hangs, the first time; `after`, a file of the sweep folder that it waits for.
        pause_s: Seconds that an iteration of the pack takes.
    """
    # Defined in here, or the worker processes would look for a module that only this one has.
    import gymnasium as gym
    import numpy as np

    from policies.acting.evaluate import Episodes
    from policies.portable.file import Layer, PolicyNetwork, PortablePolicy, describe_space
    from tune_jobs.ray_tune.pack_trainable import PackTrainable
    from tune_jobs.training.protocol import IterationStats

    steps, kill = STEPS, signal.SIGKILL
    observation_space = describe_space(gym.make("CartPole-v1").observation_space)
    action_space = describe_space(gym.spaces.Discrete(2))

    class Engine:
        def __init__(self) -> None:
            self.tasks: dict[str, TrialTask] = {}
            self.iterations: dict[str, int] = {}
            self.moved: Collection[str] = ()

        def add(self, task: TrialTask, checkpoint: Path | None) -> None:
            assert task.trial_id not in self.tasks
            self.tasks[task.trial_id] = task
            self.iterations[task.trial_id] = 0
            if checkpoint is not None:
                self.iterations[task.trial_id] = int((checkpoint / "state.txt").read_text())

        def train_iteration(self, held: Collection[str] = ()) -> dict[str, IterationStats | Exception]:
            import os
            import time

            time.sleep(pause_s)
            results: dict[str, IterationStats | Exception] = {}
            for trial_id, task in self.tasks.items():
                if trial_id in held:
                    continue
                self.iterations[trial_id] += 1
                iteration, script = self.iterations[trial_id], scripts.get(trial_id, {})
                while "after" in script and not (Path(task.sweep_place) / script["after"]).exists():
                    time.sleep(0.01)
                marker = Path(task.sweep_place) / f"{trial_id}.kills"
                kills = int(marker.read_text()) if marker.exists() else 0
                if iteration == script.get("kill_at") and kills < script.get("kills", 1):
                    marker.write_text(str(kills + 1))
                    print("about to die", flush=True)
                    os.kill(os.getpid(), kill)
                    time.sleep(60)
                if iteration == script.get("hang_at") and kills == 0:
                    marker.write_text("1")
                    time.sleep(60)
                if iteration == script.get("raise_at"):
                    results[trial_id] = ZeroDivisionError("the cart left the track")
                else:
                    results[trial_id] = IterationStats(iteration * steps, ((1.0, 5),))
            return results

        def policy(self, trial_id: str) -> PortablePolicy:
            layer = Layer(np.zeros((2, 4), np.float32), np.zeros(2, np.float32), "linear")
            return PortablePolicy(
                network=PolicyNetwork("categorical", (layer,)), algorithm="ppo", env_id="CartPole-v1", env_args={},
                observation_space=observation_space, action_space=action_space, action_transform="none",
                training={"trial_id": trial_id, "iteration": self.iterations[trial_id]},
            )  # fmt: skip

        def save(self, trial_id: str, folder: Path) -> None:
            (folder / "state.txt").write_text(str(self.iterations[trial_id]))

        def remove(self, trial_id: str) -> None:
            del self.tasks[trial_id], self.iterations[trial_id]

        def close(self) -> None:
            pass

    class Scripted(PackTrainable):
        def make_engine(self) -> PackEngine:
            return Engine()

        def evaluate(self, evaluator: Evaluator, policies: Sequence[Policy]) -> list[Episodes]:
            told = [cast("NetworkPolicy", policy).portable.training for policy in policies]
            scores = [scripts.get(one["trial_id"], {}).get("score", float(one["iteration"])) for one in told]
            return [Episodes((1,), (float(score),), (5,)) for score in scores]

    return Scripted


def run_packs(
    store: SweepStore,
    scripts: dict[str, dict[str, Any]] | None = None,
    *,
    num_packs: int = 2,
    slots: int = 2,
    pause_s: float = 0.0,
    listener: Listener | None = None,
    trial_ids: tuple[str, ...] | None = None,
    cpus_per_pack: float = 1.0,
    more_packs: int = 0,
) -> list[TrialRecord]:
    """Run the trials of a sweep that have not ended, in packs; returns their records."""
    from tune_jobs.ray_tune.run_trials import RunJob, run_trials

    todo = tuple(record.trial_id for record in store.read_trials() if record.status in ("pending", "paused", "running"))
    packs = PackPlan(
        num_packs=num_packs, slots=slots, cpus_per_pack=cpus_per_pack, gpus_per_pack=0.0, trial_ids=trial_ids or todo,
        env_kind="scalar", env_step_us=None, num_env_processes=0,
    )  # fmt: skip
    job = RunJob(store.place, todo, 1.0, 0.0, 2, packs=packs, more_packs=more_packs)
    with mock.patch("tune_jobs.ray_tune.run_trials.PackTrainable", scripted_trainable(scripts or {}, pause_s)):
        run_trials(job, listener or (lambda record: None))
    return store.read_trials()
