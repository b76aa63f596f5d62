"""Replication: leading settings get fresh seeds, in rounds, and nothing else changes."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from test_sweeps import launch, make_spec, snapshot

from analysis.numbering import place_of
from policies.envs import modules as env_modules
from policies.errors import NotFoundError, SpecError
from tests.narrowing import present
from tune_jobs.spec.seeds import trial_seeds
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.outcome import SweepResult

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


def replicate(tmp_path: Path, **options: Any) -> SweepResult:
    keywords: dict[str, Any] = {"finish": False, "progress": "none"} | options
    return sweeps.replicate("mine", storage=tmp_path, **keywords)


def spec(**changes: Any) -> dict[str, Any]:
    """Four learning rates, of which two cannot learn."""
    space = {"lr": {"grid": [1e-2, 5e-3, 1e-7, 1e-8]}}
    return make_spec(space=space, num_samples=1, stop={"num_env_steps": 1_280}, confirm="none") | changes


@pytest.mark.parametrize(("engine", "scheduler"), [("rllib", "hyperband"), ("packed", "asha")])
def test_leading_settings_get_fresh_seeds_and_train_to_the_end(tmp_path: Path, engine: str, scheduler: str) -> None:
    given = spec(engine=engine, scheduler={"type": scheduler, "grace_env_steps": 256})
    before = launch(tmp_path, given)
    folders = {trial.trial_id: snapshot(before.folder / "trials" / trial.trial_id) for trial in before.trials}
    result = replicate(tmp_path, top=3, seeds=3)
    # The earlier trials are as they were, to the byte.
    assert {name: snapshot(result.folder / "trials" / name) for name in folders} == folders
    new = result.trials[4:]
    record = result.sweep
    # Three contenders get a seed, the better two of them two more, unless it is clear by then.
    assert [len(item.points) for item in record.replications] in ([3], [3, 4])
    assert record.num_trials == len(result.trials) == 4 + sum(len(item.points) for item in record.replications)
    for trial in new:
        assert (trial.point_index, trial.seed_index) == place_of(trial.index, 1, record.replications)
        twin = before.trials[trial.point_index]
        assert (trial.point, trial.hyperparams, trial.engine) == (twin.point, twin.hyperparams, twin.engine)
        assert trial.seed != twin.seed
        # No scheduler ends them.
        assert (trial.status, trial.num_env_steps) == ("completed", 1_280)
    assert len({trial.seed for trial in result.trials}) == len(result.trials)


def test_the_better_setting_is_named_with_its_seeds(tmp_path: Path) -> None:
    before = present(launch(tmp_path, spec(), finish=True).best)
    assert all(len(item.scores) == 1 for item in present(before.settings).ranking)
    result = replicate(tmp_path, top=2, seeds=2, finish=True)
    settings = present(present(result.best).settings)
    assert settings.best.point["lr"] >= 5e-3
    assert len(settings.best.trial_ids) == 3
    assert present(settings.best.lower) <= settings.best.score <= present(settings.best.upper)
    # What is named stands in the file too.
    assert SweepStore(result.folder).read_best().settings == settings


def test_missing_seeds_are_trained_by_resume_and_extended_points_come_behind(tmp_path: Path) -> None:
    launch(tmp_path, make_spec())
    whole = replicate(tmp_path, top=2, seeds=1)
    lost = whole.trials[-1]
    # As if the process had been killed after it had written what the round was to be.
    shutil.rmtree(whole.folder / "trials" / lost.trial_id)
    result = sweeps.resume("mine", storage=tmp_path, finish=False, progress="none")
    again = result.trials[-1]
    assert (again.trial_id, again.seed, again.point, again.status) == (
        lost.trial_id, lost.seed, lost.point, "completed"
    )  # fmt: skip
    assert again.training_return == lost.training_return
    assert (result.sweep.num_trials, result.sweep.state) == (4, "completed")
    longer = sweeps.extend("mine", 1, storage=tmp_path, finish=False, progress="none")
    assert longer.trials[:4] == result.trials
    seeds = [(index, 1) for index in result.sweep.replications[0].points]
    assert [(trial.point_index, trial.seed_index) for trial in longer.trials] == [(0, 0), (1, 0), *seeds, (2, 0)]
    assert all(trial.status == "completed" for trial in longer.trials)


def test_points_that_tpe_chose_are_trained_again(tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    given = make_spec(
        search={"type": "tpe", "num_startup_trials": 2}, space={"lr": {"loguniform": [1e-3, 1e-2]}}, num_samples=4
    )
    launch(tmp_path, given)
    result = replicate(tmp_path, top=2, seeds=1)
    assert len(result.trials) == 6
    for trial in result.trials[4:]:
        assert trial.point == result.trials[trial.point_index].point
        assert trial.hyperparams == result.trials[trial.point_index].hyperparams
        assert trial.status == "completed"


def test_the_modules_of_the_sweep_are_allowed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", {"tune_jobs_test_envs"})
    launch(tmp_path, make_spec(env={"id": "tune_jobs_test_envs:Trouble"}))
    monkeypatch.setattr(env_modules, "_allowed", set())
    # So many that they cannot be planned, or be listed one by one.
    with pytest.raises(SpecError, match="up to 2,000,000,000,000 trainings"):
        replicate(tmp_path, top=2, seeds=10**12)
    result = replicate(tmp_path, top=2, seeds=1)
    assert [trial.status for trial in result.trials] == ["completed"] * 4


def test_what_cannot_be_replicated_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError):
        replicate(tmp_path)
    sweeps.create(
        make_spec(scheduler={"type": "pbt", "perturb_every_env_steps": 256}, num_samples=4),
        name="mine",
        storage=tmp_path,
    )
    with pytest.raises(SpecError, match="population based training"):
        replicate(tmp_path)


def test_one_setting_has_none_to_race_with(tmp_path: Path) -> None:
    launch(tmp_path, make_spec(num_samples=1))
    with pytest.raises(SpecError, match="one setting that was trained"):
        replicate(tmp_path)
    assert SweepStore(tmp_path / "mine").read_record().replications == ()


def test_a_sweep_whose_trials_all_failed_has_nothing_to_replicate(tmp_path: Path) -> None:
    troubles = {str(seed): {"how": "raise"} for seed in trial_seeds(0, 2)}
    launch(tmp_path, make_spec(env={"id": "TestTrouble-v0", "args": {"troubles": troubles}}, max_retries=0))
    with pytest.raises(NotFoundError, match="none of its trials was evaluated"):
        replicate(tmp_path)
