"""Whole sweeps with population based training and TPE: what they do to the trials that run."""

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from test_sweeps import FAST, assert_results_without_gaps, eventually

from analysis.records import ChangeRecord, TrialRecord
from policies.portable.file import read_policy
from tests.narrowing import present
from tune_jobs.spec.draws import draw_point
from tune_jobs.spec.file import load_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.outcome import SweepResult

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

# A step takes long enough for the trials to overlap.
SLOW = {"id": "TestTrouble-v0", "args": {"pause_s": 0.001}}
# The smallest learn nothing in the time there is, the largest do; 9 of 10 answers are right at most.
SPACE = {"lr": {"loguniform": [1e-6, 1e-2]}}


def launch(tmp_path: Path, **changes: Any) -> SweepResult:
    spec = {
        "env": SLOW,
        "algorithm": "ppo",
        "hyperparams": FAST,
        "space": SPACE,
        "stop": {"num_env_steps": 1_280},
        "evaluation": {"every_iterations": 2, "num_episodes": 5},
        "checkpoints": {"every_iterations": 4, "keep": 1},
    } | changes
    return sweeps.launch(spec, storage=tmp_path, name="mine", progress="none", finish=False)


# -- population based training

PBT = {"num_samples": 4, "scheduler": {"type": "pbt", "perturb_every_env_steps": 256}}


def assert_history_acts(store: SweepStore, trials: Sequence[TrialRecord]) -> None:
    """Each trial trained each iteration with the learning rate its record says it had, and says so in its policies."""
    for trial in trials:
        iterations = store.trial(trial.trial_id).read_iterations()
        assert_results_without_gaps(store, trial)
        for record in iterations:
            # The optimizer's own, after the iteration's updates.
            assert record.learner["lr"] == pytest.approx(trial.point_at(record.iteration)["lr"])
        for checkpoint in store.trial(trial.trial_id).checkpoints():
            training = read_policy(store.folder / checkpoint.path).training
            assert training["trial_id"] == trial.trial_id
            assert training["hyperparams"]["lr"] == pytest.approx(trial.point_at(checkpoint.iteration)["lr"])


@pytest.fixture(scope="module", params=["packed", "rllib"])
def population(
    request: pytest.FixtureRequest, ray_session: None, tmp_path_factory: pytest.TempPathFactory
) -> SweepResult:
    """A finished sweep; no test may change it."""
    # Checkpoints only where trials are compared, improve or end.
    checkpoints = {"every_iterations": 100, "keep": 1}
    result = launch(tmp_path_factory.mktemp("storage"), engine=request.param, checkpoints=checkpoints, **PBT)
    assert {trial.engine for trial in result.trials} == {request.param}
    return result


def test_a_mutated_learning_rate_is_the_one_in_the_trials_optimizer(population: SweepResult) -> None:
    store = SweepStore(population.folder)
    changed = [trial for trial in population.trials if trial.changes]
    assert changed
    assert population.exit_code == 0
    assert_history_acts(store, population.trials)
    for trial in changed:
        rates = {record.learner["lr"] for record in store.trial(trial.trial_id).read_iterations()}
        assert len(rates) > 1
        for change in trial.changes:
            assert change.source_trial_id != trial.trial_id
            assert change.before["lr"] != change.after["lr"]
            assert 1e-6 <= change.after["lr"] <= 1e-2


def test_all_trials_of_a_population_train_to_the_end_and_their_history_is_shown(population: SweepResult) -> None:
    from tune_jobs.cli.trials_table import show_trials

    trials = population.trials
    assert [trial.status for trial in trials] == ["completed"] * 4
    # By their own count, whosever weights they went on with.
    assert all(1_280 <= trial.num_env_steps < 1_280 + 132 for trial in trials)
    frame = sweeps.dataframe(population.folder)
    assert [bool(text) for text in frame["changes"].notna()] == [bool(trial.changes) for trial in trials]
    show_trials(trials, as_json=False)


def test_worse_trials_go_on_from_better_ones(population: SweepResult) -> None:
    """By what both had when they were compared, which is each time that they are evaluated here."""
    store = SweepStore(population.folder)
    assert any(trial.changes for trial in population.trials)
    for trial in population.trials:
        own = {record.iteration: record for record in store.trial(trial.trial_id).read_iterations()}
        for change in trial.changes:
            theirs = store.trial(change.source_trial_id).read_iterations()
            scores = [
                record.evaluation_return
                for record in theirs
                if record.iteration <= change.source_iteration and record.evaluation_return is not None
            ]
            # A checkpoint is of the evaluation that was compared, or of a better one; but at its end a trial saves
            # whatever it has, and may be copied from before it is compared there.
            compared = scores[-2:] if change.source_iteration == theirs[-1].iteration else scores[-1:]
            assert max(compared) > present(own[change.iteration].evaluation_return)


@pytest.mark.parametrize("engine", ["packed", "rllib"])
def test_a_population_that_is_stopped_goes_on_with_its_newest_values(
    ray_session: None, tmp_path: Path, engine: str
) -> None:
    store = SweepStore(tmp_path / "mine")

    def changes() -> list[ChangeRecord]:
        if not store.exists():
            return []
        return [change for trial in store.read_trials() for change in trial.changes]

    def stop() -> None:
        eventually(lambda: changes() and store.is_driven())
        sweeps.stop(tmp_path / "mine")

    thread = threading.Thread(target=stop)
    thread.start()
    result = launch(tmp_path, engine=engine, **PBT)
    thread.join()
    assert result.interrupted
    before = {trial.trial_id: trial.changes for trial in result.trials}
    assert any(before.values())
    result = sweeps.resume(tmp_path / "mine", progress="none", finish=False)
    assert [trial.status for trial in result.trials] == ["completed"] * 4
    assert all(trial.changes[: len(before[trial.trial_id])] == before[trial.trial_id] for trial in result.trials)
    assert_history_acts(store, result.trials)


# -- TPE

TPE = {"num_samples": 5, "search": {"type": "tpe", "num_startup_trials": 3}}


def most_at_once(trials: Sequence[TrialRecord]) -> int:
    spans = [(present(trial.started_at), present(trial.ended_at)) for trial in trials]
    return max(sum(start <= started < end for start, end in spans) for started, _ in spans)


def test_tpe_runs_as_many_trials_at_once_as_the_machine_allows_and_goes_on_when_extended(
    ray_session: None, tmp_path: Path
) -> None:
    pytest.importorskip("optuna")
    # In packs there are more at once; see test_packs.
    result = launch(tmp_path, **TPE, engine="rllib")
    assert [trial.status for trial in result.trials] == ["completed"] * 5
    assert most_at_once(result.trials) == 2
    spec = load_spec(result.sweep.spec)
    random = [draw_point(spec.space, index, 0) for index in range(7)]
    points = [trial.point for trial in result.trials]
    # Three, and with two at a time the fourth starts when two have ended.
    assert points[:4] == random[:4]
    assert points[4] != random[4]
    store = SweepStore(result.folder)
    for trial in result.trials:
        assert trial.has_point
        assert trial.hyperparams["lr"] == trial.point["lr"]
        last = store.trial(trial.trial_id).read_iterations()[-1]
        assert last.learner["lr"] == pytest.approx(trial.point["lr"])
    extended = sweeps.extend(result.folder, 2, progress="none", finish=False)
    assert [trial.point for trial in extended.trials[:5]] == points
    assert [trial.status for trial in extended.trials[5:]] == ["completed"] * 2
    assert all(
        trial.point and trial.point != point for trial, point in zip(extended.trials[5:], random[5:], strict=True)
    )


def test_tpe_and_asha_go_together_and_seeds_of_a_point_share_its_values(ray_session: None, tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    scheduler = {"type": "asha", "grace_env_steps": 256, "reduction_factor": 2}
    result = launch(tmp_path, **TPE, scheduler=scheduler, seeds_per_point=2)
    statuses = [trial.status for trial in result.trials]
    assert len(statuses) == 10
    assert set(statuses) == {"completed", "stopped"}
    for first, second in zip(result.trials[::2], result.trials[1::2], strict=True):
        assert first.point == second.point != {}
        assert first.hyperparams == second.hyperparams
        assert first.seed != second.seed
