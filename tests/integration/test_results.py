"""What a sweep came to, read from its folder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from synthetic_sweep import Synthetic, make_sweep

import tune_jobs
from tests.narrowing import present
from tune_jobs.store.sweep_store import SweepStore


@pytest.fixture
def make_store(tmp_path: Path) -> Callable[..., tuple[SweepStore, Synthetic]]:
    def make(**given: Any) -> tuple[SweepStore, Synthetic]:
        synthetic = make_sweep(**given)
        store = SweepStore(tmp_path / synthetic.sweep.name)
        store.create()
        for trial in synthetic.trials:
            # The table takes its checkpoints from the disk, and there are none.
            store.trial(trial.trial_id).write_record(trial)
            store.trial(trial.trial_id).keep_iterations(synthetic.results[trial.trial_id])
        store.write_record(synthetic.sweep)
        return store, synthetic

    return make


@pytest.mark.parametrize("chosen", [True, False], ids=["with a best", "before a best is chosen"])
def test_the_table_says_when_trials_solved_the_env_as_the_report_does(
    make_store: Callable[..., tuple[SweepStore, Synthetic]], tmp_path: Path, chosen: bool
) -> None:
    store, synthetic = make_store()
    if chosen:
        store.write_best(present(synthetic.best))
    table = tune_jobs.dataframe(store.name, storage=tmp_path)
    solved = table["num_env_steps_to_solve"]
    assert 0 < solved.notna().sum() < len(solved)
    for trial_id, steps in zip(table["trial_id"], solved, strict=True):
        reached = [
            item.num_env_steps
            for item in synthetic.results[trial_id]
            if item.num_episodes >= 100 and item.training_return is not None and item.training_return >= 195
        ]
        assert (reached[0] if reached else None) == (None if pd.isna(steps) else steps)
    if chosen:
        report = tune_jobs.report(store.name, storage=tmp_path)
        written = pd.read_csv(report.parent / "trials.csv")
        assert list(written["num_env_steps_to_solve"].astype("Int64")) == list(solved)


def test_without_a_threshold_the_stop_rules_return_counts(
    make_store: Callable[..., tuple[SweepStore, Synthetic]], tmp_path: Path
) -> None:
    store, synthetic = make_store(env_id="Mine-v0", with_best=False)
    store.write_record(synthetic.sweep.model_copy(update={"spec": {**synthetic.sweep.spec, "stop": {}}}))
    assert tune_jobs.dataframe(store.folder)["num_env_steps_to_solve"].isna().all()
    stop = {"training_return": 195}
    store.write_record(synthetic.sweep.model_copy(update={"spec": {**synthetic.sweep.spec, "stop": stop}}))
    assert tune_jobs.dataframe(store.folder)["num_env_steps_to_solve"].notna().any()


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        (None, "random-CartPole-v1"),
        ("there", "there/random-CartPole-v1"),
        (Path("there"), "there/random-CartPole-v1"),
        ("new/", "new/random-CartPole-v1"),
        ("film", "film"),
        ("film.mp4", "film"),
        ("film.GIF", "film"),
        ("cartpole-v0.5", "cartpole-v0.5"),
        ("new/film.gif", "new/film"),
    ],
)
def test_a_film_goes_where_output_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str | Path | None, expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there").mkdir()
    asked: list[Path] = []

    def film(policy: object, path: Path, *more: object) -> dict[str, Path]:
        asked.append(path)
        return {}

    monkeypatch.setattr("tune_jobs.sweeps.conclude.make_video", film)
    tune_jobs.video("random", env_id="CartPole-v1", output=output)
    # Either ending gives both files.
    assert [path.with_suffix("") for path in asked] == [Path(expected)]
