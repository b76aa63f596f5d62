"""What pb2's model is made of where some trials have ended, in this run or before the sweep was resumed."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from meeting_packs import PBT, Packs, random_scores
from scripted_packs import make_sweep

from analysis.records import ChangeRecord, IterationRecord
from tune_jobs.ray_tune import population
from tune_jobs.ray_tune.population import Population, PopulationScheduler
from tune_jobs.ray_tune.processes import RayWatch
from tune_jobs.ray_tune.run_trials import RunJob, _Run
from tune_jobs.ray_tune.scheduling import Standing
from tune_jobs.search.bandit import Gain, Next
from tune_jobs.search.gains import Evaluations
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.sweep_store import SweepStore

pytestmark = pytest.mark.ray

NAMES = [f"t{index:04d}" for index in range(8)]
POINTS = {name: {"lr": (index + 1) * 1e-3} for index, name in enumerate(NAMES)}
ENDED = NAMES[-1]
CHANGED = {"lr": 9.5e-3}
"""With what t0000 went on from a copy of the trial that has ended since."""


@dataclass(frozen=True)
class Others:
    names: Collection[str] = ()

    def wait(self) -> bool:
        return False

    def ended(self) -> Collection[str]:
        return self.names


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    """Eight trials of six intervals, but t0007, which has reached its goal after four."""
    scheduler = {"type": "pb2", "perturb_every_env_steps": 100, "quantile_fraction": 0.125}
    store = make_sweep(tmp_path / "mine", len(NAMES), scheduler=scheduler, evaluation={"every_iterations": 1})
    copied = ChangeRecord(
        iteration=3, num_env_steps=300, source_trial_id=ENDED, source_iteration=3, before=POINTS["t0000"],
        after=CHANGED, time=0.0,
    )  # fmt: skip
    for name in NAMES:
        trial, has_ended = store.trial(name), name == ENDED
        scores = [20.0 * at for at in range(1, 7)]
        if has_ended:
            scores = [100.0, 300.0, 400.0, 480.0]
        elif name == "t0000":
            scores[3:] = [395.0, 390.0, 390.0]
        for at, score in enumerate(scores, start=1):
            told = IterationRecord(
                iteration=at, num_env_steps=100 * at, num_episodes=at, time_s=1.0, evaluation_return=score
            )
            trial.append_iterations([told])
        known = {
            "point": CHANGED if name == "t0000" else POINTS[name],
            "changes": (copied,) if name == "t0000" else (),
            "num_iterations": len(scores), "num_env_steps": 100 * len(scores), "evaluation_return": scores[-1],
            "status": "completed" if has_ended else "paused",
        }  # fmt: skip
        trial.write_record(trial.read_record().model_copy(update=known))
    return store


def asked_at_700(
    judge: Population, ended: Collection[str], monkeypatch: pytest.MonkeyPatch
) -> tuple[Next, Sequence[Gain]]:
    """What the model is told when t0000 is the worst of all at 700 env steps."""
    asked: list[tuple[Next, Sequence[Gain]]] = []

    def propose(coming: Next, _: Any, gains: Sequence[Gain], *__: Any) -> dict[str, Any]:
        asked.append((coming, gains))
        return {"lr": 5e-3}

    monkeypatch.setattr(population, "propose", propose)
    standings = [Standing(name, 700, float(at), evaluated=True) for at, name in enumerate(NAMES) if name != ENDED]
    judge.compared(standings, Others(ended))
    (found,) = asked
    return found


def of_one_run(store: SweepStore) -> Population:
    """The population of a sweep that was not interrupted."""
    read = {record.trial_id: record for record in store.read_trials()}
    judge = Population(stored_spec(store.read_record()), read.__getitem__, Evaluations(store))
    for name in NAMES:
        judge.begins(name)
    return judge


def test_a_resumed_sweep_knows_the_intervals_of_trials_that_had_ended(
    store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = asked_at_700(of_one_run(store), {ENDED}, monkeypatch)
    todo = tuple(name for name in NAMES if name != ENDED)
    job = RunJob(store.place, todo, cpus_per_trial=1, gpus_per_trial=0, max_concurrent=1)
    run = _Run(job, store, lambda _: None, store.take(), RayWatch({}, grace_s=1.0))
    scheduler = run._build_scheduler()
    assert isinstance(scheduler, PopulationScheduler)
    judge = scheduler.scheduler
    assert isinstance(judge, Population)
    for name in todo:
        judge.begins(name)
    found = asked_at_700(judge, (), monkeypatch)
    run.keeper.close()
    assert found == expected
    _, gains = found
    assert [one.gain for one in gains if one.point == POINTS[ENDED]] == [200.0, 100.0, 80.0]
    # From the copied score on, and not from its own before the copy.
    assert [one.gain for one in gains if one.point == CHANGED] == [-5.0, -5.0, 0.0]


def test_trials_that_have_ended_train_nothing_meanwhile(store: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    coming, _ = asked_at_700(of_one_run(store), {ENDED}, monkeypatch)
    assert list(coming.meanwhile) == [POINTS[name] for name in NAMES[1:-1]]


def test_packs_that_are_resumed_choose_what_they_would_have_chosen(tmp_path: Path) -> None:
    """Two trials reach the goal, after others have gone on from copies of one of them."""
    usual = random_scores(1, 50)

    def score(trial_id: str, iteration: int) -> float:
        if trial_id in ("t0006", "t0007"):
            return 60.0 if iteration < 8 else 100.0
        return usual(trial_id, iteration)

    def packs(name: str) -> Packs:
        stop = {"num_env_steps": 2_000, "evaluation_return": 99.0}
        return Packs(tmp_path / name, 8, score, {**PBT, "type": "pb2"}, stop=stop)

    expected = packs("one run").run()
    resumed = packs("two runs")
    resumed.run(until=lambda: min(one.num_env_steps for one in resumed.records() if one.status != "completed") >= 1_000)
    assert [one.trial_id for one in resumed.records() if one.status == "completed"] == ["t0006", "t0007"]
    resumed.begin()
    resumed.run()
    assert resumed.changes() == expected.changes()
    changes = [change for each in expected.changes().values() for change in each]
    assert {change.source_trial_id for change in changes if change.num_env_steps == 400} == {"t0006", "t0007"}
    assert any(change.num_env_steps > 1_000 for change in changes)
