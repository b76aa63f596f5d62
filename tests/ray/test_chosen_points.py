"""Points that somebody chose, in whole sweeps: their values act, and the search goes on as it would, and learns."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from test_sweeps import assert_results_without_gaps, launch, make_spec, snapshot

from analysis.records import PriorRecord, TrialRecord
from tests.narrowing import present
from tune_jobs.ray_tune import searcher
from tune_jobs.search.asking import Check
from tune_jobs.search.history import History
from tune_jobs.search.proposal import propose_point
from tune_jobs.spec.draws import draw_point
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.outcome import SweepResult

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


def inject(tmp_path: Path, **point: Any) -> SweepResult:
    return sweeps.inject("mine", point, storage=tmp_path, finish=False, progress="none")


@pytest.mark.parametrize("engine", ["packed", "rllib"])
def test_its_values_act_in_each_of_its_seeds_and_the_others_stay_as_they_are(tmp_path: Path, engine: str) -> None:
    before = launch(tmp_path, make_spec(engine=engine, seeds_per_point=2))
    folders = {trial.trial_id: snapshot(before.folder / "trials" / trial.trial_id) for trial in before.trials}
    result = inject(tmp_path, lr=0.03)
    assert {name: snapshot(result.folder / "trials" / name) for name in folders} == folders
    store = SweepStore(result.folder)
    new = result.trials[4:]
    assert [(trial.point_index, trial.seed_index, trial.status) for trial in new] == [
        (2, 0, "completed"), (2, 1, "completed")
    ]  # fmt: skip
    for trial in new:
        assert trial.engine == engine
        # The optimizer's own, after each iteration's updates; it lies outside of the space.
        rates = [item.learner["lr"] for item in store.trial(trial.trial_id).read_iterations()]
        assert rates == pytest.approx([0.03] * trial.num_iterations)
        assert_results_without_gaps(store, trial)
    assert len({trial.seed for trial in result.trials}) == 6
    assert result.sweep.state == "completed"


def test_it_is_chosen_if_it_is_the_best_and_confirmed(tmp_path: Path) -> None:
    # Only the point that is injected can learn.
    launch(tmp_path, make_spec(space={"lr": {"grid": [1e-7, 1e-8]}}, num_samples=1, stop={"num_env_steps": 2_560}))
    result = sweeps.inject("mine", {"lr": 1e-2}, storage=tmp_path, progress="none")
    best = present(result.best)
    assert (best.checkpoint.trial_id, best.point) == ("t0002", {"lr": 0.01})
    assert present(best.settings).best.point == {"lr": 0.01}
    assert Path(result.artifacts["report"]).is_file()


def test_tpe_goes_on_behind_it_with_its_own_draws_and_is_told_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna")
    given = make_spec(
        search={"type": "tpe", "num_startup_trials": 4}, space={"lr": {"loguniform": [1e-3, 1e-2]}}, num_samples=5,
        resources={"max_concurrent": 1},
    )  # fmt: skip
    spec = load_spec(given)
    told: list[tuple[int, list[str]]] = []

    def watched(
        spec: SweepSpec, records: Sequence[TrialRecord], drawn_index: int, check: Check, prior: Sequence[PriorRecord],
        *, history: History,
    ) -> dict[str, Any]:  # fmt: skip
        told.append((drawn_index, [record.trial_id for record in records if record.status == "completed"]))
        return propose_point(spec, records, drawn_index, check, prior, history=history)

    monkeypatch.setattr(searcher, "propose_point", watched)
    launch(tmp_path, given)
    inject(tmp_path, lr=5e-3)
    result = sweeps.extend("mine", 2, storage=tmp_path, finish=False, progress="none")
    assert [trial.point_index for trial in result.trials] == list(range(8))
    assert result.trials[5].point == {"lr": 5e-3}
    assert [trial.status for trial in result.trials] == ["completed"] * 8
    assert [trial.point for trial in result.trials[:4]] == [draw_point(spec.space, index, 0) for index in range(4)]
    # The model chose the last ones: by the drawn points there were, and by all that had ended, the injected one too.
    assert [(index, len(ended), "t0005" in ended) for index, ended in told] == [
        (4, 4, False), (5, 6, True), (6, 7, True)
    ]  # fmt: skip
