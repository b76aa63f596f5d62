"""The values that stand beside a score: those that it was reached with, also after a population went on with others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from page_sweeps import write_sweep
from synthetic_sweep import make_points, make_sweep

from analysis.records import ChangeRecord, CheckpointRecord, TrialRecord
from analysis.selection import score_trial
from analysis.tables import shown_point
from policies.errors import SpecError
from tests.narrowing import present
from tune_jobs.client.answers import Trial
from tune_jobs.service.summaries import trial_row, wanted_fields
from tune_jobs.sweeps.results import Trials
from tune_jobs.sweeps.sweep_file import _document

PLAIN = TrialRecord(
    trial_id="t0000", index=0, point_index=0, seed=1, point={"lr": 0.01}, status="completed",
    checkpoints=(
        CheckpointRecord(trial_id="t0000", iteration=3, num_env_steps=3000, evaluation_return=480.0),
        CheckpointRecord(trial_id="t0000", iteration=8, num_env_steps=8000, evaluation_return=20.0),
    ),
)  # fmt: skip
CHANGE = ChangeRecord(
    iteration=4, num_env_steps=4000, source_trial_id="t0001", source_iteration=4, before={"lr": 0.01},
    after={"lr": 0.0005}, time=1.0,
)  # fmt: skip
CHANGED = PLAIN.model_copy(update={"point": {"lr": 0.0005}, "changes": (CHANGE,)})


def test_a_row_has_the_values_that_its_score_was_reached_with() -> None:
    score = present(score_trial(CHANGED)).score
    assert score == 480.0
    row = trial_row(CHANGED, score)
    assert (row["score"], row["point"], row["score_point"]) == (480.0, {"lr": 0.0005}, {"lr": 0.01})
    assert row["score_point"] == shown_point(CHANGED)
    assert Trial.model_validate(row).score_point == {"lr": 0.01}


def test_where_nothing_was_changed_they_are_not_said_twice() -> None:
    assert trial_row(PLAIN, 480.0)["score_point"] is None
    # The best checkpoint is one after the change.
    best_last = CHANGED.model_copy(update={"checkpoints": CHANGED.checkpoints[1:]})
    assert trial_row(best_last, 20.0)["score_point"] is None


def test_they_can_be_asked_for_by_name() -> None:
    fields = wanted_fields("trial_id,score_point,score")
    assert trial_row(CHANGED, 480.0, fields) == {"trial_id": "t0000", "score_point": {"lr": 0.01}, "score": 480.0}
    with pytest.raises(SpecError) as caught:
        wanted_fields("score_points")
    assert "score_point" in str(caught.value.hint)


def test_the_file_of_a_sweep_has_them(tmp_path: Path) -> None:
    made = make_sweep(name="mine", points=make_points(1, np.random.default_rng(1)), with_best=False)
    known = made.trials[0]
    checkpoints = tuple(item.model_copy(update={"trial_id": known.trial_id}) for item in CHANGED.checkpoints)
    changed = known.model_copy(update={"point": CHANGED.point, "changes": (CHANGE,), "checkpoints": checkpoints})
    store = write_sweep(tmp_path, replace(made, trials=[changed, *made.trials[1:]]))
    first, *others = _document(store)["trials"]
    assert (first["point"], first["score_point"]) == ({"lr": 0.0005}, {"lr": 0.01})
    assert others
    assert all(each["score_point"] is None for each in others)


def test_a_notebook_has_them_beside_the_score() -> None:
    html = Trials([CHANGED])._repr_html_()
    assert "0.01" in html
    assert "0.0005" not in html
