"""By what an earlier sweep's points are ranked, which of them count, and what a plan says of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from test_prior import begun, make_spec, valley, write_earlier
from test_search_methods import record

from analysis.objectives import score_of
from analysis.records import IterationRecord, PriorPointRecord, PriorRecord, TrialRecord
from policies import random_streams
from tests.narrowing import present
from tune_jobs.search import proposal
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.prior import prior_notes, prior_record, weighed_prior
from tune_jobs.search.proposal import propose_point
from tune_jobs.search.two_objectives import weighed
from tune_jobs.search.warped import rank_of
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


LENGTHS = [10_000, 20_000, 30_000, 40_000, 50_000]
LENGTH = "stop.num_env_steps"
COSTLY: dict[str, Any] = {
    "space": {LENGTH: {"choice": LENGTHS}}, "objective": ["return", "env_steps"], "search": "gp", "prior": "first",
}  # fmt: skip
OF_THE_COST, OF_THE_SCORE = 0.1, 0.9
"""The largest weight of the score where nearly the cost alone counts, and the least where the score does."""


def index_with(low: float, high: float) -> int:
    """The index of a point for which the score has such a weight."""
    return next(index for index in range(200) if low < random_streams.objective_weights(0, index).random() < high)


def longer_is_better(*numbers: int, per_step: float = 0.01) -> list[TrialRecord]:
    """Trials of each of the lengths, of which the longest scores most."""
    return [
        record(place, {LENGTH: LENGTHS[number]}, per_step * LENGTHS[number], steps=LENGTHS[number] + 100)
        for place, number in enumerate(numbers)
    ]


def order_of(prior: PriorRecord) -> list[int]:
    scored = sorted((present(item.share), item.point[LENGTH]) for item in prior.points if item.share is not None)
    return [LENGTHS.index(length) for _, length in scored]


def test_by_score_and_cost_an_earlier_sweeps_points_are_ordered_as_the_own_ones_are() -> None:
    spec = make_spec(**COSTLY)
    failed = record(5, {LENGTH: LENGTHS[0]}, status="failed")
    prior = prior_record(spec, "first", spec, [*longer_is_better(0, 1, 2, 3, 4), failed])
    assert [item.env_steps for item in prior.points[:-1]] == LENGTHS
    assert order_of(prior) == [0, 1, 2, 3, 4]
    own = [KnownPoint({LENGTH: length}, (length / 7,), (length,)) for length in LENGTHS]
    for index in range(30):
        made = weighed_prior(prior, index, seed=0)
        told = weighed(own, index, seed=0)
        assert order_of(made) == sorted(range(5), key=lambda number: present(told[number].score))
        assert sorted(present(item.share) for item in made.points[:-1]) == [item.share for item in prior.points[:-1]]
        assert made.points[-1] == prior.points[-1]
    assert order_of(weighed_prior(prior, index_with(0.0, OF_THE_COST), seed=0)) == [4, 3, 2, 1, 0]
    assert order_of(weighed_prior(prior, index_with(OF_THE_SCORE, 1.0), seed=0)) == [0, 1, 2, 3, 4]


def test_what_a_last_iteration_has_beyond_the_end_orders_nothing() -> None:
    """Of one length all cost the same, also those that a scheduler stopped, which count with the length they had."""
    space = {"lr": {"loguniform": [1e-5, 1e-1]}}
    fields: dict[str, Any] = {"space": space, "stop": {"num_env_steps": 50_000}}
    earlier = make_spec(**fields, scheduler={"type": "asha", "grace_env_steps": 5_000})
    new = make_spec(**fields, objective=["return", "env_steps"], search="gp", prior="first")
    rates = [1e-5 * 2.0**place for place in range(12)]
    stopped = [record(place, {"lr": rates[place]}, 10.0 + place, status="stopped", steps=5_120) for place in range(8)]
    ended = [record(place, {"lr": rates[place]}, 100.0 * place, steps=50_176) for place in range(8, 12)]
    prior = prior_record(new, "first", earlier, [*stopped, *ended])
    for index in range(30):
        assert ranked(weighed_prior(prior, index, seed=0)) == rates


def test_points_that_are_alike_in_score_and_cost_share_their_place() -> None:
    points = [
        PriorPointRecord(point={LENGTH: LENGTHS[number]}, share=share, env_steps=steps)
        for number, (share, steps) in enumerate([(0.2, 10), (0.5, 30), (0.5, 30), (0.8, 40)])
    ]
    prior = PriorRecord(sweep="first", env_id="CartPole-v1", points=tuple(points))
    made = weighed_prior(prior, index_with(0.0, OF_THE_COST), seed=0)
    assert [item.share for item in made.points] == pytest.approx([0.8, 0.5, 0.5, 0.2])
    assert weighed_prior(prior.model_copy(update={"points": ()}), 0, seed=0).points == ()


def test_where_a_former_record_tells_no_costs_the_scores_alone_order_its_points() -> None:
    points = tuple(PriorPointRecord(point={LENGTH: length}, share=length / 1e5) for length in LENGTHS)
    prior = PriorRecord(sweep="first", env_id="CartPole-v1", points=points)
    assert weighed_prior(prior, index_with(0.0, OF_THE_COST), seed=0) is prior
    one = points[0].model_copy(update={"env_steps": 9})
    mixed = prior.model_copy(update={"points": (one, *points[1:])})
    assert weighed_prior(mixed, index_with(0.0, OF_THE_COST), seed=0) is mixed


def test_a_model_that_is_told_of_the_cost_learns_what_an_earlier_sweep_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first points of the earlier sweep and of this one are the same, and are told as equal."""
    told: list[Sequence[KnownPoint]] = []

    def ask(method: str, space: Any, known: Sequence[KnownPoint], *_: Any, **__: Any) -> dict[str, Any]:
        told.append(known)
        return {LENGTH: LENGTHS[0]}

    monkeypatch.setattr(proposal, "next_point", ask)
    spec = make_spec(**COSTLY, seed=0)
    prior = prior_record(spec, "first", spec, longer_is_better(0, 1, 2, 3, 4))
    records = longer_is_better(0, 1, 2, 3, 4, 0, 1, 2, 3, 4, per_step=3.0)
    for index in (index_with(0.0, OF_THE_COST), index_with(OF_THE_SCORE, 1.0)):
        propose_point(spec, records, index, lambda _: None, [prior])
        order = [[item.point[LENGTH] for item in sorted(told[-1][begin : begin + 5], key=rank_of)] for begin in (0, 5)]
        assert order[0] == order[1]
    assert order[0] == LENGTHS
    # Who asks for the score alone learns of no cost.
    propose_point(make_spec(**{**COSTLY, "objective": "final"}), records, 0, lambda _: None, [prior])
    assert [item.point[LENGTH] for item in sorted(told[-1][:5], key=rank_of)] == LENGTHS
