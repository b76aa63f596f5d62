"""By what an earlier sweep's points are ranked, which of them count, and what a plan says of it."""

from pathlib import Path
from typing import Any

import pytest
from test_prior import begun, make_spec, valley, write_earlier
from test_search_methods import record

from analysis.objectives import score_of
from analysis.records import IterationRecord, PriorPointRecord, PriorRecord
from tests.narrowing import present
from tune_jobs.search.prior import prior_notes, prior_record
from tune_jobs.store.sweep_store import SweepStore

OBJECTIVES: list[dict[str, Any]] = [{"type": "area"}, {"type": "steps_to_threshold", "threshold": 400.0}]
NUM_ENV_STEPS = 10_000
ENDED = [0, 1, 2, 5, 6, 7, 8, 9, 10, 11]


def results_of(index: int) -> list[IterationRecord]:
    """The trial of a higher index learns later, whatever its values are."""
    evaluations = [(500, 20.0), (1_000 + 500 * index, 400.0), (9_000, 405.0)]
    return [
        IterationRecord(iteration=number, num_env_steps=steps, num_episodes=1, time_s=1.0, evaluation_return=value)
        for number, (steps, value) in enumerate(evaluations, start=1)
    ]


def write_random_search(storage: Path, objective: dict[str, Any]) -> SweepStore:
    store = write_earlier(storage, objective=objective, stop={"num_env_steps": NUM_ENV_STEPS})
    for trial in store.read_trials():
        store.trial(trial.trial_id).append_iterations(results_of(trial.index))
    return store


def ranked(prior: PriorRecord) -> list[float]:
    """The searched values of the points that did not fail, the worst first."""
    shares = sorted((present(item.share), item.point["lr"]) for item in prior.points if item.share is not None)
    return [lr for _, lr in shares]


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_points_of_a_random_search_are_ranked_by_its_own_objective(objective: dict[str, Any], tmp_path: Path) -> None:
    """No model learned from them, so that their trials told no scores by it."""
    trials = write_random_search(tmp_path, objective).read_trials()
    scores = {
        trials[index].point["lr"]: present(
            score_of(
                trials[index], results_of(index), objective["type"], num_env_steps=NUM_ENV_STEPS, threshold=400.0
            )
        )
        for index in ENDED
    }  # fmt: skip
    spec, (prior,) = begun(tmp_path)
    assert ranked(prior) == sorted(scores, key=lambda lr: scores[lr])
    assert ranked(prior) != sorted(scores, key=valley)
    assert prior_notes(spec, [prior]) == ("The model begins with 11 points of sweep first.",)


def test_the_envs_own_threshold_counts_where_the_objective_has_none(tmp_path: Path) -> None:
    store = write_random_search(tmp_path, {"type": "steps_to_threshold"})
    store.write_record(store.read_record().model_copy(update={"env_threshold": 400.0}))
    _, (prior,) = begun(tmp_path)
    trials = store.read_trials()
    assert ranked(prior) == [trials[index].point["lr"] for index in reversed(ENDED)]


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("is_there", [False, True])
def test_where_results_cannot_be_read_best_evaluations_count_and_a_note_says_so(
    objective: dict[str, Any], tmp_path: Path, *, is_there: bool
) -> None:
    store = write_random_search(tmp_path, objective)
    path = store.trial("t0006").results_path
    path.unlink()
    if is_there:
        path.mkdir()
    spec, (prior,) = begun(tmp_path)
    lrs = [store.read_trials()[index].point["lr"] for index in ENDED]
    assert ranked(prior) == sorted(lrs, key=valley)
    (_, note) = prior_notes(spec, [prior])
    assert "Sweep first is ranked by its trials' best evaluations" in note


def test_a_point_outside_of_the_space_there_counts_where_it_lies_in_this_one(tmp_path: Path) -> None:
    """Its own model could not learn from what somebody chose there; this one can."""
    narrow = {"lr": {"loguniform": [1e-5, 1e-3]}}
    earlier = make_spec(space=narrow, points=[{"lr": 3e-2}])
    drawn = [record(index, {"lr": 1e-5 * 1.4**index}, 20.0 + index) for index in range(1, 13)]
    trials = [record(0, {"lr": 3e-2}, 500.0), *drawn]
    prior = prior_record(make_spec(search="gp", prior="first"), "first", earlier, trials)
    assert (len(prior.points), prior.num_ended) == (13, 13)
    assert [item.share for item in prior.points if item.point == {"lr": 3e-2}] == [pytest.approx(12.5 / 13)]
    # Where it lies outside here, too, it is counted, and left out.
    spec = make_spec(space=narrow, search="gp", prior="first")
    prior = prior_record(spec, "first", earlier, trials)
    assert (len(prior.points), prior.num_ended) == (12, 13)
    assert prior_notes(spec, [prior]) == ("The model begins with 12 of the 13 ended points of sweep first.",)


@pytest.mark.parametrize(
    ("changes", "are_all_random"),
    [
        ({"num_samples": 6}, True),
        ({"num_samples": 8}, True),
        ({"num_samples": 9}, False),
        ({"num_samples": 6, "points": [{"lr": 1e-2}, {"lr": 2e-2}, {"lr": 3e-2}]}, False),
        ({"num_samples": 6, "search": {"type": "gp", "num_startup_trials": 7}}, False),
    ],
)
def test_a_note_says_that_no_model_will_propose_anything(changes: dict[str, Any], *, are_all_random: bool) -> None:
    spec = make_spec(**{"search": "gp", "prior": "first", **changes})
    points = tuple(PriorPointRecord(point={"lr": lr}, share=lr) for lr in (0.01, 0.02))
    notes = prior_notes(spec, [PriorRecord(sweep="first", env_id=spec.env.id, points=points, num_ended=2)])
    assert any("All points will be random" in note for note in notes) is are_all_random
    assert prior_notes(spec, []) == ()
