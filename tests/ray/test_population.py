"""Who of a population goes on from whom, as Ray Tune is told: no process, no training, scores that are drawn."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np
import pytest

from analysis.records import TrialRecord
from policies.errors import CheckpointError
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

if TYPE_CHECKING:
    from tune_jobs.ray_tune.population import PopulationScheduler

pytestmark = pytest.mark.ray

RECORDED = Path(__file__).parent / "samples" / "population_decisions.json"
"""What was decided when Ray Tune's own population based training did, by the same draws."""
MAX_ENV_STEPS = 1_600
Read = Callable[[str], TrialRecord]
Become = Callable[[TrialRecord], TrialRecord]
Change = Callable[[str, Become], None]
Make = Callable[[SweepSpec, Any, Read, Change], "PopulationScheduler"]


class Trial:
    """What is asked of a trial of Tune's."""

    def __init__(self, number: int) -> None:
        self.config = {"trial_id": f"t{number:04d}"}
        self.trial_id, self.experiment_tag, self.status = f"tune-{number}", str(number), "RUNNING"
        manager = SimpleNamespace(checkpoint_config=SimpleNamespace(num_to_keep=None), _latest_checkpoint_result=None)
        self.run_metadata = SimpleNamespace(checkpoint_manager=manager)

    def is_finished(self) -> bool:
        return self.status in ("TERMINATED", "ERROR")

    def set_experiment_tag(self, tag: str) -> None:
        pass

    def set_config(self, config: dict[str, str]) -> None:
        assert config == self.config


class Saved:
    """What a save will have given; one in five gives nothing."""

    def __init__(self, checkpoint: str | None = None, metrics: dict[str, Any] | None = None) -> None:
        self.checkpoint, self.metrics = checkpoint, metrics


class Future:
    def __init__(self, number: int, saved: Saved | None) -> None:
        self.number, self.saved = number, saved

    def resolve(self) -> Saved | None:
        return self.saved


class Controller:
    """What is asked of Tune's controller. No process takes any time to start."""

    search_alg = None
    _trial_to_actor = MappingProxyType[Any, Any]({})

    def __init__(self, trials: Sequence[Trial], rng: np.random.Generator) -> None:
        self.trials, self.rng = trials, rng
        self.saves: list[str] = []

    def get_trials(self) -> list[Trial]:
        return list(self.trials)

    def get_live_trials(self) -> list[Trial]:
        return [trial for trial in self.trials if not trial.is_finished()]

    def pause_trial(self, trial: Trial, should_checkpoint: bool) -> None:
        assert should_checkpoint is False
        trial.status = "PAUSED"

    def _schedule_trial_save(self, trial: Trial, result: dict[str, Any]) -> Future | None:
        self.saves.append(trial.config["trial_id"])
        number = len(self.saves)
        draw = self.rng.random()
        if draw < 0.05:
            return None
        return Future(number, None if draw < 0.2 else Saved(f"checkpoint {number}", {}))


def simulated(seed: int, make: Make) -> list[list[Any]]:
    """Everything that is decided in a random sweep, as JSON.

    Args:
        seed: Of the draws.
        make: Spec, store, read and change -> the scheduler.
    """
    rng = np.random.default_rng(seed)
    num_trials = int(rng.integers(2, 9))
    spec = load_spec(
        {
            "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-4, 1e-2]}},
            "num_samples": num_trials, "seed": seed, "stop": {"num_env_steps": MAX_ENV_STEPS},
            "scheduler": {
                "type": "pbt", "perturb_every_env_steps": int(rng.choice([100, 300, 500])),
                "quantile_fraction": float(rng.choice([0.2, 0.25, 0.5])),
            },
        }
    )  # fmt: skip
    records = {
        f"t{index:04d}": TrialRecord(
            trial_id=f"t{index:04d}", index=index, point_index=index, seed=1024 * index,
            point={"lr": 1e-3 + index * 1e-4},
            # Some are resumed half-way, with or without a score.
            num_env_steps=int(rng.choice([0, 0, 200, 450])),
            evaluation_return=None if rng.random() < 0.3 else float(rng.integers(0, 5)),
        )
        for index in range(num_trials)
    }  # fmt: skip

    def change(trial_id: str, become: Become) -> None:
        records[trial_id] = become(records[trial_id])

    def copy(source: SimpleNamespace, target: SimpleNamespace, iteration: int) -> SimpleNamespace:
        if rng.random() < 0.1:
            raise CheckpointError("It is damaged.")
        return SimpleNamespace(iteration=iteration)

    trials = [Trial(number) for number in range(num_trials)]
    controller, steps, found = Controller(trials, rng), {}, []
    # None has a checkpoint of before.
    store = SimpleNamespace(trial=lambda trial_id: SimpleNamespace(trial_id=trial_id, checkpoint_iterations=tuple))
    with mock.patch("tune_jobs.ray_tune.population.copy_latest_checkpoint", copy):
        judge = make(spec, store, records.__getitem__, change)
        for trial in trials:
            judge.on_trial_add(controller, trial)
            steps[trial] = records[trial.config["trial_id"]].num_env_steps
        for report in range(60):
            live = controller.get_live_trials()
            if not live:
                break
            trial = live[int(rng.integers(len(live)))]
            name = trial.config["trial_id"]
            trial.status = "RUNNING"
            steps[trial] += int(rng.choice([100, 200, 300]))
            score = -1e300 if rng.random() < 0.1 else float(rng.integers(0, 6))
            over = steps[trial] >= MAX_ENV_STEPS
            told = {
                "num_env_steps": steps[trial], "score": score, "evaluated": bool(rng.random() < 0.8),
                "progress": SimpleNamespace(report=SimpleNamespace(num_iterations=report)),
            }  # fmt: skip
            num_saves, num_changes = len(controller.saves), len(records[name].changes)
            decision = "STOP" if over else judge.on_trial_result(controller, trial, told)
            if over:
                judge.on_trial_complete(controller, trial, told)
                trial.status = "TERMINATED"
            elif decision == "PAUSE":
                trial.status = "PAUSED"
            pointer = trial.run_metadata.checkpoint_manager._latest_checkpoint_result
            copied = records[name].changes[num_changes:]
            found.append(
                [
                    name, decision, controller.saves[num_saves:],
                    [[one.source_trial_id, one.iteration, one.num_env_steps, one.after["lr"]] for one in copied],
                    None if pointer is None else pointer.checkpoint,
                ]
            )  # fmt: skip
            # Which one has a place next, in Tune's words.
            chosen = judge.choose_trial_to_run(controller)
            found[-1].append(None if chosen is None else chosen.config["trial_id"])
    return found


def made(spec: SweepSpec, store: Any, read: Read, change: Change) -> PopulationScheduler:
    from tune_jobs.ray_tune.population import PopulationScheduler

    return PopulationScheduler(spec, store, read, change)


def test_a_population_is_judged_as_by_rays_own_population_based_training() -> None:
    recorded = json.loads(RECORDED.read_text())
    assert len(recorded) == 15
    copies = 0
    for seed, expected in enumerate(recorded):
        found = simulated(seed, made)
        assert found == expected, seed
        copies += sum(len(one[3]) for one in found)
    assert copies > 30
