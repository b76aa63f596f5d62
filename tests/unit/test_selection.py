"""The rule of the design for "best", case by case."""

import itertools
import math
import pickle

import pytest

from analysis.records import CheckpointRecord, TrialRecord
from analysis.selection import (
    NoUsableTrialError,
    best_checkpoint,
    error_hint,
    error_summary,
    policy_candidates,
    rank_points,
    score_trial,
    select_best,
    tie_key,
)
from policies.errors import NotFoundError


def checkpoint(
    trial_id: str, iteration: int, evaluation: float | None, *, steps: int | None = None, training: float | None = None
) -> CheckpointRecord:
    return CheckpointRecord(
        trial_id=trial_id,
        iteration=iteration,
        num_env_steps=iteration * 1000 if steps is None else steps,
        training_return=training,
        evaluation_return=evaluation,
    )


def trial(
    index: int,
    *evaluations: float | None,
    point: int | None = None,
    seed_index: int = 0,
    status: str = "completed",
    steps: int | None = None,
    error: str | None = None,
    training: float | None = None,
) -> TrialRecord:
    trial_id = f"t{index:04d}"
    return TrialRecord(
        trial_id=trial_id,
        index=index,
        point_index=index if point is None else point,
        seed_index=seed_index,
        seed=1000 + index,
        point={"lr": 0.001 * (index if point is None else point)},
        status=status,
        error=error,
        checkpoints=tuple(
            checkpoint(trial_id, i + 1, value, steps=steps, training=training) for i, value in enumerate(evaluations)
        ),
    )


def test_the_highest_evaluation_return_wins_wherever_in_the_trial_it_was() -> None:
    best = select_best([trial(0, 100.0, 50.0), trial(1, 40.0, 180.0, 20.0), trial(2, 150.0)])
    assert (best.trial.trial_id, best.checkpoint.iteration, best.score) == ("t0001", 2, 180.0)
    assert [point.point_index for point in best.ranking] == [1, 2, 0]


def test_training_return_decides_nothing() -> None:
    assert select_best([trial(0, 10.0, training=500.0), trial(1, 20.0, training=1.0)]).trial.index == 1


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, None])
def test_a_score_that_is_not_finite_never_wins(value: float | None) -> None:
    assert select_best([trial(0, value, -7.0), trial(1, value)]).score == -7.0
    assert score_trial(trial(0, value)) is None


def test_a_not_finite_score_never_wins_even_where_a_record_skipped_validation() -> None:
    bad = checkpoint("t0000", 1, 1.0).model_copy(update={"evaluation_return": math.nan})
    assert score_trial(trial(0).model_copy(update={"checkpoints": (bad,)})) is None


def test_a_failed_trial_never_wins() -> None:
    assert select_best([trial(0, 500.0, status="failed", error="boom"), trial(1, 0.0)]).trial.index == 1


@pytest.mark.parametrize("status", ["running", "paused", "completed", "stopped"])
def test_a_trial_that_did_not_fail_may_win(status: str) -> None:
    assert select_best([trial(0, 5.0, status=status)]).trial.status == status


def test_a_score_of_zero_is_a_score() -> None:
    best = select_best([trial(0, 0.0), trial(1, -1.0)])
    assert (best.trial.index, best.score) == (0, 0.0)


def test_ties_go_to_fewer_env_steps_then_to_the_lower_trial_index() -> None:
    assert select_best([trial(0, 9.0, steps=500), trial(1, 9.0, steps=400)]).trial.index == 1
    assert select_best([trial(3, 9.0, steps=400), trial(1, 9.0, steps=400)]).trial.index == 1
    assert select_best([trial(0, 9.0, 9.0)]).checkpoint.iteration == 1


@pytest.mark.parametrize("scores", list(itertools.product([None, 0.0, 5.0], repeat=4)))
def test_of_a_trial_as_it_grows_the_earliest_of_the_highest_is_kept(
    scores: tuple[float | None, float | None, float | None, float | None],
) -> None:
    known = [checkpoint("t0000", number, score) for number, score in enumerate(scores, start=1)]
    scored = [item for item in known if item.evaluation_return is not None]
    assert best_checkpoint(known) == max(
        scored, key=lambda item: (item.evaluation_return, -item.iteration), default=None
    )
    won = score_trial(trial(0, *scores))
    assert (won and won.checkpoint) == best_checkpoint(known)


def test_trial_index_orders_as_a_number() -> None:
    # As text t10000 comes before t9999.
    assert select_best([trial(10_000, 9.0, steps=1), trial(9_999, 9.0, steps=1)]).trial.index == 9_999


def test_a_point_scores_the_mean_of_its_seeds_and_its_best_seed_is_taken() -> None:
    trials = [
        trial(0, 100.0, point=0, seed_index=0),
        trial(1, 20.0, point=0, seed_index=1),
        trial(2, 70.0, point=1, seed_index=0),
        trial(3, 80.0, point=1, seed_index=1),
    ]
    best = select_best(trials)
    assert (best.trial.index, best.score, best.point_score) == (3, 80.0, 75.0)
    assert [point.score for point in best.ranking] == [75.0, 60.0]
    assert best.ranking[0].num_env_steps == 1000.0


@pytest.mark.parametrize(
    "lost",
    [
        trial(1, 500.0, point=0, seed_index=1, status="failed"),
        trial(1, point=0, seed_index=1),
        trial(1, math.nan, point=0, seed_index=1),
        None,
    ],
)
def test_a_lost_seed_does_not_flatter_its_point(lost: TrialRecord | None) -> None:
    trials = [
        trial(0, 200.0, point=0, seed_index=0),
        trial(2, 70.0, point=1, seed_index=0),
        trial(3, 80.0, point=1, seed_index=1),
    ]
    best = select_best(trials if lost is None else [*trials, lost])
    assert best.trial.index == 3
    assert [point.complete for point in best.ranking] == [True, False]
    assert [point.num_seeds for point in best.ranking] == [2, 2]
    assert [point.score for point in best.ranking] == [75.0, 200.0]


def test_more_seeds_of_some_points_make_no_other_incomplete() -> None:
    """Replicated twice: first both points, then the second one; behind them comes a point that was added."""
    trials = [
        trial(0, 90.0, point=0),
        trial(1, 70.0, point=1),
        trial(2, 50.0, point=0, seed_index=1),
        trial(3, 60.0, point=1, seed_index=1),
        trial(4, 65.0, point=1, seed_index=2),
        trial(5, 80.0, point=2),
    ]
    ranking = rank_points(trials)
    assert [(point.point_index, point.num_seeds, point.complete) for point in ranking] == [
        (2, 1, True), (0, 2, True), (1, 3, True),
    ]  # fmt: skip
    # A replicated seed that failed is a lost one.
    lost = trial(4, point=1, seed_index=2, status="failed")
    assert not next(point for point in rank_points([*trials[:4], lost]) if point.point_index == 1).complete


def test_incomplete_points_win_where_no_point_is_complete() -> None:
    trials = [
        trial(0, 200.0, point=0, seed_index=0),
        trial(1, point=0, seed_index=1, status="failed"),
        trial(2, 70.0, point=1, seed_index=0),
        trial(3, point=1, seed_index=1, status="failed"),
    ]
    assert select_best(trials).trial.index == 0


def test_the_order_of_the_trials_does_not_matter() -> None:
    trials = [trial(0, 9.0, steps=5), trial(1, 9.0, steps=5), trial(2, 9.0, steps=4), trial(3, 1.0)]
    for order in itertools.permutations(trials):
        assert [point.point_index for point in rank_points(order)] == [2, 0, 1, 3]


def test_no_usable_trial_says_why() -> None:
    trials = [
        trial(2, status="failed", error="ValueError: second"),
        trial(1, status="failed", error="ZeroDivisionError: the pole\n  at line 3"),
        trial(0, None),
        trial(3, status="pending"),
    ]
    with pytest.raises(NoUsableTrialError) as caught:
        select_best(trials)
    message = caught.value.message
    assert "of 4" in message
    assert "2 failed" in message
    assert "1 not started" in message
    assert "1 without" in message
    assert "t0001" in message
    assert "ZeroDivisionError: the pole" in message
    assert "second" not in message
    assert "t0001" in caught.value.hint


def test_no_usable_trial_has_a_hint_for_each_reason() -> None:
    hints = set()
    for trials in ([], [trial(0, status="pending")], [trial(0)], [trial(0, status="failed")]):
        assert rank_points(trials) == []
        with pytest.raises(NoUsableTrialError) as caught:
            select_best(trials)
        assert caught.value.hint
        hints.add(caught.value.hint)
    assert len(hints) == 4


def test_the_error_is_a_not_found_error_that_pickles() -> None:
    assert issubclass(NoUsableTrialError, NotFoundError)
    assert NoUsableTrialError.exit_code == 4
    with pytest.raises(NoUsableTrialError) as caught:
        select_best([])
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (copy.message, copy.hint) == (caught.value.message, caught.value.hint)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (None, "no message was recorded"),
        ("  \n", "no message was recorded"),
        ("RuntimeError: broke\nlog: Traceback (most recent call last):\nlast line", "RuntimeError: broke"),
        ("Traceback (most recent call last):\n  File x\n    y()\nKeyError: 'z'\nlog line", "KeyError: 'z'"),
        ("Traceback (most recent call last):\n  File x", "Traceback (most recent call last):"),
    ],
)
def test_error_summary_is_the_line_that_names_the_error(error: str | None, line: str) -> None:
    assert error_summary(error) == line


@pytest.mark.parametrize(
    ("error", "hint"),
    [
        ("It broke.\nMend it.\n  File here\npolicies.errors.EnvError: It broke.\nMend it.", "Mend it."),
        ("It broke.\nMend it.\n  File here\npolicies.errors.EnvError: It broke.\nMend it.\nMore.", "Mend it."),
        # The second line is of the log already.
        ("KeyError: 'x'\n  File here\n  line\nKeyError: 'x'", None),
        ("KeyError: 'x'\nsaid by the env\nKeyError: 'x'", None),
        ("It broke.\n  File here\nEnvError: It broke.\n  File here\nEnvError: It broke.", None),
        ("It broke.\nMend it.", None),
        ("\n\n\n", None),
        ("It broke.", None),
        ("", None),
        (None, None),
    ],
)
def test_error_hint_is_the_line_that_the_log_says_again(error: str | None, hint: str | None) -> None:
    assert error_hint(error) == hint
    record = trial(0, status="failed", error=error)
    with pytest.raises(NotFoundError) as failure:
        select_best([record])
    assert failure.value.hint == (
        "Read the log of t0000, mend the cause and launch again."
        if hint is None
        else f"{hint} The log of t0000 says more."
    )


def test_error_summary_is_short() -> None:
    assert len(error_summary("x" * 5000)) == 300


def test_every_kept_checkpoint_of_a_trial_that_did_not_fail_may_be_deployed() -> None:
    trials = [
        trial(0, 100.0, 50.0, math.nan, None, point=0),
        trial(1, 500.0, point=0, seed_index=1, status="failed"),
        trial(2, 70.0, 120.0, point=1, status="stopped"),
    ]
    known = policy_candidates(trials)
    assert [(item.trial.index, item.checkpoint.iteration) for item in known] == [(2, 2), (0, 1), (2, 1), (0, 2)]
    assert policy_candidates(trials[1:2]) == policy_candidates([]) == []


def test_equal_evaluations_are_in_the_order_of_the_training_returns() -> None:
    trials = [trial(0, 9.0, training=1.0), trial(1, 9.0), trial(2, 9.0, training=5.0), trial(3, 9.0, training=math.nan)]
    assert [item.trial.index for item in policy_candidates(trials)] == [2, 0, 1, 3]
    few = [trial(0, 9.0, training=1.0, steps=20), trial(1, 9.0, training=1.0, steps=10)]
    assert [item.trial.index for item in policy_candidates(few)] == [1, 0]
    assert [tie_key(item) for item in policy_candidates(few)] == [(10, 1, 1), (20, 0, 1)]
