"""Single trials of a population that is resumed are compared where they would have been, by what they had there."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from meeting_packs import PBT, Packs
from scripted_packs import make_sweep
from test_packed_as_single import FakedTune

from analysis.records import IterationRecord
from policies.errors import CheckpointError
from tune_jobs.ray_tune.population import Population, PopulationScheduler
from tune_jobs.ray_tune.processes import RayWatch
from tune_jobs.ray_tune.run_trials import RunJob, _Run
from tune_jobs.ray_tune.scheduling import CopyFrom, Decision, Standing
from tune_jobs.ray_tune.trainable import TrialTrainable
from tune_jobs.search.comparisons import comparisons_before

pytestmark = pytest.mark.ray
NAMES = [f"t{index:04d}" for index in range(6)]


class NobodyEnded:
    def wait(self) -> bool:
        return False

    def ended(self) -> tuple[str, ...]:
        return ()


@pytest.fixture
def judge(tmp_path: Path) -> Population:
    """Evaluations are 400 env steps apart and the interval is 250; t0005 has not come to its first comparison."""
    scheduler = {"type": "pbt", "perturb_every_env_steps": 250, "quantile_fraction": 0.2, "frequencies": [1, 2]}
    store = make_sweep(
        tmp_path / "mine", len(NAMES), scheduler=scheduler, stop={"num_env_steps": 4_000},
        evaluation={"every_iterations": 4, "num_episodes": 1},
    )  # fmt: skip
    for index, name in enumerate(NAMES):
        last = 3 if name == "t0005" else 10
        trial = store.trial(name)
        # At 400 env steps the last one of these is the best, at 800 the first.
        scores: dict[int, float] = {4: float(index), 8: 5.0 - index}
        iterations = [
            IterationRecord(
                iteration=at, num_env_steps=100 * at, num_episodes=at, time_s=1.0, evaluation_return=scores.get(at)
            )
            for at in range(1, last + 1)
        ]
        trial.append_iterations(iterations)
        known: dict[str, Any] = {
            "status": "paused", "num_iterations": last, "num_env_steps": 100 * last, "point": {"lr": 1e-3},
            "evaluation_return": scores[8] if last > 8 else None,
        }  # fmt: skip
        trial.write_record(trial.read_record().model_copy(update=known))
    job = RunJob(store.place, tuple(NAMES), cpus_per_trial=1, gpus_per_trial=0, max_concurrent=1)
    run = _Run(job, store, lambda _: None, store.take(), RayWatch({}, grace_s=1.0))
    found: Any = run._build_scheduler()
    run.keeper.close()
    population = found.scheduler
    assert isinstance(population, Population)
    for name in NAMES:
        population.begins(name)
    return population


def test_the_interval_counts_from_where_a_trial_was_compared(judge: Population) -> None:
    assert [judge.due_at(name) for name in NAMES] == [800 + 250] * 5 + [250]
    assert judge.reached(Standing("t0000", 1_040, 0.0, evaluated=True), NobodyEnded()) is Decision.GO_ON


def test_who_was_not_compared_yet_has_no_score_and_the_slower_select_when_they_would_have(judge: Population) -> None:
    # t0000, t0003 and t0004 are the faster ones; t0005 of the slower ones was never compared.
    assert [judge._members[name].score for name in NAMES] == [5.0, 4.0, 3.0, 2.0, 1.0, None]
    assert [judge._members[name].selected_from for name in NAMES] == [800] * 5 + [0]
    outcome = judge.reached(Standing("t0004", 1_200, 1.0, evaluated=True), NobodyEnded())
    assert isinstance(outcome, CopyFrom)
    assert outcome.trial_id == "t0000"


STEADY = {"t0000": 3.0, "t0001": 2.0, "t0002": 1.0, "t0003": 0.0}


def resumed_at_400(folder: Path) -> tuple[Packs, PopulationScheduler]:
    """Four trials that were compared and saved at 400 env steps; their scores are `STEADY` there and later."""
    packs = Packs(folder, 4, lambda trial_id, _: STEADY[trial_id], {**PBT, "perturb_every_env_steps": 200}, slots=2)
    packs.run(until=lambda: min(record.num_env_steps for record in packs.records()) >= 400)
    packs.begin()
    scheduler = PopulationScheduler(
        packs.spec, packs.store, packs.keeper.record, packs.keeper.change,
        before=comparisons_before(packs.store, packs.spec, packs.records()),
    )  # fmt: skip
    return packs, scheduler


def told_at_800(scheduler: PopulationScheduler) -> tuple[Any, str]:
    """What Tune is told of the worst trial, which is the first that is compared in this run."""
    tune: Any = FakedTune(list(STEADY))
    for trial in tune.trials:
        scheduler.on_trial_add(tune, trial)
    worst = tune.trials[-1]
    told = {
        "num_env_steps": 800, "score": STEADY["t0003"], "evaluated": True,
        "progress": SimpleNamespace(report=SimpleNamespace(num_iterations=8)),
    }  # fmt: skip
    answer = scheduler.on_trial_result(tune, worst, told)
    return worst.run_metadata.checkpoint_manager._latest_checkpoint_result, answer


def test_a_trial_goes_on_from_one_that_has_saved_nothing_since_the_sweep_was_resumed(tmp_path: Path) -> None:
    packs, scheduler = resumed_at_400(tmp_path)
    num_known, latest = len(packs.changes()["t0003"]), packs.store.trial("t0000").checkpoints()[-1].iteration
    assert latest >= 4
    pointer, answer = told_at_800(scheduler)
    packs.keeper.close()
    assert answer == "NOOP"
    change = packs.changes()["t0003"][num_known]
    assert (change.source_trial_id, change.source_iteration, change.num_env_steps) == ("t0000", latest, 800)
    assert packs.store.trial("t0003").copied_checkpoint(8).is_dir()
    # Its own checkpoints are those of before the copy.
    with pytest.raises(CheckpointError, match="t0003 saved no checkpoint when it was compared last"):
        scheduler._pointer("t0003")
    # Tune gives it to the process of the worst trial, which goes on from what was copied.
    trainable = TrialTrainable.__new__(TrialTrainable)
    trainable._trial, trainable._loop, trainable._local_ip = (packs.store.place, "t0003"), None, "127.0.0.1"
    trainable.restore(pickle.loads(pickle.dumps(pointer)))
    assert json.loads(pointer.metrics["pointer.json"])["trial_id"] == "t0000"


def test_a_trial_goes_on_as_it_is_where_the_better_one_has_no_checkpoint(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    packs, scheduler = resumed_at_400(tmp_path)
    known, source = packs.changes(), packs.store.trial("t0000")
    for iteration in source.checkpoint_iterations():
        shutil.rmtree(source.checkpoint_folder(iteration))
    pointer, answer = told_at_800(scheduler)
    packs.keeper.close()
    assert pointer is None
    assert answer in ("CONTINUE", "PAUSE")
    assert "t0003 goes on as it is: Trial t0000 has no checkpoint yet." in caplog.text
    assert packs.changes() == known


def test_a_save_of_this_run_that_gave_nothing_is_not_replaced_by_an_older_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    packs, scheduler = resumed_at_400(tmp_path)
    scheduler._saved["t0000"] = None
    pointer, answer = told_at_800(scheduler)
    packs.keeper.close()
    assert pointer is None
    assert answer in ("CONTINUE", "PAUSE")
    assert "t0003 goes on as it is: Trial t0000 saved no checkpoint when it was compared last." in caplog.text
