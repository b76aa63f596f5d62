"""What the search method of a whole sweep is told of the rungs that its points passed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from test_search import SPACE, launch

from analysis.records import TrialRecord
from tune_jobs.search import history
from tune_jobs.search.rungs import Passed, passed
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.sweep_store import SweepStore

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]
Told = list[tuple[str, tuple[Passed, ...]]]


def noted(monkeypatch: pytest.MonkeyPatch) -> Told:
    """What is told of each point of one seed from now on, by its trial."""
    told: Told = []

    def note(spec: SweepSpec, members: Sequence[TrialRecord], curves: Mapping[str, Any]) -> tuple[Passed, ...]:
        found = passed(spec, members, curves)
        told.append((members[0].trial_id, found))
        return found

    monkeypatch.setattr(history, "passed", note)
    return told


@pytest.mark.parametrize("engine", ["packed", "rllib"])
def test_of_each_trial_that_ended_its_evaluations_at_the_rungs_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: str
) -> None:
    told = noted(monkeypatch)
    result = launch(
        tmp_path, env="TestTrouble-v0", engine=engine, space=SPACE, num_samples=16,
        search={"type": "gp", "num_startup_trials": 2}, evaluation={"every_iterations": 1, "num_episodes": 5},
        scheduler={"type": "asha", "grace_env_steps": 256, "reduction_factor": 2},
    )  # fmt: skip
    store = SweepStore(result.folder)
    trials = {trial.trial_id: trial for trial in store.read_trials()}
    assert len({name for name, _ in told}) == len(told) > 2
    assert {trials[name].status for name, _ in told} == {"completed", "stopped"}
    for name, rungs in told:
        curve = [
            (one.num_env_steps, one.evaluation_return)
            for one in store.trial(name).read_iterations()
            if one.evaluation_return is not None
        ]
        first = [
            next((steps for steps, _ in curve if steps >= rung and steps < trials[name].num_env_steps), None)
            for rung in (256, 512, 1_024)
        ]
        due = [steps for steps in first if steps is not None]
        expected = [(steps / 1_280, max(value for at, value in curve if at <= steps)) for steps in due]
        assert [rung.trained for rung in rungs] == pytest.approx([trained for trained, _ in expected])
        assert [rung.score for rung in rungs] == pytest.approx([score for _, score in expected])
    assert any(rungs for _, rungs in told)


@pytest.mark.parametrize(
    "changes",
    [{"search": {"type": "gp", "num_startup_trials": 2}}, {"scheduler": "asha"}],
    ids=["no rungs", "no model"],
)
def test_without_a_scheduler_or_a_model_no_curves_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]
) -> None:
    told = noted(monkeypatch)
    launch(tmp_path, env="TestTrouble-v0", space=SPACE, num_samples=16, **changes)
    assert told == []
