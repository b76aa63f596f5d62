"""`launch` trains its leading settings again by itself, once, and the same whatever interrupts it."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from test_sweeps import launch, make_spec, snapshot

from tests.narrowing import present
from tune_jobs.store.names import SWEEP_RECORD
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude, drive, stages
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.interrupted import SweepInterrupted
from tune_jobs.sweeps.outcome import SweepResult

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


@pytest.fixture(autouse=True)
def short_report() -> Iterator[None]:
    """A page without the figures, which take longer than the trials and are tested elsewhere."""

    def write(store: SweepStore, _: object) -> Path:
        page = store.report_folder / "index.html"
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text("a report")
        return page

    with mock.patch.object(conclude, "make_report", write):
        yield


def spec(**changes: Any) -> dict[str, Any]:
    """Six learning rates, of which three cannot learn."""
    space = {"lr": {"grid": [1e-2, 5e-3, 2e-3, 1e-6, 1e-7, 1e-8]}}
    return make_spec(space=space, num_samples=1, stop={"num_env_steps": 640}, engine="packed") | changes


def added(result: SweepResult) -> list[tuple[str, int]]:
    return [(item.by, len(item.points)) for item in result.sweep.replications]


def shown(result: SweepResult) -> dict[str, bytes]:
    """All files of a sweep but its logs, and the one that says which run owns it."""
    files = snapshot(result.folder)
    return {name: data for name, data in files.items() if name != ".owner" and not name.startswith("logs/")}


def told(result: SweepResult) -> list[tuple[int, int, int, float | None]]:
    return [(t.index, t.point_index, t.seed, t.evaluation_return) for t in result.trials]


def test_launch_gives_the_leading_settings_more_seeds_within_half_of_its_env_steps(tmp_path: Path) -> None:
    result = launch(tmp_path, spec(), finish=True)
    # Half of six trainings: three settings, a seed each.
    assert added(result) == [("confirm", 3)]
    assert (
        sum(trial.num_env_steps for trial in result.trials[6:]) <= sum(t.num_env_steps for t in result.trials[:6]) / 2
    )
    assert [trial.seed_index for trial in result.trials[6:]] == [1, 1, 1]
    settings = present(present(result.best).settings)
    assert len(settings.best.scores) == 2
    assert settings.best.point_index in result.sweep.replications[0].points
    # It has ended with that: nothing is run or written again.
    before = shown(result)
    again = sweeps.resume(result.folder, progress="none")
    assert told(again) == told(result)
    assert shown(again) == before


def test_an_interrupted_race_goes_on_as_it_would_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = spec(confirm={"top": 3, "seeds": 3, "max_share": 3})
    whole = launch(tmp_path, wanted, name="whole", finish=True)
    assert [by for by, _ in added(whole)] == ["confirm", "confirm"]
    run, num_stages = drive.run_trials_of, 0

    def interrupted(*args: Any, **settings: Any) -> SweepResult:
        nonlocal num_stages
        num_stages += 1
        if num_stages == 2:
            raise KeyboardInterrupt
        return run(*args, **settings)

    monkeypatch.setattr(stages, "run_trials_of", interrupted)
    with pytest.raises(SweepInterrupted):
        launch(tmp_path, wanted, name="cut", finish=True)
    monkeypatch.undo()
    cut = sweeps.resume("cut", storage=tmp_path, progress="none")
    assert cut.sweep.replications == whole.sweep.replications
    assert told(cut) == told(whole)
    assert present(cut.best).settings == present(whole.best).settings


def test_it_is_left_out_where_it_is_off_or_somebody_replicates(tmp_path: Path) -> None:
    off = launch(tmp_path, spec(confirm="none"), name="off", finish=True)
    assert added(off) == []
    launch(tmp_path, spec(), name="mine")
    result = sweeps.replicate("mine", top=2, seeds=1, storage=tmp_path, progress="none")
    assert added(result) == [("replicate", 2)]


def test_more_samples_are_confirmed_anew_and_old_sweeps_are_left_alone(tmp_path: Path) -> None:
    drawn = spec(space={"lr": {"loguniform": [1e-3, 1e-2]}}, num_samples=4)
    first = launch(tmp_path, drawn, finish=True)
    assert added(first) == [("confirm", 2)]
    second = sweeps.extend("mine", 4, storage=tmp_path, progress="none")
    # Half of eight trainings, two of which are spent.
    assert added(second) == [("confirm", 2), ("confirm", 2)]
    assert [trial.index for trial in second.trials] == list(range(12))

    old = launch(tmp_path, spec(), name="old")
    path = old.folder / SWEEP_RECORD
    record = json.loads(path.read_text())
    del record["spec"]["confirm"]
    path.write_text(json.dumps(record))
    assert len(sweeps.resume("old", storage=tmp_path, progress="none").trials) == 6
