"""The answer at the head of a report: sentences made from the sweep's data, whatever the data are."""

import math

import pytest
from report_sources import setting, settings_of, source_of
from synthetic_sweep import Synthetic, make_sweep

from analysis.best_records import SettingsRecord
from analysis.page import answer
from analysis.wording import known_return_text
from tests.narrowing import present


def words_of(synthetic: Synthetic, settings: SettingsRecord | None = None) -> str:
    return " ".join(answer.section(source_of(synthetic, settings)).sentences)


@pytest.fixture(scope="module")
def fast_and_slow() -> Synthetic:
    """Two settings that always solve, of which the second is slower, and one that never does."""
    return make_sweep(points=[{"lr": 3e-3}, {"lr": 1.2e-3}, {"lr": 1e-7}], seeds_per_point=3)


def test_a_clear_winner_is_named_with_its_seeds_and_env_steps(fast_and_slow: Synthetic) -> None:
    best = setting(1, ["t0000", "t0001", "t0002"], 3, probability_best=0.97)
    second = setting(2, ["t0006", "t0007", "t0008"], 0, probability_best=0.01, may_be_best=False)
    found = answer.section(source_of(fast_and_slow, settings_of(best, second)))
    source = source_of(fast_and_slow)
    steps = sorted(present(source.env_steps_to_goal(trial_id, 195.0)) for trial_id in best.trial_ids)
    spread = f" ({steps[0]:,} to {steps[2]:,})" if steps[0] < steps[2] else ""
    assert (
        found.sentences[0] == f"Use lr 0.1: 3 of 3 seeds reached 195, after a median of {steps[1]:,} env steps{spread}."
    )
    assert found.sentences[1] == "It is the best of 9 with a probability of 97 %; the data tell it from all others."
    assert found.command == ""


def test_one_that_is_as_reliable_but_slower_is_named(fast_and_slow: Synthetic) -> None:
    best = setting(1, ["t0000", "t0001", "t0002"], 3, probability_best=0.6)
    second = setting(2, ["t0003", "t0004", "t0005"], 3, probability_best=0.4)
    worse = setting(3, ["t0006", "t0007", "t0008"], 0, probability_best=0.0, may_be_best=False)
    found = answer.section(source_of(fast_and_slow, settings_of(best, second, worse)))
    assert "lr 0.01 is as reliable but slower (" in " ".join(found.sentences)
    assert "1 other can't be told from it" in " ".join(found.sentences)
    assert found.command == "tune-jobs replicate sweep"
    swapped = answer.section(source_of(fast_and_slow, settings_of(second, best, worse)))
    assert "lr 0.1 is as reliable and faster (" in " ".join(swapped.sentences)
    # It is ranked by what is to be expected of it: its mean may be higher, and lower.
    for score, told in (
        (second.score + 1.0, "and faster ("),
        (second.score - 1.0, "and faster, though it scored less ("),
    ):
        other = best.model_copy(update={"score": score})
        swapped = answer.section(source_of(fast_and_slow, settings_of(second, other, worse)))
        assert f"lr 0.1 is as reliable {told}" in " ".join(swapped.sentences)
    unreliable = best.model_copy(update={"num_solved": 2})
    found = answer.section(source_of(fast_and_slow, settings_of(second, unreliable, worse)))
    assert "Next comes lr 0.1: 2 of 3 seeds reached 195" in " ".join(found.sentences)
    # Of a setting of which half of the seeds do, one that did is met every second time.
    one_seed = setting(1, ["t0000"], 1, probability_best=0.4)
    found = answer.section(source_of(fast_and_slow, settings_of(second, one_seed, worse)))
    assert "Next comes lr 0.1: 1 of 1 seed reached 195" in " ".join(found.sentences)


def test_one_seed_a_setting_names_no_setting() -> None:
    synthetic = make_sweep(points=[{"lr": 3e-3}, {"lr": 3.1e-3}, {"lr": 1e-7}])
    tied = [
        trial.model_copy(
            update={"checkpoints": tuple(c.model_copy(update={"evaluation_return": 200.0}) for c in trial.checkpoints)}
        )
        for trial in synthetic.trials[:2]
    ]
    synthetic.trials[:2] = tied
    found = answer.section(source_of(synthetic))
    assert found.sentences[0] == (
        "One seed a setting names a good policy, not a good setting; 2 of 3 trials tie at 200.0."
    )
    assert "did best with its one seed" in found.sentences[1]
    assert found.command == "tune-jobs replicate sweep"


def test_where_all_with_one_seed_are_alike_nobody_did_best() -> None:
    synthetic = make_sweep(points=[{"lr": 3e-3}, {"lr": 3.1e-3}, {"lr": 1e-7}])
    synthetic.trials[:] = [
        trial.model_copy(
            update={"checkpoints": tuple(c.model_copy(update={"evaluation_return": 9.0}) for c in trial.checkpoints)}
        )
        for trial in synthetic.trials
    ]
    alike = [
        setting(index, [f"t000{index}"], 0).model_copy(update={"score": 9.0, "scores": (9.0,)}) for index in range(3)
    ]
    found = answer.section(source_of(synthetic, settings_of(*alike, num_settings=24)))
    assert found.sentences[0].endswith("not a good setting; 3 of 3 trials tie at 9.0.")
    assert "did best" not in " ".join(found.sentences)


def test_the_policy_and_the_setting_are_not_mixed(fast_and_slow: Synthetic) -> None:
    best = present(fast_and_slow.best)
    winner = best.checkpoint.trial_id
    same = setting(1, [winner, "t0001"], 2, probability_best=0.97)
    other = setting(2, ["t0006", "t0007"], 0, probability_best=0.01, may_be_best=False)
    assert "another setting" not in words_of(fast_and_slow, settings_of(same, other))
    text = words_of(fast_and_slow, settings_of(other, same))
    assert f"To act, load the policy of {winner}: {best.confirmation.mean_return:.1f} over 100 fresh episodes" in text
    assert "over episodes of this policy), which" in text
    assert "It was trained with another setting, lr" in text


def test_equal_episodes_have_no_interval(fast_and_slow: Synthetic) -> None:
    best = present(fast_and_slow.best)
    alike = best.confirmation.model_copy(update={"returns": (200.0,) * 100})
    fast_and_slow = Synthetic(
        fast_and_slow.sweep, fast_and_slow.trials, fast_and_slow.results,
        best.model_copy(update={"confirmation": alike}),
    )  # fmt: skip
    assert "200.0 in each of 100 fresh episodes, which solves the env." in words_of(fast_and_slow)


def test_returns_that_are_not_numbers_are_called_so(fast_and_slow: Synthetic) -> None:
    best = present(fast_and_slow.best)
    broken = best.confirmation.model_copy(update={"returns": (math.nan, *best.confirmation.returns[1:])})
    synthetic = Synthetic(
        fast_and_slow.sweep, fast_and_slow.trials, fast_and_slow.results,
        best.model_copy(update={"confirmation": broken}),
    )  # fmt: skip
    assert "its mean return over 100 fresh episodes is not a number." in words_of(synthetic)
    assert known_return_text(-math.inf) == "infinite"


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (
            settings_of(setting(1, ["t0000"], 1), num_settings=1),
            "env steps. One seed says nothing of how others would do.",
        ),
        (
            settings_of(
                setting(1, ["t0000", "t0001"], 0, probability_best=0.5),
                setting(2, ["t0002", "t0003"], 0, probability_best=0.5, scores=(189.0, 189.0)),
                num_settings=2,
            ),
            "All 2 settings scored 189.0: the data can't order them.",
        ),
        # A failure has the worst score, and nobody has scored it.
        (
            settings_of(
                setting(1, ["t0000", "t0001"], 0, probability_best=0.5),
                setting(2, ["t0002", "t0003"], 0, probability_best=0.5, scores=(189.0, 189.0), num_failed=2),
                num_settings=2,
            ),
            "lr 0.1 leads: it scored 189.0 in the later half of training",
        ),
        (
            settings_of(
                setting(1, ["t0000", "t0001"], None, probability_best=0.5, scores=(-3.0, -5.0), score=-4.0),
                setting(2, ["t0002", "t0003"], None, probability_best=0.5),
                num_settings=2,
                threshold=None,
            ),
            (
                "lr 0.1 leads: it scored -4.0 in the later half of training "
                "(180.0 to 200.0 with 95 %, over training seeds)."
            ),
        ),
    ],
)
def test_settings_that_say_little_are_said_to(
    fast_and_slow: Synthetic, settings: SettingsRecord, sentence: str
) -> None:
    assert sentence in words_of(fast_and_slow, settings)


def test_bad_sweeps_are_told_in_words() -> None:
    assert words_of(make_sweep(points=[])) == "The sweep has no trials yet."
    failed = words_of(make_sweep(failed=range(20)))
    assert failed.startswith("No setting can be named: no trial has ended with anything that it could be judged by.")
    assert "No trial of 20 is usable: 20 failed." in failed
    running = make_sweep(pending=range(6, 20), with_best=False)
    running.sweep = running.sweep.model_copy(update={"state": "running"})
    text = words_of(running)
    assert text.startswith("So far 6 of 20 trials have ended.")
    assert "No policy is confirmed on fresh seeds yet." in text
    baseline = words_of(make_sweep(points=[{}], algorithm="random"))
    assert baseline.startswith("To act, load the best policy: ")
    population = make_sweep(points=[{"lr": 1e-3}, {"lr": 3e-3}])
    spec = population.sweep.spec | {"scheduler": {"type": "pbt"}}
    population.sweep = population.sweep.model_copy(update={"spec": spec})
    found = answer.section(source_of(population))
    assert "no setting can be named" in found.sentences[0]
    assert found.command == ""
